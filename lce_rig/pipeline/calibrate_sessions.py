"""Calibrate one session, or several of a rig whose sensors were not moved in between, by one estimate.

same rig, own captures -> each session alone, compared -> captures of all in one estimate

The sensors' constant errors are the same in every session, and more sessions do not average them out. In one
estimate of all captures they are common unknowns, and their part of the covariance stays.
"""

from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path

from lce_rig.calibrate import CalibrateOptions
from lce_rig.collect.guidance.planner import plan_captures
from lce_rig.core.calibration import Calibration
from lce_rig.core.errors import NotEnoughDataError, ResultRefusedError, SessionError, UsageError
from lce_rig.core.findings import Finding
from lce_rig.core.progress import Progress, begin, silent
from lce_rig.detect.detection import Detections, ImageDetection, LidarDetection
from lce_rig.export.reference import Reference
from lce_rig.judge.findings import lacks_captures
from lce_rig.judge.repeatability import Repeatability, compare_calibrations
from lce_rig.judge.verdict import with_opinion
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.pipeline.detect_session import detect
from lce_rig.pipeline.findings import MOVED, ONLY_ONE
from lce_rig.pipeline.matching import boards_in
from lce_rig.pipeline.result_files import Result
from lce_rig.pipeline.witness import by_boards, hear_scene, sharpen
from lce_rig.session import Session
from lce_rig.session.identity import DifferingKey, differing_keys


