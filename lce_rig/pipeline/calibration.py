"""Estimate and judge the extrinsics of every camera with every LiDAR of a session.

detections -> estimate of each camera with each LiDAR -> cameras of one LiDAR, together -> checks, verdict ->
the scene's opinion
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from lce_rig.calibrate import (
    CalibrateOptions,
    CalibrationEstimate,
    CaptureCandidates,
    Clocks,
    EstimateSettings,
    calibrate_channels,
)
from lce_rig.calibrate.likelihood.calibrate_together import TogetherEstimate, calibrate_together
from lce_rig.calibrate.metrics import error_to_reference
from lce_rig.calibrate.observability import find_weakest
from lce_rig.calibrate.relative_pose import relative_pose
from lce_rig.calibrate.tolerances import Tolerances
from lce_rig.core.calibration import Calibration, OtherCamera, SceneShare
from lce_rig.core.diagnostics import Diagnostics
from lce_rig.core.errors import NotEnoughDataError, UsageError, join_shortages
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.geometry import Array, invert, sigma_sizes, tangent_sizes
from lce_rig.core.results import ImageBoard
from lce_rig.detect.detection import Detections, Pair
from lce_rig.export.reference import Reference
from lce_rig.judge.camera_pairs import CameraPair, camera_findings, relate
from lce_rig.judge.reach import point_uncertainties
from lce_rig.judge.validate import Validation, validate
from lce_rig.judge.verdict import judge, share_findings, with_opinion
from lce_rig.lens.lens_estimate import BoardView
from lce_rig.pipeline.detect_session import Progress, detect, silent
from lce_rig.pipeline.findings import FEW_DETECTED, SHORTAGE
from lce_rig.pipeline.matching import candidates_of
from lce_rig.pipeline.result_files import Result
from lce_rig.pipeline.sharpening import Sharpen, by_boards, fuse, sharpen
from lce_rig.pipeline.witness import hear_scene
from lce_rig.rig import Rig
from lce_rig.session import Session
from lce_rig.words import not_enough, sentence


@dataclass(frozen=True, eq=False)
class _Sensors:
    """One camera with one LiDAR, and their detections.

    Attributes:
        pairs: channels of the camera with the LiDAR.
        settings: the user's options, with the LiDAR's properties from the profile.
        candidates: by channel, of captures with detections of both sensors.
        refused: why the other captures are unusable.
    """

    pairs: tuple[Pair, ...]
    settings: EstimateSettings
    candidates: Mapping[str, Sequence[CaptureCandidates]]
    refused: Mapping[str, Refusal]

    @property
    def camera(self) -> str:
        return self.pairs[0].camera

    @property
    def lidar(self) -> str:
        return self.pairs[0].lidar


@dataclass(frozen=True, eq=False)
class _Solved:
    """The result of the captures of one camera and one LiDAR.

    Attributes:
        sensors: the two.
        estimate: of the extrinsics.
        validation: of the estimate on the camera's own captures and images.
        together: the estimate of several cameras that it is part of; None where it stands alone.
        share: what the scene did to the extrinsics; None where it was not asked.
    """

    sensors: _Sensors
    estimate: CalibrationEstimate
    validation: Validation
    together: TogetherEstimate | None = None
    share: SceneShare | None = None

    @property
    def camera(self) -> str:
        return self.sensors.camera

    @property
    def lidar(self) -> str:
        return self.sensors.lidar

    @property
    def T_cam_lidar(self) -> Array:
        return self.estimate.T_cam_lidar

    @property
    def cov(self) -> Array:
        return self.validation.cov

    @property
    def cov_shared(self) -> Array:
        return self.validation.cov_shared

    @property
    def is_still(self) -> bool:
        """Whether boards stood still, so that images need no motion compensation."""
        return all(channel.time_offset_s is None for channel in self.estimate.channels)


@dataclass(frozen=True, eq=False)
class _Link:
    """Two cameras that saw the same boards, by their indices among those with an estimate."""

    first: int
    second: int
    pair: CameraPair
    findings: tuple[Finding, ...]


def calibrate(
    session: Session,
    detections: Detections | None = None,
    *,
    options: CalibrateOptions | None = None,
    cameras: Sequence[str] | None = None,
    channels: Sequence[str] | None = None,
    reference: Reference | None = None,
    use_scene: bool = False,
    progress: Progress = silent,
) -> Result:
    """Estimate and judge the extrinsics of every camera with every LiDAR of a session; nothing is written.

    Args:
        session: open for reading is enough.
        detections: of the session; None detects the board first, as `detect` does by default.
        options: of the estimate; None for the defaults.
        cameras: the cameras to calibrate, as if the session held no others; None for all.
        channels: the cameras' channels to use; None for all that the session holds.
        reference: extrinsics to report errors against; they never enter the estimate or the verdict.
        use_scene: estimate each frame camera from the edges of the scene, too.
        progress: called with (done, total) for each camera and LiDAR in turn.

    Raises:
        NotEnoughDataError: every pair has too few captures or an undetermined direction; the causes are
            named.
        UsageError: no capture holds one of the channels.
    """
    detections = detect(session) if detections is None else detections
    pairs, shortages = calibrate_detections(
        session.rig,
        detections,
        options,
        cameras=cameras,
        channels=channels,
        reference=reference,
        scene=partial(sharpen, [session], [detections]) if use_scene else None,
        progress=progress,
    )
    heard = [with_opinion(pair, hear_scene(session, detections, by_boards(pair))) for pair in pairs]
    return Result(session, tuple(heard), tuple(shortages))


def calibrate_detections(
    rig: Rig,
    detections: Detections,
    options: CalibrateOptions | None = None,
    *,
    cameras: Sequence[str] | None = None,
    channels: Sequence[str] | None = None,
    reference: Reference | None = None,
    scene: Sharpen | None = None,
    progress: Progress = silent,
) -> tuple[list[Calibration], list[Finding]]:
    """Estimate and judge the extrinsics of every camera with every LiDAR from their detections.

    Channels of one camera share pixels and lens: together they give one set of extrinsics. Cameras that saw
    the same boards are compared with each other, and with method "ml" estimated together.

    Args:
        rig: thresholds, targets and nominal extrinsics.
        detections: of one session.
        options, cameras, channels, reference, progress: as of `calibrate`.
        scene: asks the scene about the boards' extrinsics; None for the boards alone.

    Returns:
        The calibrated sensors, and for each other pair the cause.

    Raises:
        NotEnoughDataError: every pair has too few captures or an undetermined direction; the causes are
            named.
        UsageError: no capture holds one of the channels.
    """
    alone: list[_Solved] = []
    shortages: list[Finding] = []
    for pairs in _pairs_by_sensors(detections, cameras, channels):
        try:
            alone.append(_solve(rig, detections, pairs, options or CalibrateOptions(), progress))
        except NotEnoughDataError as error:
            shortages.append(_shortage(pairs, error))
    if not alone:
        raise _nothing_solved(shortages, cameras)
    links = list(_links(rig, alone))
    solved = _solve_together(rig, detections, alone, links)
    if scene is not None:
        solved = [_with_scene(rig, each, scene(each)) for each in solved]
    calibrations = [_judged(rig, detections, solved, links, k) for k in range(len(solved))]
    return [_compared(calibration, reference) for calibration in calibrations], shortages


def _nothing_solved(shortages: Sequence[Finding], cameras: Sequence[str] | None) -> NotEnoughDataError:
    """State for every pair why it could not be calibrated."""
    if not shortages:
        of_cameras = f" of {' or '.join(cameras)}" if cameras else ""
        return NotEnoughDataError(
            f"the session has no capture with an image{of_cameras} and a scan", "Collect captures first."
        )
    return join_shortages([not_enough(shortage) for shortage in shortages])


def _shortage(pairs: Sequence[Pair], error: NotEnoughDataError) -> Finding:
    """Name the sensors that lack captures, if the error does not."""
    found = error.finding or SHORTAGE(text=error.what, advice=error.hint)
    return found if found.subject else replace(found, subject=f"{pairs[0].camera} and {pairs[0].lidar}")


def _pairs_by_sensors(
    detections: Detections, cameras: Sequence[str] | None, channels: Sequence[str] | None
) -> list[list[Pair]]:
    """Group the pairs by camera and LiDAR, whose channels are calibrated jointly."""
    held = sorted({pair.channel for pair in detections.pairs})
    unknown = sorted(set(channels or ()) - set(held))
    if unknown:
        raise UsageError(
            f"no capture of the session has channel {unknown[0]!r}", f"Choose one of: {', '.join(held)}"
        )
    wanted = [
        pair
        for pair in detections.pairs
        if (cameras is None or pair.camera in cameras) and (channels is None or pair.channel in channels)
    ]
    groups: dict[tuple[str, str], list[Pair]] = {}
    for pair in wanted:
        groups.setdefault((pair.camera, pair.lidar), []).append(pair)
    return list(groups.values())


def _solve(
    rig: Rig, detections: Detections, pairs: Sequence[Pair], options: CalibrateOptions, progress: Progress
) -> _Solved:
    """Estimate the extrinsics of one camera and LiDAR from their own captures alone.

    Raises:
        NotEnoughDataError: there are too few, or a direction is undetermined.
    """
    sensors = _sensors(rig, detections, pairs, options)
    clocks = clocks_of(rig, sensors.camera, sensors.lidar)
    estimate = calibrate_channels(
        sensors.candidates, rig.board.to_board(), sensors.settings, clocks, progress
    )
    return _Solved(sensors, estimate, _examine(rig, detections, sensors, estimate))


def _sensors(rig: Rig, detections: Detections, pairs: Sequence[Pair], options: CalibrateOptions) -> _Sensors:
    """Collect the candidates of each channel with enough captures, and why other captures are unusable.

    Raises:
        NotEnoughDataError: no channel has enough.
    """
    candidates: dict[str, list[CaptureCandidates]] = {}
    refused: dict[str, Refusal] = {}
    shortages: list[Finding] = []
    for pair in pairs:
        own, own_refused = candidates_of(detections, pair)
        refused |= {name: why for name, why in own_refused.items() if name not in refused}
        if len(own) >= rig.quality.min_captures:
            candidates[pair.channel] = own
        else:
            shortages.append(_few_detected(pair, len(own), own_refused, rig.quality.min_captures))
    if not candidates:
        raise not_enough(shortages[0])
    found = {item.capture for items in candidates.values() for item in items}
    refused = {name: why for name, why in refused.items() if name not in found}
    tolerances = Tolerances.of(rig.cameras[pairs[0].camera], rig.board)
    settings = EstimateSettings.of(options, rig.lidars[pairs[0].lidar], tolerances)
    return _Sensors(tuple(pairs), settings, candidates, refused)


def _few_detected(pair: Pair, n_detected: int, refused: Mapping[str, Refusal], n_needed: int) -> Finding:
    """State in how many captures both sensors found the board, and the most frequent causes of refusal."""
    counts = Counter((why.code, f"{why.stage}: {sentence(why)}") for why in refused.values())
    return FEW_DETECTED(
        str(pair),
        n_detected=n_detected,
        n_captures=n_detected + len(refused),
        n_needed=n_needed,
        causes=tuple((n, code, text) for (code, text), n in counts.most_common(3)),
    )


def _links(rig: Rig, solved: Sequence[_Solved]) -> Iterator[_Link]:
    """Compare cameras of one LiDAR that saw the same still boards."""
    for (i, one), (j, other) in combinations(enumerate(solved), 2):
        if one.sensors.lidar == other.sensors.lidar and one.is_still and other.is_still:
            # Contradicting captures widen a method's covariance; that must not hide the contradiction.
            pair = relate(one.estimate, other.estimate)
            if pair is not None:
                names = one.sensors.camera, other.sensors.camera
                yield _Link(i, j, pair, tuple(camera_findings(pair, names, rig.calibration, rig.verdict)))


def _solve_together(
    rig: Rig, detections: Detections, alone: Sequence[_Solved], links: Sequence[_Link]
) -> list[_Solved]:
    """Estimate cameras that agree jointly with method "ml"; leave the others unchanged.

    A camera that contradicts another is excluded, as it would corrupt the other's extrinsics.
    """
    solved = list(alone)
    for group in _groups(len(alone), links):
        if alone[group[0]].sensors.settings.method == "ml":
            own = {alone[k].camera: alone[k].estimate for k in group}
            settings = {alone[k].camera: alone[k].sensors.settings for k in group}
            together = calibrate_together(own, rig.board.to_board(), settings)
            for k in group:
                solved[k] = _part_of(together, rig, detections, alone[k])
    return solved


def _groups(n: int, links: Sequence[_Link]) -> list[list[int]]:
    """List groups of two or more connected cameras, without those that have a contradicted link."""
    group = list(range(n))
    for link in links:
        if not link.findings:
            mine, other = group[link.first], group[link.second]
            group = [mine if number == other else number for number in group]
    contradicted = {
        group[link.first] for link in links if link.findings and group[link.first] == group[link.second]
    }
    found = [[k for k in range(n) if group[k] == number] for number in sorted(set(group) - contradicted)]
    return [members for members in found if len(members) > 1]


def _part_of(together: TogetherEstimate, rig: Rig, detections: Detections, alone: _Solved) -> _Solved:
    """Replace a camera's own estimate by its part of a joint one."""
    estimate = together.estimates[alone.sensors.camera]
    sigma_deg, sigma_m = sigma_sizes(alone.validation.cov)
    estimate = replace(
        estimate,
        diagnostics=replace(
            estimate.diagnostics, alone_sigma_rotation_deg=sigma_deg, alone_sigma_translation_m=sigma_m
        ),
        channels=alone.estimate.channels,
        channel_difference=alone.estimate.channel_difference,
        channel_difference_cov=alone.estimate.channel_difference_cov,
    )
    return _Solved(alone.sensors, estimate, _examine(rig, detections, alone.sensors, estimate), together)


