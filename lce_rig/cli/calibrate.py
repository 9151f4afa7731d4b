"""`lce-rig calibrate`: estimate the extrinsics of a session, judge them and write them as files."""

from collections.abc import Collection, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, get_args

import click
import numpy as np

import lce_rig as lce
from lce_rig.cli import show
from lce_rig.cli.contents import put_aside
from lce_rig.cli.options import (
    cameras_option,
    names_option,
    path_option,
    require_sensors,
    robot_option,
    session_argument,
)
from lce_rig.collect.findings import GUIDE_ADD
from lce_rig.core.calibration import BY_SCENE, DEFAULT_METHOD, Calibration, Method, Metrics, RigPoses
from lce_rig.core.errors import NotEnoughDataError, ResultRefusedError, UsageError, join_shortages
from lce_rig.core.files import read_json
from lce_rig.core.phrasing import sizes
from lce_rig.detect.detection import Pair
from lce_rig.export.extrinsics import read_reference
from lce_rig.judge.findings import advice_of, causes_of, lacks_captures
from lce_rig.judge.reach import USUAL_M
from lce_rig.pipeline.detect_session import unlike_models
from lce_rig.pipeline.findings import CHANNEL_REJECTED, FEW_DETECTED, absent_channels
from lce_rig.pipeline.result_files import result_folder
from lce_rig.rig import find_profile, read_profile
from lce_rig.session.provenance import serials_of
from lce_rig.show.overlays.canvas import Thumbnails
from lce_rig.show.tables import result_tables, rig_table

_AXES = ("x right", "y down", "z forward")
_AXES_OF_LIDAR = ("x forward", "y left", "z up")
_CORRECTED = {
    "verdict.intrinsics",
    "verdict.scale",
    "verdict.range_offset",
    "verdict.range_scale",
    "verdict.laser_angles",
    "verdict.plate_size",
}
# Number of reasons printed without --explain.
_N_REASONS = 3


def residual_words(metrics: Metrics, c: Calibration) -> str:
    """Write mean residuals; two LiDARs have none of corners, two cameras none of edges."""
    edges = "" if c.is_of_cameras else f", edges {1000 * metrics.mee_m:.1f} mm"
    corners = "" if c.is_of_lidars else f", corners {metrics.reprojection_px:.2f} px"
    return f"planes {1000 * metrics.mpe_m:.1f} mm{edges}{corners}"


def _uncertainty(c: Calibration, *, is_by_axis: bool) -> Iterator[str]:
    """State the standard deviations, per axis if the result passes, and for a distant point."""
    yield f"  uncertainty  {sizes(c.sigma_rotation_deg, c.sigma_translation_m)} (1 sigma)"
    if c.verdict == "fail":
        return
    names = _AXES_OF_LIDAR if c.is_of_lidars else _AXES
    along_mm, about_deg = np.split(np.sqrt(np.diag(c.cov)) * np.repeat([1000.0, np.degrees(1.0)], 3), 2)
    by_axis = (("about", about_deg, ".3f", "deg"), ("along", along_mm, ".1f", "mm"))
    for title, values, digits, unit in (
        by_axis if is_by_axis and (c.verdict == "pass" or not c.is_with_board) else ()
    ):
        axes = ", ".join(f"{name} {value:{digits}}" for name, value in zip(names, values, strict=True))
        yield f"    {title}      {axes} {unit}"
    for point in c.uncertainty:
        if point.distance_m == USUAL_M:
            off = f"{point.centre_px:.1f} px, {100 * point.centre_m:.1f} cm"
            yield f"  {USUAL_M:g} m away    a point is off by {off}; in a corner {point.corner_px:.1f} px"