def calibrate(
    session: Session | str | Path | Sequence[Session | str | Path],
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
        session: its folder, or one that is open for reading. Several sessions of one rig whose sensors were
            not moved give one estimate; `write` puts it into the first session.
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
    chosen = [session] if isinstance(session, Session | str | Path) else session
    named = require_unit([each if isinstance(each, Session) else Session.open(Path(each)) for each in chosen])
    sessions = list(named.values())
    if detections is None:
        detections = [detect(each) for each in sessions]
    elif isinstance(detections, Detections):
        detections = [detections]
    if len(detections) != len(named):
        raise UsageError(f"{len(named)} sessions require as many detections", "Give one for each session.")
    by_name, is_union = dict(zip(named, detections, strict=True)), len(named) > 1
    options = options or CalibrateOptions()
    if is_union:
        begin(progress, "calibrating each session alone")
    comparisons = _require_unmoved(named, by_name, options, cameras, channels) if is_union else ()
    joined = join_detections(by_name) if is_union else detections[0]
    pairs, shortages = calibrate_detections(
        sessions[0].rig,
        joined,
        options,
        cameras=cameras,
        channels=channels,
        reference=reference,
        scene=partial(sharpen, sessions, detections) if use_scene else None,
        progress=progress,
    )
    agreements = {(each.camera, each.lidar): (each.finding,) for each in comparisons}
    begin(progress, "comparing with the scene")
    judged = []
    for c in pairs:
        # The scene of the first session that holds captures of these sensors.
        sensors = c.camera, c.lidar
        name = next(
            name for name in named if any((p.camera, p.lidar) == sensors for p in by_name[name].pairs)
        )
        opinion = hear_scene(named[name], by_name[name], by_boards(c))
        agreement = agreements.get((c.camera, c.lidar), ())
        c = with_opinion(replace(c, findings=(*c.findings, *agreement)), opinion)
        if lacks_captures(c.findings):
            plan = plan_captures(
                sessions[0].rig, c.camera, c.lidar, boards_in(joined, *sensors, c.captures_used), c
            )
            c = replace(c, findings=(*c.findings, *plan))
        judged.append(c)
    return Result(sessions[0], tuple(judged), tuple(shortages), named if is_union else {})


def require_unit(sessions: Sequence[Session]) -> dict[str, Session]:
    """Name sessions that one estimate can hold, by their folder.

    Raises:
        SessionError: they differ in rig, sensors or board, or share captures.
        UsageError: one is given twice, or none.
    """
    if not sessions:
        raise UsageError("no session given", "Give one session, or several of one rig.")
    named = dict(zip(session_names([each.path for each in sessions]), sessions, strict=True))
    # Captures of all sessions are estimated with one of these; targets and limits are those of the first.
    require_same(
        named,
        lambda key: key.path[0] in ("board", "cameras", "lidars"),
        "One estimate requires one board and one set of sensors. Correct the wrong rig.yaml, or calibrate "
        "each session alone and compare them with `lce-rig repeat SESSION OTHER_SESSION`.",
    )
    require_independent(named)
    return named


def session_names(paths: Sequence[Path]) -> list[str]:
    """Name sessions by their folder, or by their path if two folders have the same name.

    Raises:
        UsageError: one is given twice.
    """
    resolved = [path.resolve() for path in paths]
    for path, where in zip(paths, resolved, strict=True):
        if resolved.count(where) > 1:
            raise UsageError(f"{path} is given twice", "Give independent sessions.")
    short = [path.name for path in resolved]
    return short if len(set(short)) == len(short) else [str(path) for path in paths]


def require_same(
    sessions: Mapping[str, Session], must_agree: Callable[[DifferingKey], bool], hint: str
) -> None:
    """Refuse sessions of different rigs, or whose profiles differ in a key that must agree.

    Raises:
        SessionError: with the keys.
    """
    (first_name, first), *others = sessions.items()
    for name, session in others:
        if session.rig.name != first.rig.name:
            raise SessionError(
                f"{first_name} belongs to rig {first.rig.name!r}, {name} to rig {session.rig.name!r}",
                "Give sessions of one rig.",
            )
        keys = [str(key) for key in differing_keys(first.rig, session.rig) if must_agree(key)]
        if keys:
            raise SessionError(f"the profiles of {first_name} and {name} differ: {'; '.join(keys[:4])}", hint)


def require_independent(sessions: Mapping[str, Session]) -> None:
    """Refuse sessions that share images or scans: a copy agrees with its original despite any error."""
    hashes: dict[str, set[str]] = {name: set() for name in sessions}
    for name, session in sessions.items():
        for capture in session.captures:
            # A damaged capture is reported when it is read.
            with suppress(SessionError):
                hashes[name] |= capture.file_hashes
    require_apart(hashes, "Collect each session separately, with the board mounted again.")


def require_apart(contents: Mapping[str, Set[str]], hint: str) -> None:
    """Refuse what holds the same samples, known by their hashes.

    Raises:
        SessionError: two of them share some.
    """
    for one, other in combinations(contents, 2):
        if n_shared := len(contents[one] & contents[other]):
            what = f"{one} and {other} share {n_shared} samples: they are not independent"
            raise SessionError(what, hint)


def join_detections(by_session: Mapping[str, Detections]) -> Detections:
    """Put the detections of several sessions into one, captures named SESSION/CAPTURE."""
    images: dict[tuple[str, str], dict[str, ImageDetection]] = {}
    lidars: dict[str, dict[str, LidarDetection]] = {}
    session_of: dict[str, str] = {}
    for name, own in by_session.items():
        for key, by_image in own.images.items():
            images.setdefault(key, {}).update({f"{name}/{k}": image for k, image in by_image.items()})
        for lidar, by_scan in own.lidars.items():
            lidars.setdefault(lidar, {}).update({f"{name}/{k}": scan for k, scan in by_scan.items()})
            session_of |= {f"{name}/{k}": name for k in by_scan}
    return Detections(images, lidars, session_of)


def _require_unmoved(
    sessions: Mapping[str, Session],
    detections: Mapping[str, Detections],
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
                session.rig, detections[name], replace(options, n_draws=0), cameras=cameras, channels=channels
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


def compare_sensors(
    results: dict[str, list[Calibration]], *, are_independent: bool = True
) -> tuple[tuple[Repeatability, ...], list[Finding]]:
    """Compare each camera and LiDAR, and report those that only one session calibrates."""
    groups: dict[tuple[str, str], dict[str, Calibration]] = {}
    for name, calibrations in results.items():
        for calibration in calibrations:
            groups.setdefault((calibration.camera, calibration.lidar), {})[name] = calibration
    comparisons = [
        compare_calibrations(group, are_independent=are_independent)
        for _, group in sorted(groups.items())
        if len(group) > 1
    ]
    lonely = [
        ONLY_ONE(next(iter(group)), camera=camera, lidar=lidar)
        for (camera, lidar), group in sorted(groups.items())
        if len(group) == 1
    ]
    return tuple(comparisons), lonely
