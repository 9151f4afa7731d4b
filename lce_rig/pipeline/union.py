"""One estimate from several sessions of a rig whose sensors were not moved in between.

same rig, own captures -> each session alone, compared -> captures of all in one estimate

The sensors' constant errors are the same in every session, and more sessions do not average them out. In one
estimate of all captures they are common unknowns, and their part of the covariance stays.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

from lce_rig.calibrate import CalibrateOptions
from lce_rig.core.calibration import Calibration
from lce_rig.core.errors import NotEnoughDataError, ResultRefusedError, SessionError, UsageError
from lce_rig.detect.detection import Detections, ImageDetection, LidarDetection, Pair
from lce_rig.export.reference import Reference
from lce_rig.judge.repeatability import Repeatability
from lce_rig.judge.verdict import with_opinion
from lce_rig.pipeline.calibration import calibrate as calibrate_one
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.pipeline.comparison import compare_sensors, require_independent, require_one_rig, session_names
from lce_rig.pipeline.detect_session import Progress, detect, silent
from lce_rig.pipeline.findings import MOVED
from lce_rig.pipeline.result_files import Result
from lce_rig.pipeline.witness import by_boards, hear_scene, sharpen
from lce_rig.session import Session
from lce_rig.session.identity import differing_keys

# Captures of all sessions are estimated with one of these; targets and limits are those of the first session.
_SHARED = frozenset({"board", "cameras", "lidars"})


def calibrate(
    session: Session | Sequence[Session],
    detections: Detections | Sequence[Detections] | None = None,
    *,
    options: CalibrateOptions | None = None,
    cameras: Sequence[str] | None = None,
    channels: Sequence[str] | None = None,
    reference: Reference | None = None,
    use_scene: bool = False,
    progress: Progress = silent,
) -> Result:
    """Estimate and judge the extrinsics of every camera with every LiDAR; nothing is written.

    Args:
        session: open for reading is enough. Several sessions of one rig whose sensors were not moved give one
            estimate; `write` puts it into the first session.
        detections: of the session, or of each; None detects the board first, as `detect` does by default.
        options: of the estimate; None for the defaults.
        cameras: the cameras to calibrate, as if the session held no others; None for all.
        channels: the cameras' channels to use; None for all that the session holds.
        reference: extrinsics to report errors against; they never enter the estimate or the verdict.
        use_scene: estimate each frame camera from the edges of the scene, too.
        progress: called with (done, total) for each camera and LiDAR in turn.

    Raises:
        NotEnoughDataError: every pair has too few captures or an undetermined direction; the causes are
            named. Of several sessions, one has too few to tell whether its sensors were moved.
        ResultRefusedError: sessions disagree: the sensors were moved in between.
        SessionError: sessions are not of one rig, board and intrinsics, or share captures.
        UsageError: no capture holds one of the channels; a session is given twice.
    """
    if isinstance(session, Session) or len(session) == 1:
        return calibrate_one(
            session if isinstance(session, Session) else session[0],
            detections[0] if isinstance(detections, Sequence) else detections,
            options=options,
            cameras=cameras,
            channels=channels,
            reference=reference,
            use_scene=use_scene,
            progress=progress,
        )
    named = require_unit(session)
    given = [detect(each) for each in session] if detections is None else detections
    if isinstance(given, Detections) or len(given) != len(named):
        raise UsageError(f"{len(named)} sessions require as many detections", "Give one for each session.")
    found = dict(zip(named, given, strict=True))
    options = options or CalibrateOptions()
    comparisons = _require_unmoved(named, found, options, cameras, channels)
    pairs, shortages = calibrate_detections(
        session[0].rig,
        join_detections(found),
        options,
        cameras=cameras,
        channels=channels,
        reference=reference,
        scene=partial(sharpen, session, given) if use_scene else None,
        progress=progress,
    )
    agreements = {(each.camera, each.lidar): (each.finding,) for each in comparisons}
    heard = []
    for c in pairs:
        # The scene of the first session that holds captures of these sensors.
        name = next(name for name in named if Pair.of(c) in found[name].pairs)
        opinion = hear_scene(named[name], found[name], by_boards(c))
        agreement = agreements.get((c.camera, c.lidar), ())
        heard.append(with_opinion(replace(c, findings=(*c.findings, *agreement)), opinion))
    return Result(session[0], tuple(heard), tuple(shortages), named)


def require_unit(sessions: Sequence[Session]) -> dict[str, Session]:
    """Name sessions that one estimate can hold, by their folder.

    Raises:
        SessionError: they differ in rig, sensors or board, or share captures.
        UsageError: one is given twice, or none.
    """
    if not sessions:
        raise UsageError("no session given", "Give one session, or several of one rig.")
    named = dict(zip(session_names([each.path for each in sessions]), sessions, strict=True))
    require_one_rig(named)
    (first_name, first), *others = named.items()
    for name, session in others:
        keys = [key for key in differing_keys(first.rig, session.rig) if key.path[0] in _SHARED]
        if keys:
            raise SessionError(
                f"{first_name} and {name} differ in board or sensors: {'; '.join(map(str, keys[:4]))}",
                "One estimate requires one board and one set of sensors. Correct the wrong rig.yaml, or "
                "calibrate each session alone and compare them with `lce-rig repeat`.",
            )
    require_independent(named)
    return named


def join_detections(found: Mapping[str, Detections]) -> Detections:
    """Put the detections of several sessions into one, captures named SESSION/CAPTURE.

    Args:
        found: by the session's name.
    """
    images: dict[tuple[str, str], dict[str, ImageDetection]] = {}
    lidars: dict[str, dict[str, LidarDetection]] = {}
    session_of: dict[str, str] = {}
    for name, own in found.items():
        for key, by_image in own.images.items():
            images.setdefault(key, {}).update({f"{name}/{k}": image for k, image in by_image.items()})
        for lidar, by_scan in own.lidars.items():
            lidars.setdefault(lidar, {}).update({f"{name}/{k}": scan for k, scan in by_scan.items()})
            session_of |= {f"{name}/{k}": name for k in by_scan}
    return Detections(images, lidars, session_of)


def _require_unmoved(
    sessions: Mapping[str, Session],
    found: Mapping[str, Detections],
    options: CalibrateOptions,
    cameras: Sequence[str] | None,
    channels: Sequence[str] | None,
) -> tuple[Repeatability, ...]:
    """Calibrate each session alone and compare the results, as `repeat` does.

    Raises:
        NotEnoughDataError: a session has too few captures to be compared; it is named.
        ResultRefusedError: the results disagree.
    """
    alone: dict[str, list[Calibration]] = {}
    for name, session in sessions.items():
        try:
            alone[name], _ = calibrate_detections(
                session.rig, found[name], replace(options, n_draws=0), cameras=cameras, channels=channels
            )
        except NotEnoughDataError as error:
            raise NotEnoughDataError(
                f"{name} alone does not show whether its sensors were moved: {error.what}",
                f"{error.hint}\nOr leave {name} out.".strip(),
            ) from None
    comparisons, _ = compare_sensors(alone)
    for comparison in comparisons:
        if comparison.agrees:
            continue
        # The sensors moved between the odd one and another, or between the two that differ most.
        odd = comparison.odd_one
        pairs = [each for each in comparison.differences if odd in (None, each.first, each.second)]
        worst = min(pairs, key=lambda pair: (pair.p, -pair.distance))
        moved = MOVED(
            action="" if odd is None else "odd_one",
            camera=comparison.camera,
            lidar=comparison.lidar,
            first=worst.first,
            second=worst.second,
            rotation_deg=worst.rotation_deg,
            translation_m=worst.translation_m,
            p=comparison.p,
            odd_one=odd,
        )
        raise ResultRefusedError(moved.text, moved.advice)
    return comparisons