@click.command()
@session_argument
@path_option(
    "--reference",
    "FILE",
    "Report the error from the T_cam_lidar of this JSON file; the estimate does not use it.",
)
@cameras_option
@names_option(
    "--channels", "Use only these channels, such as frames or events [default: all, in one joint estimate]."
)
@click.option(
    "--method",
    type=click.Choice(get_args(Method)),
    default=DEFAULT_METHOD,
    show_default=True,
    help="Estimate by maximum likelihood, starting from Algorithm 1 of LCE-Calib (ml), or by Algorithm 1 "
    "alone (paper).",
)
@click.option(
    "--name",
    metavar="NAME",
    help="Write the result to SESSION/results/NAME/ and leave SESSION/calibration/ unchanged.",
)
@robot_option
@names_option(
    "--without",
    "Reject these captures first, like `captures --reject`; `captures --restore` brings them back.",
    "CAPTURE[,CAPTURE]",
)
@click.option(
    "--rig",
    "profile",
    metavar="FILE",
    help="Replace the session's profile first by this one of the same rig, such as a file of `intrinsics "
    "--save-profile`; the earlier profile is kept as rig-1.yaml. With --name, only that result uses the "
    "new profile, and the session keeps its own.",
)
@path_option(
    "--scene",
    "DRIVE",
    "Calibrate without a board: correct the nominal extrinsics of --rig by the edges in this recording "
    "(repeatable); its views are stored in SESSION. If DRIVE is a session, its result is named --name "
    "[default: scene].",
    multiple=True,
)
@click.option("--explain", is_flag=True, help="Print everything that was estimated and tested.")
@click.option("--json", "as_json", is_flag=True, help="Print result.json on stdout.")
@click.option("--force", is_flag=True, help="Export failed results too, marked NOT FOR USE.")
@click.option("--no-report", is_flag=True, help="Do not write report.html.")
def calibrate(
    session: Path,
    reference: Path | None,
    cameras: tuple[str, ...],
    channels: list[str] | None,
    name: str | None,
    robot: str | None,
    without: list[str] | None,
    profile: str | None,
    scene: tuple[Path, ...],
    explain: bool,
    as_json: bool,
    force: bool,
    no_report: bool,
    method: Any,
) -> None:
    """Estimate the extrinsics between the LiDAR and each camera of SESSION (default: session/).

    Writes SESSION/calibration/ in one step: result.json, report.html (the result explained, with drawings),
    extrinsics.yaml, URDF, camera_info and static transforms. The earlier result moves to
    SESSION/calibration/previous/. A run without a result leaves it unchanged.

    Exits with 7 if a result has failed; the exports then skip that camera, unless --force is given. Exits
    with 6 if a camera has no result.
    """
    result_folder(Path(), name, is_new=True)
    if scene:
        if channels is not None or without or reference is not None or robot is not None:
            raise UsageError(
                "--scene takes no --channels, --without, --reference or --robot", "Omit the option."
            )
        _calibrate_scene(
            scene, session, profile, cameras, name, explain=explain, as_json=as_json, force=force
        )
        return
    if profile is not None and name is None:
        _take_profile(session, profile)
    if without:
        put_aside(session, without, "calibrate --without")
    opened = lce.Session.open(session)
    if profile is not None and name is not None:
        opened = opened.with_profile(lce.load_rig(profile))
    rig = opened.rig = opened.rig.of_robot(robot)
    serials_of(opened)
    require_sensors("camera", cameras, rig.cameras)
    wanted = [
        name
        for name, camera in rig.cameras.items()
        if name in (cameras or rig.cameras) and (channels is None or set(channels) & set(camera.channels))
    ]
    truth = None if reference is None else read_reference(reference)
    if truth is not None and truth.default is not None and len(wanted) * len(rig.lidars) > 1:
        raise UsageError(
            f"{reference}: T_cam_lidar names no sensors, but the rig has several: {', '.join(wanted)}",
            'Write {"pairs": [{"camera": ..., "lidar": ..., "T_cam_lidar": ...}, ...]}, or add --camera.',
        )
    thumbnails: Thumbnails = {}
    with show.progress_bar("detecting") as progress:
        detections = lce.detect_boards(opened, progress=progress, thumbnails=thumbnails)
    show.warn_of(unlike_models(opened, detections))
    for absent in chain(*absent_channels(rig, detections, channels).values()):
        show.warn(f"{absent.text}: {absent.advice_at(str(session))}")
    with show.progress_bar("calibrating") as progress:
        try:
            result = lce.calibrate_session(
                opened,
                detections,
                options=lce.CalibrateOptions(method),
                cameras=cameras or None,
                channels=channels,
                reference=truth,
                progress=progress,
                thumbnails=thumbnails,
            )
        except NotEnoughDataError as error:
            if error.finding is not None and error.finding.figures.get("where"):
                error.hint += f"\n{collect_command(opened)}"
            raise
    for shortage in result.shortages:
        show.warn(str(NotEnoughDataError.of(shortage)))
    for finding in (finding for c in result.pairs for finding in c.findings):
        if finding.code == FEW_DETECTED.code:
            show.warn("\n  ".join(map(str.strip, str(NotEnoughDataError.of(finding)).splitlines())))
        elif finding.code == CHANNEL_REJECTED.code:
            show.warn(f"{finding.text}: {finding.advice_at(str(session))}")
    if truth is not None and any(c.egt_rotation_deg is None for c in result.pairs):
        show.warn(f"{reference} has no T_cam_lidar for these sensors")
    # Write and print the result before drawing the report, which takes about as long.
    written = result.write(name=name, force=force, report=False)
    if as_json:
        show.print_json(result.document())
    else:
        show_result(result.pairs, result.on_base, opened.rig, str(result.session.path), is_explained=explain)
    show.warn_of(finding for finding in written.findings if finding.severity != "note")
    if written.previous is not None and len(written.files) == 1 and written.has_usable_previous:
        show.warn(f"this result is not exported; the last usable result is in {written.previous}")
    elif written.previous is not None and explain:
        show.note(f"the result before it is in {written.previous}")
    lacking = _lacking(wanted, {pair.camera for pair in detections.pairs}, result.pairs)
    if lacking is not None and any(c.verdict == "fail" for c in result.pairs):
        show.warn(str(lacking))
    if not no_report:
        with show.progress_bar("drawing the report"):
            result.write_report(name=name)
    files = [] if no_report else ["report.html"]
    files += [f"{len(written.files) - 1} for the robot"] if len(written.files) > 1 else []
    show.note(f"  files        {written.files[0].parent}/ ({', '.join(files) or 'result.json'})")
    if any(finding.code == GUIDE_ADD.code for c in result.pairs for finding in c.findings):
        show.note(f"  next         {collect_command(opened)}")
    elif all(c.verdict != "fail" for c in result.pairs):
        show.name_next("verify", session, "" if name is None else f" --name {name}")
    exit_by_verdict(result.pairs, are_printed=not as_json)
    if lacking is not None:
        raise lacking