def _with_scene(rig: Rig, solved: _Solved, share: SceneShare) -> _Solved:
    """Take the extrinsics of boards and scene; the checks on the boards' own result stay as they are."""
    if share.state != "used":
        return replace(solved, share=share)
    estimate = fuse(solved.estimate, share, rig.board.to_board())
    validation = replace(solved.validation, cov=share.cov)
    return _Solved(solved.sensors, estimate, validation, share=share)


def _other_camera(solved: Sequence[_Solved], link: _Link, k: int) -> OtherCamera:
    """State the pose of the other camera of a link relative to the camera of index k."""
    pair, is_second = link.pair, k == link.second
    own, other = solved[k], solved[link.first if is_second else link.second]
    T, J = relative_pose(own.estimate.T_cam_lidar, other.estimate.T_cam_lidar)
    cov = None
    if own.together is not None and own.together is other.together:
        # Widened like both extrinsics.
        J = J * np.repeat([own.validation.widened_by, other.validation.widened_by], 6)
        both = own.together.covariance_of(own.sensors.camera, other.sensors.camera)
        cov = np.asarray(J @ both @ J.T)
    seen = None if pair.from_images is None else pair.from_images.T_second_first
    apart_deg, apart_m = (None, None) if pair.apart is None else tangent_sizes(pair.apart)
    return OtherCamera(
        camera=other.sensors.camera,
        n_captures=len(pair.captures),
        T_cam_other=T,
        cov=cov,
        T_cam_other_pictures=seen if seen is None or is_second else invert(seen),
        apart_rotation_deg=apart_deg,
        apart_translation_m=apart_m,
        board_rms_m=pair.board_rms_m,
    )


