"""Estimate extrinsics without a board: correct the profile's nominal pose by the edges of a scene.

recordings -> views spread over them, stored as captures of a session -> estimate of each camera with each
LiDAR -> checks, verdict, overlays
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lce_rig.core.calibration import BY_SCENE, MOTIONS, Calibration, Certificate, Metrics
from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.errors import (
    NotEnoughDataError,
    ProfileError,
    SessionError,
    SourceError,
    join_shortages,
)
from lce_rig.core.findings import Finding, Losses
from lce_rig.core.geometry import Array, sigma_sizes
from lce_rig.core.progress import Progress, begin, silent
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.io import open_recordings
from lce_rig.io.folder import FolderRecording, read_pairs
from lce_rig.io.recording import ContinuousRecording, join_recordings, read_samples, require_sensors
from lce_rig.judge.reach import point_uncertainties, with_lens
from lce_rig.judge.verdict import nominal_findings, with_findings
from lce_rig.lens.difference import turn_of_lens
from lce_rig.lens.models import LensPrior, model_of
from lce_rig.pipeline.findings import (
    SCENE_AMBIGUOUS,
    SCENE_BEYOND_REACH,
    SCENE_DARK,
    SCENE_EVENTS_STAND,
    SCENE_FEW_EDGES,
    SCENE_LENS,
    SCENE_MOVING,
    SCENE_NO_VIEWS,
    SCENE_ONE_PLACE,
    SCENE_TYPICAL,
    SCENE_UNCERTAIN,
    SCENE_UNDETERMINED,
    SCENE_WEAK,
)
from lce_rig.pipeline.result_files import Result
from lce_rig.pipeline.scene_samples import (
    Thinned,
    at_image,
    channel_of,
    events_at_scans,
    image_or_events,
    moving,
    picture_of,
    read_events,
)
from lce_rig.rig import NominalExtrinsic, Rig
from lce_rig.scene.estimate import (
    MIN_SCORE,
    SceneEstimate,
    estimate_scene,
    find_better_focal,
    follow_lens,
)
from lce_rig.scene.outline_score import OutlineView, build_outline_view
from lce_rig.scene.views import evenly
from lce_rig.session import Session
from lce_rig.session.identity import MARKER
from lce_rig.show.overlays.canvas import write_picture
from lce_rig.show.overlays.overlay import draw_edges
from lce_rig.timing.scan_pairing import EventCut, pair_by_time

OVERLAYS = "scene"
"""Folder of the overlays in the session."""
_MOST_VIEWS = 16  # Maximum number of views: more of one drive add time and little information.
_DARK = 40  # Grey value that 1 % of the pixels exceed in the brightest view: below it, images are dark.
# Correlation of small images above which views show one place, the median of all pairs: 0.63 to 1.0 in nine
# recordings of standing rigs, with people and boards that move, and 0.13 in twelve views of KITTI's drives.
_ALIKE, _SMALL_PX = 0.6, (32, 24)
_SCENE = "scene"  # Key of a capture's data: its place in the recording.


@dataclass(frozen=True, eq=False)
class View:
    """The samples at one time.

    Attributes:
        name: name of the capture that holds them.
        images, scans: of all sensors; scans as recorded.
        events: of each event camera without an image, while the scans were fired.
        previous: the scans before, by LiDAR; empty where the recording is not continuous.
    """

    name: str
    images: tuple[Image, ...]
    scans: tuple[Scan, ...]
    events: tuple[EventCut, ...] = ()
    previous: Mapping[str, Scan] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Drawn:
    """A view of one camera and LiDAR for overlays: the outlines under the named poses."""

    camera: str
    lidar: str
    image: Image
    view: OutlineView
    poses: Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class SceneResult:
    """Extrinsics from a scene.

    Attributes:
        result: the pairs, and for each other pair why the scene cannot tell; without any pair only these.
        drawn: each view of each pair.
        notes: what was assumed or could not be read, in words.
    """

    result: Result
    drawn: tuple[Drawn, ...]
    notes: tuple[str, ...]

    def write_overlays(self) -> list[Path]:
        """Draw each view's outlines under the nominal and the estimated pose, into SESSION/scene/.

        Raises:
            SessionError: a file cannot be written.
        """
        folder, rig = self.result.session.path / OVERLAYS, self.result.session.rig
        for each in self.drawn:
            for earlier in folder.glob(f"{each.camera}_{each.lidar}_*.png"):
                earlier.unlink(missing_ok=True)
        files = []
        for each in self.drawn:
            lens = rig.cameras[each.camera].to_intrinsics()
            title = f"{each.camera}, {each.lidar}  {each.view.capture}"
            picture = draw_edges(each.image, each.view.outlines, lens, each.poses, title)
            path = folder / f"{each.camera}_{each.lidar}_{each.view.capture}.png"
            files.append(write_picture(path, picture))
        return files

    def require_pairs(self) -> None:
        """Check that the scene determines a pair.

        Raises:
            NotEnoughDataError: it does not; the cause of each pair.
        """
        if not self.result.pairs:
            raise join_shortages([NotEnoughDataError.of(each) for each in self.result.shortages])


def calibrate_scene(
    recordings: Sequence[Path | str],
    session: Path | str,
    *,
    rig: Rig | None = None,
    cameras: Sequence[str] = (),
    progress: Progress = silent,
) -> SceneResult:
    """Estimate the extrinsics of every camera with every LiDAR from a scene without a board.

    Args:
        recordings: recordings of one time: folders of images and point clouds, bags, files; or one session.
        session: folder of the session that holds the views; is created. That of a session is the session.
        rig: the profile; None for that of the session.
        cameras: those to calibrate; empty for all.
        progress: called with (done, total) views.

    Raises:
        ProfileError: no pair has a nominal pose.
        SessionError: the session holds captures of a board, or cannot be written.
        SourceError: a recording cannot be read.
    """
    paths = [Path(each) for each in recordings]
    notes: list[str] = []
    if len(paths) == 1 and (paths[0] / MARKER).exists():
        opened = Session.open(paths[0])
        opened = opened if rig is None else opened.with_profile(rig)
        nominals = _nominals(opened.rig, cameras)
        views = list(_stored(opened))
    elif rig is None:
        raise SessionError(f"{paths[0]} is not a session", "Name the profile of its rig with --rig.")
    else:
        nominals = _nominals(rig, cameras)
        kept = _read(paths, rig, notes, progress)
        views = _store(kept, rig, Path(session))
        opened = Session.open(session)
    begin(progress, "estimating")
    pairs: list[Calibration] = []
    shortages: list[Finding] = []
    drawn: list[Drawn] = []
    for done, nominal in enumerate(nominals):
        progress(done, len(nominals))
        found, shown = calibrate_pair(opened.rig, nominal, views)
        if isinstance(found, Calibration):
            pairs.append(found)
        else:
            shortages.append(found)
        drawn += shown
    return SceneResult(Result(opened, tuple(pairs), tuple(shortages)), tuple(drawn), tuple(notes))


def _nominals(rig: Rig, cameras: Sequence[str]) -> list[NominalExtrinsic]:
    """List the nominal poses of cameras on LiDARs.

    Raises:
        ProfileError: there is none.
    """
    found = [
        nominal
        for camera in cameras or rig.cameras
        for lidar in rig.lidars
        if (nominal := rig.nominal(camera, lidar)) is not None
    ]
    if not found:
        raise ProfileError(
            f"rig {rig.name!r}: nominal_extrinsics has no pose of {' or '.join(cameras or rig.cameras)} and "
            f"{' or '.join(rig.lidars) or 'a LiDAR'}",
            "Enter the pose in nominal_extrinsics, to 2 deg and 20 cm: the search starts there.",
        )
    return found


def _read(paths: Sequence[Path], rig: Rig, notes: list[str], progress: Progress) -> list[View]:
    """Read views of recordings; damaged ones are skipped with a note.

    Raises:
        SourceError: a recording cannot be read at all.
    """
    kept: list[View] = []
    for recording in join_recordings(open_recordings(paths, rig), rig):
        if isinstance(recording, FolderRecording):
            kept += _of_folder(recording, notes, progress)
        elif isinstance(recording, ContinuousRecording):
            kept += _of_stream(recording, rig, progress)
        notes += recording.notes
    return kept


def _of_folder(recording: FolderRecording, notes: list[str], progress: Progress) -> Iterator[View]:
    for label, images, scans in read_pairs(evenly(recording.pairs, _MOST_VIEWS), notes, progress):
        yield View(label, images, scans)


def _of_stream(recording: ContinuousRecording, rig: Rig, progress: Progress) -> list[View]:
    require_sensors(recording, rig)
    losses, with_images, of_events = Losses(), Thinned[View](_MOST_VIEWS), Thinned[View](_MOST_VIEWS)
    previous: dict[str, Scan] = {}
    samples = read_samples(recording, rig, progress)
    for frame in pair_by_time(samples, rig, losses, are_events_enough=True):
        shown = {image.sensor for image in frame.images}
        unseen = [cut for cut in frame.events if cut.sensor not in shown]
        events = events_at_scans(unseen, frame.scans, rig)
        if frame.scans and (frame.images or events):
            name = f"{1e-9 * frame.time_ns:.2f} s"
            views = with_images if frame.images else of_events
            views.take(View(name, frame.images, frame.scans, events, previous))
        previous = {scan.sensor: scan for scan in frame.scans}
    kept = with_images or of_events  # Images show what stands still, too.
    if not kept and losses.counts():
        (why, n), *_ = losses.counts()
        raise SourceError(f"{recording.path}: {n} scans cannot be used: {why.text}")
    return kept


def _store(views: Sequence[View], rig: Rig, path: Path) -> list[View]:
    """Store views as captures of a session and return their names; existing captures stay.

    Raises:
        SessionError: the session is of another rig, holds captures of a board, or cannot be written.
    """
    if (path / MARKER).exists():
        with Session.open(path, writable=True) as session:
            if any(_SCENE not in capture.meta for capture in session.captures):
                raise SessionError(
                    f"{path} holds captures of a board",
                    "Name another folder: `lce-rig calibrate --scene RECORDING --rig FILE FOLDER`.",
                )
            session.adopt(rig)
    named = []
    with Session.resume(path, rig) as session:
        for view in views:
            events = [cut.events for cut in view.events]
            name = session.find_duplicate(view.images, view.scans, events)
            name = name or session.add_capture(view.images, view.scans, {_SCENE: view.name}, events)
            named.append(replace(view, name=name))
    return named


def _stored(session: Session) -> Iterator[View]:
    """Read views of a session, spread over it; damaged captures are skipped."""
    for capture in evenly(session.captures, _MOST_VIEWS):
        with suppress(SessionError):
            images = tuple(capture.image(*key) for key in capture.image_keys)
            scans = tuple(map(capture.scan, capture.lidars))
            yield View(capture.name, images, scans, read_events(capture, session.rig))


def calibrate_pair(
    rig: Rig, nominal: NominalExtrinsic, views: Sequence[View]
) -> tuple[Calibration | Finding, list[Drawn]]:
    """Estimate and judge the extrinsics of one camera and LiDAR; a finding if they are undetermined."""
    camera, lidar, T_nominal = nominal.camera, nominal.lidar, nominal.to_matrix()
    lens, settings = rig.cameras[camera].to_intrinsics(), rig.lidars[lidar]
    beam = Beam(settings.beam_aperture_m, settings.beam_divergence_rad)
    outlined: list[OutlineView] = []
    images: list[Image | Events] = []
    n_untimed, is_standing = 0, True
    for view in views:
        scan = next((rig.corrected(each) for each in view.scans if each.sensor == lidar), None)
        if scan is None:
            continue
        image = image_or_events(rig, camera, view.images, view.events, scan, lens, T_nominal)
        if image is None:
            continue
        built = build_outline_view(view.name, image, scan, beam, lens, T_nominal)
        previous = view.previous.get(lidar)
        motion = moving(None if previous is None else rig.corrected(previous), scan)
        if motion is not None:
            is_standing = False
            moved = at_image(built, motion, scan, image, rig)
            if moved is None:
                n_untimed += 1
                continue
            built = moved
        outlined.append(built)
        images.append(image)
    subject = f"{camera} and {lidar}"
    if not outlined:
        return (SCENE_MOVING if n_untimed else SCENE_NO_VIEWS)(subject, n_views=n_untimed), []
    estimate = estimate_scene(outlined, lens, T_nominal)
    shortage = _shortage(subject, estimate, images)
    if shortage is not None and is_standing and any(isinstance(each, Events) for each in images):
        shortage = SCENE_EVENTS_STAND(subject, n_views=len(outlined))
    pictures = [picture_of(image) for image in images]
    if shortage is None:
        change = find_better_focal(outlined, lens, estimate.T_cam_lidar)
        if change is not None:
            shortage = SCENE_LENS(subject, change=100 * change, n_views=len(outlined))
    poses = {"nominal": T_nominal} | ({} if shortage else {"estimated": estimate.T_cam_lidar})
    drawn = [Drawn(camera, lidar, *each, poses) for each in zip(pictures, outlined, strict=True)]
    if shortage is not None:
        return shortage, drawn
    cov, cross, cov_lens = _with_lens(rig, camera, outlined, estimate)
    estimate = replace(estimate, cov=cov)
    names = tuple(view.capture for view in outlined)
    calibration = Calibration(
        camera=camera,
        channels=(channel_of(images[0], rig),),
        lidar=lidar,
        T_cam_lidar=estimate.T_cam_lidar,
        cov=cov,
        n_captures=len(views),
        n_detected=len(outlined),
        captures_used=names,
        captures_refused={},
        metrics=Metrics(math.nan, math.nan, math.nan),
        certificate=Certificate(False, math.inf),
        verdict="marginal",
        method=BY_SCENE,
        uncertainty=point_uncertainties(estimate.T_cam_lidar, with_lens(cov, cross, cov_lens), lens),
        intrinsics=lens,
        intrinsics_cov=cov_lens,
        intrinsics_cross_cov=cross,
    )
    findings = [*_findings(rig, nominal, estimate, n_untimed), *_one_place(subject, pictures)]
    return with_findings(calibration, findings), drawn


def _with_lens(
    rig: Rig, camera: str, views: Sequence[OutlineView], estimate: SceneEstimate
) -> tuple[Array, Array, Array]:
    """Add the errors of the profile's intrinsics to the covariance, as for a board's result.

    Returns:
        Covariance (6, 6) of the extrinsics as used with these intrinsics, their cross-covariance (6, P) with
        the intrinsics, and the covariance (P, P) of these.
    """
    prior = LensPrior.read(rig.cameras[camera], rig.board)
    cov_lens = np.asarray(np.linalg.inv(prior.of(model_of(prior.lens))[1]))
    changes = np.linalg.cholesky((cov_lens + cov_lens.T) / 2)
    used = follow_lens(views, prior.lens, estimate.T_cam_lidar, changes)
    used[3:] += turn_of_lens(prior.lens) @ changes
    return np.asarray(estimate.cov + used @ used.T), np.asarray(used @ changes.T), cov_lens


def _shortage(subject: str, estimate: SceneEstimate, images: Sequence[Image | Events]) -> Finding | None:
    """Name why the scene cannot tell; None if it can."""
    greys = (float(np.percentile(image.grey, 99)) for image in images if isinstance(image, Image))
    brightest = max(greys, default=math.inf)
    figures: dict[str, Any] = {"n_views": len(images), "n_edges": estimate.n_edges}
    if estimate.state != "usable" and brightest < _DARK:
        return SCENE_DARK(subject, grey_99=brightest, limit=_DARK, **figures)
    if estimate.state == "few_edges":
        return SCENE_FEW_EDGES(subject, **figures)
    if estimate.state == "weak":
        return SCENE_WEAK(subject, score=estimate.score, min_score=MIN_SCORE, **figures)
    if estimate.state == "ambiguous":
        return SCENE_AMBIGUOUS(subject, gain=estimate.gain, **figures)
    if estimate.state == "beyond_reach":
        reach_m, reach_deg = float(estimate.reach[0]), math.degrees(estimate.reach[3])
        return SCENE_BEYOND_REACH(subject, reach_deg=reach_deg, reach_m=reach_m)
    if estimate.undetermined:
        axes = tuple(dict.fromkeys(axis for axes in estimate.undetermined for axis in axes))
        return SCENE_UNDETERMINED(subject, axes=axes, **figures)
    return None


def _one_place(subject: str, images: Sequence[Image]) -> list[Finding]:
    """Check whether all views show one place, as with a standing rig."""
    small = [cv2.resize(each.grey, _SMALL_PX, interpolation=cv2.INTER_AREA).ravel() for each in images]
    with np.errstate(invalid="ignore", divide="ignore"):  # blank images
        correlations = np.atleast_2d(np.corrcoef(np.asarray(small, dtype=np.float64)))
    others = np.nan_to_num(correlations[np.triu_indices(len(images), 1)])
    alike = float(np.median(others)) if len(others) else 1.0
    return (
        [SCENE_ONE_PLACE(subject, n_views=len(images), alike=alike, limit=_ALIKE)] if alike > _ALIKE else []
    )


def _findings(
    rig: Rig, nominal: NominalExtrinsic, estimate: SceneEstimate, n_untimed: int
) -> Iterator[Finding]:
    """List the reasons against a pass."""
    subject = f"{nominal.camera} and {nominal.lidar}"
    target, sigmas = rig.calibration, np.sqrt(np.diag(estimate.cov))
    sigma_deg, sigma_m = sigma_sizes(estimate.cov)
    if target.in_targets(sigma_deg, sigma_m) > 1:
        limits = np.r_[np.full(3, target.target_sigma_m), np.full(3, np.radians(target.target_sigma_deg))]
        yield SCENE_UNCERTAIN(
            subject,
            sigma_deg=sigma_deg,
            sigma_m=sigma_m,
            target_deg=target.target_sigma_deg,
            target_m=target.target_sigma_m,
            weakest=MOTIONS[int(np.argmax(sigmas / limits))],
        )
    if nominal.source == "typical":
        yield SCENE_TYPICAL(subject)
    yield from nominal_findings(estimate.T_cam_lidar, nominal)
    if n_untimed:
        yield SCENE_MOVING(subject, severity="note", n_views=n_untimed)