def _calibrate_scene(
    scene: tuple[Path, ...],
    path: Path,
    profile: str | None,
    cameras: tuple[str, ...],
    name: str | None,
    *,
    explain: bool,
    as_json: bool,
    force: bool,
) -> None:
    """Estimate extrinsics from a drive, write them, and print them."""
    from lce_rig.pipeline.scene_calibration import calibrate_scene

    rig = None if profile is None else lce.load_rig(profile)
    if rig is not None:
        require_sensors("camera", cameras, rig.cameras)
    with show.progress_bar("reading") as progress:
        found = calibrate_scene(scene, path, rig=rig, cameras=cameras, progress=progress)
    for text in found.notes:
        show.note(text)
    result = found.result
    with show.progress_bar("drawing"):
        pictures = found.write_overlays()
    if pictures:
        show.note(f"  overlays     {pictures[0].parent}/ ({show.counted(len(pictures), 'image')})")
    found.require_pairs()
    for shortage in result.shortages:
        show.warn(str(NotEnoughDataError.of(shortage)))
    if name is None and result.session.path == scene[0]:
        name = BY_SCENE  # The result of its boards stays.
    written = result.write(name=name, force=force, report=False)
    if as_json:
        show.print_json(result.document())
    else:
        show_result(
            result.pairs, result.on_base, result.session.rig, str(result.session.path), is_explained=explain
        )
    show.warn_of(finding for finding in written.findings if finding.severity != "note")
    show.note(f"  files        {written.files[0].parent}/ ({len(written.files) - 1} for the robot)")
    exit_by_verdict(result.pairs, are_printed=not as_json)
    if result.shortages:
        raise join_shortages([NotEnoughDataError.of(each) for each in result.shortages])