def _examine(
    rig: Rig, detections: Detections, sensors: _Sensors, estimate: CalibrationEstimate
) -> Validation:
    """Check an estimate on its own captures and images."""
    used = sorted(estimate.captures_of(estimate.used))
    channels = {channel.channel for channel in estimate.channels}
    views = []
    for name in used:
        for pair in sensors.pairs:
            image = detections.images[pair.camera, pair.channel].get(name)
            if pair.channel in channels and isinstance(image, ImageBoard):
                views.append(BoardView(name, pair.channel, image))
    lens = rig.cameras[sensors.camera].to_intrinsics()
    return validate(estimate, rig, rig.lidars[sensors.lidar], lens, views)


def _judged(
    rig: Rig, detections: Detections, solved: Sequence[_Solved], links: Sequence[_Link], k: int
) -> Calibration:
    """Judge the extrinsics of index k and assemble their result."""
    sensors, estimate, validation = solved[k].sensors, solved[k].estimate, solved[k].validation
    camera, lidar = sensors.camera, sensors.lidar
    mine = [link for link in links if k in (link.first, link.second)]
    others = [finding for link in mine for finding in link.findings]
    share = solved[k].share
    if share is not None:
        others += share_findings(share)
    n_captures = len({name for pair in sensors.pairs for name in detections.captures(pair)})
    verdict, findings = judge(estimate, validation, rig, camera, lidar, n_captures, others)
    lens = rig.cameras[camera].to_intrinsics()
    lens_error, lens_error_sigma = _lens_error(validation)
    laser_range_m, laser_range_sigma_m = _laser_ranges(rig, solved[k])
    return Calibration(
        camera=camera,
        channels=tuple(channel.channel for channel in estimate.channels),
        lidar=lidar,
        T_cam_lidar=estimate.T_cam_lidar,
        cov=validation.cov,
        cov_shared=validation.cov_shared,
        contributions=validation.contributions,
        certificate=estimate.certificate,
        metrics=estimate.metrics,
        n_captures=n_captures,
        n_detected=n_captures - len(sensors.refused),
        captures_used=tuple(sorted(estimate.captures_of(estimate.used))),
        captures_refused=_still_refused(estimate, sensors.refused),
        verdict=verdict,
        findings=findings,
        diagnostics=_diagnostics(estimate, validation),
        channel_results=estimate.channels,
        method=estimate.method,
        uncertainty=point_uncertainties(estimate.T_cam_lidar, validation.cov, lens),
        estimated_with=estimate.estimated_with,
        other_cameras=tuple(_other_camera(solved, link, k) for link in mine),
        scene_share=share,
        weakest=find_weakest(validation.cov, estimate.lever_m),
        held_out_m=estimate.held_out_m,
        residuals=estimate.residuals,
        observations=estimate.observations,
        lens_error=lens_error,
        lens_error_sigma=lens_error_sigma,
        laser_range_m=laser_range_m,
        laser_range_sigma_m=laser_range_sigma_m,
    )


