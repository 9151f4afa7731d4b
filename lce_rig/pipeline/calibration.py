"""Estimate and judge the extrinsics of every camera with every LiDAR of a session.

detections -> estimate of each camera with each LiDAR, and of every two LiDARs or two cameras (`peer_pairs`)
-> all sensors that agree, as one (`rig_estimate`) -> checks, verdict -> the scene's opinion
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations, product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lce_rig.calibrate import (
    CalibrateOptions,
    CalibrationEstimate,
    Clocks,
    EstimateSettings,
    estimate_extrinsics,
)
from lce_rig.calibrate.findings import FEW_AGREE, UNDETERMINED
from lce_rig.calibrate.options import Tolerances
from lce_rig.calibrate.result import error_to_reference, squares_scale
from lce_rig.calibrate.rig_estimate import RigResult, SensorPair, estimate_rig
from lce_rig.calibrate.session_lens import SessionLens, fit_session_lens
from lce_rig.collect.guidance.planner import plan_captures
from lce_rig.core.calibration import Calibration, OtherCamera
from lce_rig.core.errors import NotEnoughDataError, UsageError, join_shortages
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.geometry import relative_pose, tangent_sizes
from lce_rig.core.progress import Progress, begin, silent
from lce_rig.core.results import ImageBoard, Observation
from lce_rig.detect.detection import Detections, Pair
from lce_rig.detect.findings import IMAGE_MISFIT
from lce_rig.export.extrinsics import Reference
from lce_rig.judge.findings import EXCHANGED, lacks_captures
from lce_rig.judge.moved_sensor import PairCosts, find_moved_sensor, with_motion
from lce_rig.judge.reach import point_uncertainties, with_lens
from lce_rig.judge.sensor_pairs import (
    CameraEvidence,
    CameraPair,
    Loop,
    camera_findings,
    find_exchanged_cameras,
    loop_findings,
    relate,
)
from lce_rig.judge.session_check import find_meetings
from lce_rig.judge.validate import Validation, validate
from lce_rig.judge.verdict import judge, with_opinion
from lce_rig.lens.lens_estimate import BoardView
from lce_rig.pipeline.detect_session import boards_in, detect_boards
from lce_rig.pipeline.findings import (
    CHANNEL_REJECTED,
    FEW_DETECTED,
    LIDAR_ABSENT,
    SENSOR_DISAGREES,
    SHORTAGE,
    UNCONNECTED,
    absent_channels,
    few_detected,
)
from lce_rig.pipeline.peer_pairs import (
    SolvedPeers,
    find_named,
    judged_peers,
    solve_peers,
    with_estimate,
)
from lce_rig.pipeline.result_files import Result
from lce_rig.pipeline.witness import hear_scene
from lce_rig.rig import Rig
from lce_rig.session import Session
from lce_rig.show.overlays.canvas import Thumbnails


@dataclass(frozen=True, eq=False)
class _Solved:
    """One camera with one LiDAR, and the result of their captures.

    Attributes:
        pairs: channels of the camera with the LiDAR.
        settings: the user's options, with the LiDAR's properties from the profile.
        refused: why captures without the board in both sensors are unusable.
        estimate: estimate of the extrinsics.
        validation: validation of the estimate on the camera's own captures and images.
        lacking: reasons why channels of the camera are not included.
        together: the joint estimate that includes it; None if it was estimated separately.
    """

    pairs: tuple[Pair, ...]
    settings: EstimateSettings
    refused: Mapping[str, Refusal]
    estimate: CalibrationEstimate
    validation: Validation
    lacking: tuple[Finding, ...] = ()
    together: RigResult | None = None

    @property
    def camera(self) -> str:
        return self.pairs[0].camera

    @property
    def lidar(self) -> str:
        return self.pairs[0].lidar

    @property
    def is_still(self) -> bool:
        """Whether boards stood still, so that images need no motion compensation."""
        return all(channel.time_offset_s is None for channel in self.estimate.channels)

    @property
    def costs(self) -> PairCosts:
        """Costs of the captures, which reveal a motion of either sensor."""
        return PairCosts.of((self.camera, self.lidar), self.estimate, self.validation)

    def evidence(self, detections: Detections) -> CameraEvidence:
        """List the figures that identify the camera, with its boards in the captures used."""
        channels = [channel.channel for channel in self.estimate.channels]
        views = []
        for name in sorted(self.estimate.captures_of(self.estimate.used)):
            for channel in (pair.channel for pair in self.pairs if pair.channel in channels):
                image = detections.images[self.camera, channel].get(name)
                if isinstance(image, ImageBoard):
                    views.append(BoardView(name, channel, image))
        T, validation = self.estimate.T_cam_lidar, self.validation
        return CameraEvidence(self.camera, T, validation.cov, views, validation.intrinsics)


class _Link(NamedTuple):
    """Two cameras that share a LiDAR.

    Attributes:
        members: indices of the cameras among those with an estimate.
        pair: both compared by the still boards that both saw; None without any.
        contradictions: contradictions between their images and extrinsics.
        exchanged: whether the images of the two are exchanged.
    """

    members: tuple[int, int]
    pair: CameraPair | None
    contradictions: list[Finding]
    exchanged: list[Finding]

    def sensors(self, solved: Sequence[_Solved]) -> set[str]:
        """Name both cameras and their LiDAR."""
        return {name for k in self.members for name in (solved[k].camera, solved[k].lidar)}


def calibrate_session(
    session: Session | str | Path,
    detections: Detections | None = None,
    *,
    options: CalibrateOptions | None = None,
    cameras: Sequence[str] | None = None,
    channels: Sequence[str] | None = None,
    reference: Reference | None = None,
    progress: Progress = silent,
    thumbnails: Thumbnails | None = None,
) -> Result:
    """Estimate and judge the extrinsics of every camera with every LiDAR, and of every two LiDARs.

    Nothing is written.

    Args:
        session: folder of the session, or a session open for reading.
        detections: detections of the session; None to run `detect_boards` with its defaults.
        options: options of the estimate; None for the defaults.
        cameras: the cameras to calibrate, as if the session held no others; None for all.
        channels: the cameras' channels to use; None for all in the session.
        reference: extrinsics to report errors against; neither estimate nor verdict uses them.
        progress: called with (done, total) for each camera and LiDAR in turn.
        thumbnails: images from `detect_boards`, for the report; missing ones are decoded again.

    Raises:
        NotEnoughDataError: every pair has too few captures or an undetermined direction; the causes are
            named.
        UsageError: no capture holds one of the channels.
    """
    thumbnails = {} if thumbnails is None else thumbnails
    session = session if isinstance(session, Session) else Session.open(session)
    if detections is None:
        detections = detect_boards(session, thumbnails=thumbnails)
    calibrations, shortages = calibrate_detections(
        session.rig,
        detections,
        options,
        cameras=cameras,
        channels=channels,
        progress=progress,
    )
    begin(progress, "comparing with the scene")
    judged = []
    for c in calibrations:
        truth = None if reference is None else reference.of(c.camera, c.lidar)
        if truth is not None:
            rotation_deg, translation_m = error_to_reference(c.T_cam_lidar, truth)
            c = replace(c, egt_rotation_deg=rotation_deg, egt_translation_m=translation_m)
        if c.is_of_peers:
            judged.append(c)
            continue
        c = with_opinion(c, hear_scene(session, detections, c, thumbnails))
        if lacks_captures(c.findings):
            held = boards_in(detections, c.camera, c.lidar, c.captures_used)
            c = replace(c, findings=(*c.findings, *plan_captures(session.rig, c.camera, c.lidar, held, c)))
        judged.append(c)
    return Result(session, tuple(judged), tuple(shortages), thumbnails)


def calibrate_detections(
    rig: Rig,
    detections: Detections,
    options: CalibrateOptions | None = None,
    *,
    cameras: Sequence[str] | None = None,
    channels: Sequence[str] | None = None,
    progress: Progress = silent,
) -> tuple[list[Calibration], list[Finding]]:
    """Estimate and judge the extrinsics of every camera with every LiDAR from their detections.

    Channels of one camera share pixels and lens: together they give one set of extrinsics. Sensors that saw
    the same boards are compared with each other, and with method "ml" estimated as one.

    Args:
        rig: thresholds, targets and nominal extrinsics.
        detections: detections of one session.
        options, cameras, channels, progress: see `calibrate_session`.

    Returns:
        The calibrated sensors, and for each other pair the cause.

    Raises:
        NotEnoughDataError: every pair has too few captures or an undetermined direction; the causes are
            named.
        UsageError: no capture holds one of the channels.
    """
    alone: list[_Solved] = []
    shortages: list[Finding] = []
    groups = _pairs_by_sensors(detections, cameras, channels)
    absent = absent_channels(rig, detections, channels)
    shared = _shared_lenses(rig, detections, groups)
    for pairs in groups:
        lens = shared.get(pairs[0].camera)
        try:
            pair = _solve(rig, detections, pairs, options or CalibrateOptions(), lens, progress)
            notes = [replace(each, severity="note") for each in absent.get(pair.camera, ())]
            alone.append(replace(pair, lacking=(*pair.lacking, *notes)))
        except NotEnoughDataError as error:
            shortage = error.finding or SHORTAGE(text=error.what, advice=error.hint)
            sensors = pairs[0].camera, pairs[0].lidar
            shortage = replace(shortage, figures={**shortage.figures, "sensors": sensors})
            if shortage.code in (FEW_DETECTED.code, UNDETERMINED.code):
                held = boards_in(detections, pairs[0].camera, pairs[0].lidar)
                for plan in plan_captures(rig, pairs[0].camera, pairs[0].lidar, held):
                    where = tuple(plan.figures[key] for key in ("n_captures", "is_enough", "placements"))
                    shortage = replace(shortage, figures={**shortage.figures, "where": where})
            shortages.append(
                shortage if shortage.subject else replace(shortage, subject=" and ".join(sensors))
            )
    between: list[SolvedPeers] = []
    if cameras is None and channels is None:
        # A camera has one lens: that of its pair with the most captures.
        by_size = sorted(alone, key=lambda own: len(own.estimate.used))
        lenses = {own.camera: own.estimate.lens for own in by_size}
        peers = detections.peers(rig.lidars, with_lidar=lenses)
        between, lacking = solve_peers(
            rig, detections, peers, options or CalibrateOptions(), lenses, progress
        )
        shortages += lacking
    if not alone and not between and not shortages:
        of_cameras = f" of {' or '.join(cameras)}" if cameras else ""
        raise NotEnoughDataError(
            f"the session has no capture with an image{of_cameras} and a scan, or of two sensors of a kind",
            "Collect captures first.",
        )
    if not alone and not between:
        raise join_shortages([NotEnoughDataError.of(shortage) for shortage in shortages])
    if len(alone) + len(between) > 1:
        begin(progress, "comparing and joining sensors")
    costs = [own.costs for own in alone] + [own.costs for own in between]
    moved, excluded = find_moved_sensor(costs), set[SensorPair]()
    links, loops = _compare(rig, detections, alone), _open_loops(rig, alone, between)
    if moved is not None:
        # Contradictions of its pairs follow from its motion.
        links = [
            link._replace(contradictions=[]) if moved.name in link.sensors(alone) else link for link in links
        ]
        loops = [(loop, finding) for loop, finding in loops if moved.name not in loop.names]
        excluded = {pair.sensors for pair in costs if moved.is_within(pair)}
    solved, between = _solve_together(rig, detections, alone, between, links, loops, excluded)
    solved = [replace(own, validation=with_motion(own.validation, own.costs, moved)) for own in solved]
    between = [replace(own, validation=with_motion(own.validation, own.costs, moved)) for own in between]
    named = [(own.names, finding) for own in between for finding in find_named(rig, detections, own)]
    calibrations = [_judged(rig, detections, solved, links, loops, named, k) for k in range(len(solved))]
    for own in between:
        others = [f for loop, f in loops if own.names in loop.pairs]
        others += [finding for names, finding in named if names == own.names]
        calibrations.append(judged_peers(rig, own, others))
    if cameras is None and channels is None:
        shortages = [*_without_disagreeing(shortages), *_unconnected(rig, detections, calibrations)]
    return calibrations, shortages


def _without_disagreeing(shortages: Sequence[Finding]) -> list[Finding]:
    """Report a sensor whose captures agree with no other one, instead of its pairs."""
    sensors = [each.figures.get("sensors") for each in shortages if each.code == FEW_AGREE.code]
    pairs = [{str(name) for name in pair} for pair in sensors if isinstance(pair, tuple)]
    counts = Counter(name for pair in pairs for name in pair)
    odd = [name for name, n in counts.most_common(1) if n == len(pairs) > 1]
    if not odd:
        return list(shortages)
    (name,) = odd
    others = ", ".join(sorted(set().union(*pairs) - {name}))
    kept = [each for each in shortages if each.code != FEW_AGREE.code]
    return [SENSOR_DISAGREES(name, others=others), *kept]


def _unconnected(rig: Rig, detections: Detections, calibrations: Sequence[Calibration]) -> list[Finding]:
    """List LiDARs without captures, and groups of sensors not connected with the first one's by placements.

    A placement seen by the two sensors that already share the most captures would connect them.
    """
    absent = [LIDAR_ABSENT(name) for name in rig.lidars if name not in detections.lidars]
    held: dict[str, set[str]] = {name: set(found) for name, found in detections.lidars.items()}
    for (camera, _), found in detections.images.items():
        held.setdefault(camera, set()).update(found)
    order = [name for name in (*rig.lidars, *rig.cameras) if name in held]
    groups = _connected((c.camera, c.lidar) for c in calibrations)
    names = [sorted({name for pair in group for name in pair}, key=order.index) for group in groups]
    names += [[name] for name in order if not any(name in group for group in names)]
    first, *others = sorted(names, key=lambda group: order.index(group[0]))
    findings = []
    for group in others:
        near, far = max(product(first, group), key=lambda pair: len(held[pair[0]] & held[pair[1]]))
        if held[near] & held[far]:
            continue  # The pair's own shortage is reported.
        findings.append(
            UNCONNECTED(
                " and ".join(group),
                others=" and ".join(first),
                first=near,
                second=far,
                n_needed=rig.quality.min_captures,
            )
        )
    return [*absent, *findings]


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
    groups: dict[tuple[str, str], list[Pair]] = {}
    for pair in detections.pairs:
        if (cameras is None or pair.camera in cameras) and (channels is None or pair.channel in channels):
            groups.setdefault((pair.camera, pair.lidar), []).append(pair)
    return list(groups.values())


def _shared_lenses(
    rig: Rig, detections: Detections, groups: Sequence[Sequence[Pair]]
) -> dict[str, SessionLens]:
    """Fit the lens of each camera with several LiDARs once: with different lenses, extrinsics are rotated."""
    n_lidars = Counter(pairs[0].camera for pairs in groups)
    seen: dict[str, dict[str, dict[str, ImageBoard]]] = {}
    for pair in (pair for pairs in groups for pair in pairs if n_lidars[pair.camera] > 1):
        found, _ = detections.candidates(pair, rig.board.to_board())
        if len(found) >= rig.quality.min_captures:
            of_channel = seen.setdefault(pair.camera, {}).setdefault(pair.channel, {})
            of_channel.update({each.capture: each.image for each in found})
    lenses = {}
    for camera, by_channel in seen.items():
        prior = Tolerances.of(rig.cameras[camera], rig.board).lens
        images = {name: [by[c] for c in sorted(by)] for name, by in by_channel.items()}
        # A pair reports why its lens cannot be fitted once it is estimated.
        with suppress(NotEnoughDataError):
            if not prior.is_exact:
                lenses[camera] = fit_session_lens(images, rig.board.to_board(), prior)
    return lenses


def _solve(
    rig: Rig,
    detections: Detections,
    pairs: Sequence[Pair],
    options: CalibrateOptions,
    lens: SessionLens | None,
    progress: Progress,
) -> _Solved:
    """Estimate the extrinsics of one camera and LiDAR from their own captures, with a lens if it is known.

    Raises:
        NotEnoughDataError: no channel has enough captures with both boards, or a direction is undetermined.
    """
    camera, lidar, n_needed = pairs[0].camera, pairs[0].lidar, rig.quality.min_captures
    candidates: dict[str, list[Observation]] = {}
    refused: dict[str, Refusal] = {}
    shortages: list[Finding] = []
    for pair in pairs:
        of_channel, own_refused = detections.candidates(pair, rig.board.to_board())
        refused = {**own_refused, **refused}
        if len(of_channel) >= n_needed:
            candidates[pair.channel] = of_channel
            continue
        shortages.append(few_detected(str(pair), len(of_channel), own_refused, n_needed))
    if not candidates:
        raise NotEnoughDataError.of(max(shortages, key=lambda shortage: shortage.figure("n_detected")))
    detected = {item.capture for items in candidates.values() for item in items}
    refused = {name: why for name, why in refused.items() if name not in detected}
    tolerances = Tolerances.of(rig.cameras[camera], rig.board)
    settings = replace(EstimateSettings.of(options, rig.lidars[lidar], tolerances), lens=lens)
    clocks = Clocks.of(rig, camera, lidar)
    estimate = estimate_extrinsics(candidates, rig.board.to_board(), settings, clocks, progress)
    kept = {channel.channel for channel in estimate.channels} or set(candidates)
    rejected = [name for name in candidates if name not in kept]
    shortages += [CHANNEL_REJECTED(f"{camera}.{name}", channel=name) for name in rejected]
    lacking = tuple(replace(shortage, severity="note") for shortage in shortages)
    begin(progress, f"checking {camera} and {lidar}")
    validation = _examine(rig, detections, pairs, estimate)
    return _Solved(tuple(pairs), settings, refused, estimate, validation, lacking)


def _examine(
    rig: Rig, detections: Detections, pairs: Sequence[Pair], estimate: CalibrationEstimate
) -> Validation:
    """Check an estimate on its own captures and images."""
    first, used = pairs[0], estimate.captures_of(estimate.used)
    lens = rig.cameras[first.camera].to_intrinsics()
    rejected = []
    if estimate.refused:
        # Of several channels, the first shows the boards.
        channels = [channel.channel for channel in estimate.channels]
        pair = next(pair for pair in pairs if pair.channel in channels)
        meetings = find_meetings(rig, detections, pair, estimate.T_cam_lidar, estimate.channels)
        rejected = [each.at_scan_time for name, each in meetings.items() if name not in used]
        if estimate.lens is not None and rejected:
            rejected = estimate.lens.refit(rejected)
    return validate(estimate, rig, first.camera, first.lidar, lens, rejected)


def _compare(rig: Rig, detections: Detections, solved: Sequence[_Solved]) -> list[_Link]:
    """Compare the cameras of each LiDAR by their common still boards, and test for exchanged names."""
    links = []
    for members in combinations(range(len(solved)), 2):
        one, other = (solved[k] for k in members)
        if one.lidar != other.lidar:
            continue
        # Contradicting captures widen a method's covariance; that must not hide the contradiction.
        pair = relate(one.estimate, other.estimate) if one.is_still and other.is_still else None
        names = one.camera, other.camera
        findings = [] if pair is None else camera_findings(pair, names, rig.calibration)
        exchanged = find_exchanged_cameras(
            rig, one.lidar, one.evidence(detections), other.evidence(detections)
        )
        links.append(_Link(members, pair, findings, exchanged))
    return links


def _open_loops(
    rig: Rig, alone: Sequence[_Solved], between: Sequence[SolvedPeers]
) -> list[tuple[Loop, Finding]]:
    """List loops of three sensors whose separately estimated poses contradict each other.

    Loops with a pair whose own captures contradict each other are skipped: those explain the contradiction.
    """
    poses = {
        (own.camera, own.lidar): (own.estimate.T_cam_lidar, own.validation.cov)
        for own in alone
        if _is_sound(own.validation)
    }
    poses |= {own.names: (own.T_first_second, own.cov) for own in between if _is_sound(own.validation)}
    loops = [
        Loop((a, b, c), poses[a, b], poses[b, c], poses[a, c])
        for a, b in poses
        for d, c in poses
        if d == b and (a, c) in poses
    ]
    return [(loop, finding) for loop in loops for finding in loop_findings(loop, rig.calibration)]


def _solve_together(
    rig: Rig,
    detections: Detections,
    alone: Sequence[_Solved],
    between: Sequence[SolvedPeers],
    links: Sequence[_Link],
    loops: Sequence[tuple[Loop, Finding]],
    excluded: Set[SensorPair],
) -> tuple[list[_Solved], list[SolvedPeers]]:
    """Estimate sensors that agree jointly; leave the others unchanged.

    A sensor that contradicts another, or its own captures, is excluded, as it would corrupt the others'
    extrinsics. So are the pairs given as such, and method "paper", which gives Algorithm 1's solution.
    """
    excluded = excluded | {pair for loop, _ in loops for pair in loop.pairs}
    excluded |= {
        (alone[k].camera, alone[k].lidar)
        for link in links
        if link.contradictions
        for k in _suspects(alone, link)
    }
    cameras = {
        (own.camera, own.lidar): own
        for own in alone
        if own.settings.method == "ml" and own.is_still and _is_sound(own.validation)
    }
    lidars = {own.names: own for own in between if _is_sound(own.validation)}
    sound = (cameras.keys() | lidars.keys()) - excluded
    solved, solved_lidars = list(alone), list(between)
    for pairs in _connected(sound):
        if len(pairs) < 2:
            continue
        together = estimate_rig(
            {pair: cameras[pair].estimate for pair in pairs if pair in cameras},
            {pair: lidars[pair].given for pair in pairs if pair in lidars},
            rig.board.to_board(),
            list(rig.lidars),
        )
        for k, own in enumerate(alone):
            if (own.camera, own.lidar) in pairs:
                estimate = together.estimates[own.camera, own.lidar]
                validation = _examine(rig, detections, own.pairs, estimate)
                solved[k] = replace(own, estimate=estimate, validation=validation, together=together)
        for k, two in enumerate(between):
            if two.names in pairs:
                solved_lidars[k] = with_estimate(rig, two, together.estimates[two.names])
    return solved, solved_lidars


def _suspects(solved: Sequence[_Solved], link: _Link) -> tuple[int, ...]:
    """Choose the cameras affected by a contradiction of two: one with contradicting captures, or both."""
    unsound = tuple(k for k in link.members if not _is_sound(solved[k].validation))
    return unsound or link.members


def _is_sound(validation: Validation) -> bool:
    """Check that no contradiction between captures fails the result."""
    return all(cause.severity != "error" for cause in validation.causes)


def _connected(pairs: Iterable[SensorPair]) -> list[list[SensorPair]]:
    """Group pairs connected by common sensors, sorted."""
    groups: list[tuple[set[str], list[SensorPair]]] = []
    for pair in sorted(pairs):
        touched = [group for group in groups if group[0] & set(pair)]
        groups = [group for group in groups if not group[0] & set(pair)]
        names = set(pair).union(*(group[0] for group in touched))
        groups.append((names, sorted([pair, *(each for group in touched for each in group[1])])))
    return [members for _, members in groups]


def _judged(
    rig: Rig,
    detections: Detections,
    solved: Sequence[_Solved],
    links: Sequence[_Link],
    loops: Sequence[tuple[Loop, Finding]],
    named: Sequence[tuple[SensorPair, Finding]],
    k: int,
) -> Calibration:
    """Judge the extrinsics of index k and assemble their result."""
    own, estimate, validation = solved[k], solved[k].estimate, solved[k].validation
    mine = [link for link in links if k in link.members]
    exchanged = [finding for link in mine for finding in link.exchanged]
    if not exchanged:
        # Cameras are exchanged in their pairs with every LiDAR.
        of_camera = [link for link in links if own.camera in link.sensors(solved)]
        exchanged = [finding for link in of_camera for finding in link.exchanged][:1]
    others = [*estimate.association, *exchanged]
    others += [finding for link in mine if k in _suspects(solved, link) for finding in link.contradictions]
    others += [finding for loop, finding in loops if (own.camera, own.lidar) in loop.pairs]
    # Exchanged LiDARs exchange their cameras' extrinsics, too.
    others += [finding for names, finding in named if own.lidar in names and finding.code == EXCHANGED.code]
    others += own.lacking
    n_captures = len({name for pair in own.pairs for name in detections.captures(pair)})
    n_misfits = sum(why.code == IMAGE_MISFIT.code for why in own.refused.values())
    verdict, findings = judge(
        estimate, validation, rig, own.camera, own.lidar, n_captures, others, n_misfits=n_misfits
    )
    used = estimate.captures_of(estimate.used)
    refused = dict(own.refused)
    for name, why in estimate.refused.items():
        refused |= dict.fromkeys(estimate.captures_of([name]), why)
    lens = None if estimate.lens is None else estimate.lens.intrinsics
    square_m = rig.board.square_m * squares_scale(estimate.diagnostics)
    cov_lens = np.zeros((0, 0)) if estimate.lens is None else estimate.lens.estimate.cov
    cross = estimate.cov_with_lens
    distances_m = [np.linalg.norm(o.pose.T_cam_board[:3, 3]) for o in estimate.observations.values()]
    return Calibration(
        camera=own.camera,
        channels=tuple(channel.channel for channel in estimate.channels),
        lidar=own.lidar,
        T_cam_lidar=estimate.T_cam_lidar,
        cov=validation.cov,
        cov_shared=validation.cov_shared,
        contributions=validation.contributions,
        certificate=estimate.certificate,
        metrics=estimate.metrics,
        n_captures=n_captures,
        n_detected=n_captures - len(own.refused),
        captures_used=tuple(sorted(used)),
        # A capture counts as used if another channel with the same scan is used.
        captures_refused={name: refused[name] for name in sorted(refused) if name not in used},
        verdict=verdict,
        findings=findings,
        diagnostics=estimate.diagnostics,
        channel_results=estimate.channels,
        method=estimate.method,
        uncertainty=point_uncertainties(
            estimate.T_cam_lidar,
            with_lens(validation.cov, cross, cov_lens),
            lens or rig.cameras[own.camera].to_intrinsics(),
        ),
        intrinsics=lens,
        intrinsics_cov=None if lens is None else cov_lens,
        intrinsics_cross_cov=None if lens is None else cross,
        square_m=None if lens is None else square_m,
        board_shape=None if estimate.lens is None else estimate.lens.estimate.shape,
        estimated_with=estimate.estimated_with,
        other_cameras=tuple(
            _other_camera(solved, k, next(i for i in link.members if i != k), link.pair)
            for link in mine
            if link.pair is not None
        ),
        board_distances_m=tuple(np.quantile(distances_m, (0.1, 0.9)).tolist()),
        residuals=estimate.residuals,
        observations=estimate.observations,
    )


def _other_camera(solved: Sequence[_Solved], k: int, other_k: int, pair: CameraPair) -> OtherCamera:
    """State the pose of another camera relative to the camera of index k."""
    own, other = solved[k], solved[other_k]
    T, cov = relative_pose(own.estimate.T_cam_lidar, other.estimate.T_cam_lidar)[0], None
    if own.together is not None and own.together is other.together:
        T, cov = own.together.between(own.camera, other.camera)
    apart_deg, apart_m = (None, None) if pair.apart is None else tangent_sizes(pair.apart.tangent)
    return OtherCamera(
        camera=other.camera,
        n_captures=len(pair.captures),
        T_cam_other=T,
        cov=cov,
        apart_rotation_deg=apart_deg,
        apart_translation_m=apart_m,
        board_rms_m=pair.board_rms_m,
    )