def collect_command(session: lce.Session) -> str:
    """Build the command that adds captures to a session from its present source."""
    from lce_rig.cli.simulate import TRUTH

    options = " --from RECORDING"
    if (session.path / TRUTH).exists():
        options = f" --simulated --seed {read_json(session.path / TRUTH).get('seed', 0)}"
    elif any(
        isinstance(source := capture.meta.get("source"), dict) and str(source.get("key")).startswith("live:")
        for capture in session.captures
    ):
        options = ""
    return show.command("collect", session.path, options)


def _take_profile(path: Path, profile: str) -> None:
    """Replace a session's profile and print where the earlier one is kept.

    Raises:
        ProfileError: the new profile is not valid.
        SessionError: the new profile describes another rig.
    """
    rig = lce.load_rig(profile)
    with lce.Session.open(path, writable=True) as session:
        earlier = session.adopt(rig)
        session.keep_text(read_profile(find_profile(profile)))
    if earlier:
        show.note(f"{profile} is the session's profile now; the earlier one is {path / earlier}")


def _lacking(
    wanted: Sequence[str], cameras: Collection[str], calibrations: Sequence[Calibration]
) -> NotEnoughDataError | None:
    """Name the wanted cameras without extrinsics; None if all have them.

    Args:
        wanted: cameras that should have extrinsics.
        cameras: cameras with captures in the session.
        calibrations: the results, at least one.
    """
    calibrated = {name for c in calibrations for name in (c.camera, c.lidar)}
    missing = [camera for camera in wanted if camera not in calibrated]
    if not missing:
        return None
    causes = [f"No capture holds an image of {name} and a scan." for name in missing if name not in cameras]
    others = " ".join(f"--camera {name}" for name in wanted if name in calibrated)
    return NotEnoughDataError(
        f"no extrinsics of camera {', '.join(missing)}",
        "\n".join([*causes, f"Collect more captures, or omit the camera: {others}"]),
    )


def exit_by_verdict(calibrations: Sequence[Calibration], *, are_printed: bool = False) -> None:
    """Exit with 7 if a result has failed.

    Raises:
        ResultRefusedError: the worst verdict is "fail".
    """
    failed = [c for c in calibrations if c.verdict == "fail"]
    if failed:
        pairs = ", ".join(str(Pair.of(c)) for c in failed)
        causes = "\n".join(finding.sentence for c in failed for finding in c.findings)
        raise ResultRefusedError(f"failed: {pairs}; do not use this result", "" if are_printed else causes)


def show_result(
    pairs: Sequence[Calibration], poses: RigPoses | None, rig: lce.Rig, path: str, *, is_explained: bool
) -> None:
    """Print the pairs of a result, and the poses of three and more sensors.

    Args:
        pairs: the result.
        poses: poses of its sensors; None for two.
        rig: the profile.
        path: path of the session.
        is_explained: whether to print everything that was estimated and tested.
    """
    told: dict[str, str] = {}
    for c in pairs:
        show.print_parts(_parts(c, path, told, is_explained=is_explained, is_of_rig=poses is not None))
    if poses is not None:
        show.print_parts(_rig_parts(poses, rig.cameras, pairs))