def _lens_error(validation: Validation) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Give the errors of the profile's intrinsics as the boards see them, and their standard deviations."""
    check = validation.intrinsics
    if check is None or check.errors is None or check.errors_cov is None:
        return (), ()
    return check.errors, tuple(np.sqrt(np.diag(np.array(check.errors_cov))).tolist())


def _laser_ranges(rig: Rig, solved: _Solved) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Give the range offset of each laser, by ring, and its standard deviation about their mean.

    Nothing where boards moved, which would make them up, or where the profile states them already.
    """
    estimate, settings = solved.estimate, rig.lidars[solved.lidar]
    found, sheet = estimate.lidar, settings.data_sheet()
    is_known = settings.intrinsics is not None or settings.laser_bias_sigma_m == 0
    has_moved = not solved.is_still or estimate.diagnostics.fit_plane_rms_m > rig.verdict.max_plane_misfit_m
    if found is None or sheet is None or found.rings.max() >= sheet.n_rings or is_known or has_moved:
        return (), ()
    # Lasers that met no board are known as well as before.
    range_m = np.full(sheet.n_rings, found.lasers[0].mean())
    sigma_m = np.full(sheet.n_rings, settings.laser_bias_sigma_m)
    range_m[found.rings], sigma_m[found.rings] = found.lasers[0], found.lasers_sigma[0]
    return tuple(range_m.tolist()), tuple(sigma_m.tolist())


def _diagnostics(estimate: CalibrationEstimate, validation: Validation) -> Diagnostics:
    """Add what the validation and the comparison of channels found."""
    figures = estimate.diagnostics
    if validation.widened_by != 1:
        figures = replace(figures, sigma_widened=validation.widened_by)
    if estimate.channel_difference is None:
        return figures
    rotation_deg, translation_m = tangent_sizes(estimate.channel_difference)
    return replace(figures, channels_rotation_deg=rotation_deg, channels_translation_m=translation_m)


def _still_refused(estimate: CalibrationEstimate, refused: Mapping[str, Refusal]) -> dict[str, Refusal]:
    """List refusals by capture, except those for which another channel of the same scan is usable."""
    used = estimate.captures_of(estimate.used)
    every = dict(refused)
    for name, why in estimate.refused.items():
        every |= dict.fromkeys(estimate.captures_of([name]), why)
    return {name: every[name] for name in sorted(every) if name not in used}


def _compared(calibration: Calibration, reference: Reference | None) -> Calibration:
    """Report the error from a reference T_cam_lidar, if there is one."""
    truth = reference.of(calibration.camera, calibration.lidar) if reference else None
    if truth is None:
        return calibration
    rotation_deg, translation_m = error_to_reference(calibration.T_cam_lidar, truth)
    return replace(calibration, egt_rotation_deg=rotation_deg, egt_translation_m=translation_m)


def clocks_of(rig: Rig, camera: str, lidar: str) -> Clocks:
    """Read the time settings of a camera and a LiDAR from the profile."""
    stamps = {name: channel.timestamps for name, channel in rig.cameras[camera].channels.items()}
    return Clocks(
        sweep_s=1 / rig.lidars[lidar].rate_hz,
        lidar_offset_s=rig.lidars[lidar].timestamps.expected_offset_s,
        channel_offset_s={name: settings.expected_offset_s for name, settings in stamps.items()},
        tolerance_s={name: settings.tolerance_s for name, settings in stamps.items()},
    )