def _rig_parts(
    poses: RigPoses, cameras: Collection[str], calibrations: Sequence[Calibration]
) -> Iterator[Any]:
    """State the pose of each sensor on the base, and which sensors have none."""
    table = rig_table(poses, cameras)
    yield f"[bold]rig on {show.escape(poses.base)}[/] (cameras: x forward, y left, z up)"
    if table.rows:
        yield show.text_table(table)
    placed = {poses.base, *(each.sensor for each in poses.sensors)}
    names = dict.fromkeys(name for c in calibrations for name in (c.camera, c.lidar))
    for name in names:
        if name not in placed:
            yield f"{show.escape(name)}  [{show.COLOURS['fail']}]FAIL[/], no usable pose"


def _parts(
    c: Calibration, path: str, told: dict[str, str], *, is_explained: bool, is_of_rig: bool
) -> Iterator[Any]:
    """Print the verdict, reasons, extrinsics and uncertainty; if explained, also every test.

    Args:
        c: the result of a pair.
        path: path of the session.
        told: pair by printed reason; this pair's reasons are added.
        is_explained: whether to print every figure.
        is_of_rig: whether a list of all sensors follows, which has the poses.
    """
    colour, has_failed = show.COLOURS[c.verdict], c.verdict == "fail"
    causes, pair = causes_of(c.findings), str(Pair.of(c))
    earlier = list(dict.fromkeys(told[each.text] for each in causes if each.text in told))
    fresh = [each for each in causes if each.text not in told]
    told |= {each.text: pair for each in fresh}
    used = f"{len(c.captures_used)} of {c.n_captures} {'captures' if c.is_with_board else 'views'} used"
    yield f"[bold]{pair}[/]: [bold {colour}]{c.verdict.upper()}[/], {used}"
    plan = next((finding.advice for finding in c.findings if finding.code == GUIDE_ADD.code), "")
    # Print one line with the number of reasons not shown.
    n_shown = _N_REASONS if len(fresh) <= _N_REASONS else _N_REASONS - 1
    advised: set[str] = set()
    if earlier and not is_explained:
        yield f"  [{colour}]same reason as {show.escape(' and '.join(earlier))}[/]"
    for finding in c.findings if is_explained else fresh[:n_shown]:
        follows = "follows: " if finding.follows else ""
        tint = "none" if finding.severity == "note" else colour
        yield f"  [{tint}]{follows}{show.escape(finding.text)}[/]"
        advice = "" if follows else advice_of(finding, plan, path)
        if advice and advice not in advised:
            yield f"    -> {show.escape(advice)}"
            advised.add(advice)
    following = [finding for finding in c.findings if finding.follows]
    if following and not is_explained and (fresh or not earlier):
        more = f"; {len(following) - 1} more" if len(following) > 1 else ""
        yield f"    follows: {show.escape(following[0].text)}{more}"
    if plan and not lacks_captures(causes[:1]):
        yield f"  -> {plan}"
    if len(fresh) > n_shown and not is_explained:
        more = show.counted(len(fresh) - n_shown, "more reason")
        yield f"  {more} in report.html and by lce-rig calibrate {path} --explain"
    if is_explained or not (has_failed or is_of_rig):
        target, source = (c.camera, c.lidar) if c.is_of_peers else ("cam", "lidar")
        yield show.escape(f"  T_cam_lidar (p_{target} = R p_{source} + t)")
        yield from show.matrix_lines(c.T_cam_lidar, "    ")
    yield from _uncertainty(c, is_by_axis=is_explained or not is_of_rig)
    # Print the corrected lens and square size, which belong to the extrinsics.
    corrected = [each for each in c.findings if each.code in _CORRECTED and each.severity == "note"]
    if corrected and c.verdict == "pass" and not is_explained:
        yield f"  {show.escape(corrected[0].text)}"
    if c.egt_rotation_deg is not None and c.egt_translation_m is not None:
        yield f"  reference    error {sizes(c.egt_rotation_deg, c.egt_translation_m)}"
    for table in result_tables(c).values() if is_explained else ():
        if table.rows:
            yield f"\n[bold]{show.escape(table.title)}[/]"
            yield show.text_table(table)
