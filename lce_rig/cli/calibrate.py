"""`lce-rig calibrate`: estimate the extrinsics of a session, judge them and write them as files."""

import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click
import numpy as np

from lce_rig.cli import show
from lce_rig.cli.options import (
    cameras_option,
    event_image_option,
    require_sensors,
    robot_option,
    split_names,
)
from lce_rig.core.calibration import (
    DEFAULT_METHOD,
    AxisOpinion,
    Calibration,
    Method,
    OtherCamera,
    SceneOpinion,
)
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import Array, sigma_sizes
from lce_rig.core.phrasing import motion_words
from lce_rig.detect.detection import Pair
from lce_rig.judge.findings import weakest_words
from lce_rig.words import not_enough, sentence

# The uncertainty in the report: by axis, and for points at several distances.

_AXES = ("x right", "y down", "z forward")


def uncertainty_lines(calibration: Calibration) -> list[str]:
    """State extrinsics's standard deviations and its least certain motion, in lines of 80 columns."""
    c = calibration
    sigmas = np.sqrt(np.diag(c.cov))
    return [
        f"  uncertainty  {c.sigma_rotation_deg:.3f} deg, {1000 * c.sigma_translation_m:.1f} mm (1 sigma)",
        f"               about {_by_axis(np.degrees(sigmas[3:]), '.3f')} deg",
        f"               along {_by_axis(1000 * sigmas[:3], '.1f')} mm",
        *_boards_alone(c),
        *([f"  weakest: {weakest_words(c.weakest)}"] if c.weakest else []),
        *_at_distances(c),
    ]


def _boards_alone(c: Calibration) -> list[str]:
    if c.scene_share is None or c.scene_share.state != "used":
        return []
    sigma_deg, sigma_m = sigma_sizes(c.scene_share.cov_boards)
    return [f"               of the boards alone {sigma_deg:.3f} deg, {1000 * sigma_m:.1f} mm"]


def _by_axis(values: Array, digits: str) -> str:
    return ", ".join(f"{axis} {value:{digits}}" for axis, value in zip(_AXES, values, strict=True))


def _at_distances(c: Calibration) -> list[str]:
    if not c.uncertainty:
        return []
    columns = [f"{each.distance_m:g} m away" for each in c.uncertainty]
    centre = [f"{each.centre_px:.1f} px, {100 * each.centre_m:.1f} cm" for each in c.uncertainty]
    corner = [f"{each.corner_px:.1f} px, {100 * each.corner_m:.1f} cm" for each in c.uncertainty]
    return [
        f"  {title:<13}" + "".join(f"{cell:<20}" for cell in cells).rstrip()
        for title, cells in (("a point", columns), ("  in centre", centre), ("  in corner", corner))
    ]


_OPINIONS = {"agrees": "agrees", "contradicts": "[red]contradicts[/]", "unknown": "cannot tell"}


def scene_texts(opinion: SceneOpinion) -> list[str]:
    """State the scene's opinion: what contradicts, which changes it would see, and what it cannot tell."""
    if not opinion.n_captures:
        return ["cannot tell: no capture has a frame and a scan"]
    seen = f"{show.counted(opinion.n_captures, 'capture')}, {opinion.n_edges} edges"
    if not opinion.axes:
        return [f"cannot tell: too few edges ({seen})"]
    texts = [f"{_OPINIONS[opinion.state]} ({seen})"]
    texts += [
        f"{motion_words(axis.axis)}: {_value(axis, axis.change, '+')} +- {_value(axis, axis.sigma)} "
        f"{_UNITS[axis.unit]}"
        for axis in opinion.of("contradicts")
    ]
    texts += [f"would see changes {kind}" for kind in _by_kind(opinion.of("agrees"), with_size=True)]
    if opinion.state != "unknown" and opinion.of("unknown"):
        texts.append(f"cannot tell changes {'; '.join(_by_kind(opinion.of('unknown')))}")
    return texts


def _by_kind(axes: Sequence[AxisOpinion], *, with_size: bool = False) -> list[str]:
    """Name axes as rotations about and translations along x, y and z."""
    parts = []
    for unit, kind in (("deg", "about"), ("m", "along")):
        own = [axis for axis in axes if axis.unit == unit]
        names = [
            f"{each.axis[-1]} {_value(each, each.smallest)}" if with_size else each.axis[-1] for each in own
        ]
        if own:
            parts.append(f"{kind} {', '.join(names)}{' ' + _UNITS[unit] if with_size else ''}")
    return parts


_UNITS = {"deg": "deg", "m": "mm"}


def _value(axis: AxisOpinion, value: float | None, sign: str = "") -> str:
    if value is None:
        return "?"
    return f"{value:{sign}.2f}" if axis.unit == "deg" else f"{1000 * value:{sign}.0f}"


# The report of several cameras: their relative poses, and which of them has no result.


def together_lines(calibration: Calibration) -> list[str]:
    """Name the cameras of the joint estimate, and the standard deviation without them."""
    if not calibration.estimated_with:
        return []
    figures = calibration.diagnostics
    alone = ""
    if math.isfinite(figures.alone_sigma_rotation_deg):
        sigma_mm = 1000 * figures.alone_sigma_translation_m
        alone = f"; uncertainty alone {figures.alone_sigma_rotation_deg:.3f} deg, {sigma_mm:.1f} mm"
    return [f"  together     with {', '.join(calibration.estimated_with)}{alone}"]


def camera_lines(calibration: Calibration, calibrations: Sequence[Calibration]) -> list[str]:
    """State the poses of cameras earlier in the result relative to this one, each pair of cameras once."""
    c = calibration
    others = {other.camera: other for other in c.other_cameras}
    lines: list[str] = []
    for earlier in calibrations[: calibrations.index(c)]:
        if earlier.lidar == c.lidar and earlier.camera in others:
            lines += _camera_lines(c.camera, others[earlier.camera])
        elif earlier.lidar == c.lidar:
            lines.append(
                f"[bold]{earlier.camera} and {c.camera}[/]: not compared, as no still board was seen by both"
            )
    return lines


def lacking_extrinsics(
    wanted: Sequence[str], seen: Collection[str], calibrations: Sequence[Calibration]
) -> NotEnoughDataError | None:
    """Name the cameras without extrinsics; None if all have them.

    Args:
        wanted: cameras that should have extrinsics.
        seen: cameras of which the session holds captures.
        calibrations: the results, at least one.
    """
    calibrated = {calibration.camera for calibration in calibrations}
    missing = [camera for camera in wanted if camera not in calibrated]
    if not missing:
        return None
    causes = [f"No capture holds an image of {name} and a scan." for name in missing if name not in seen]
    others = " ".join(f"--camera {name}" for name in wanted if name in calibrated)
    return NotEnoughDataError(
        f"no extrinsics of camera {', '.join(missing)}",
        "\n".join([*causes, f"Collect more captures, or omit the camera: {others}"]),
    )


def _camera_lines(camera: str, other: OtherCamera) -> list[str]:
    name = other.camera
    lines = [
        f"[bold]{name} and {camera}[/], from {other.n_captures} captures of both",
        f"  T_{camera}_{name} (p_{camera} = R p_{name} + t)",
        *("    " + "  ".join(f"{value: .6f}" for value in row) for row in other.T_cam_other[:3]),
    ]
    if other.cov is not None:
        sigma_deg, sigma_m = sigma_sizes(other.cov)
        lines.append(f"  uncertainty  {sigma_deg:.3f} deg, {1000 * sigma_m:.1f} mm (1 sigma)")
    if other.apart_rotation_deg is not None and other.apart_translation_m is not None:
        separately = ", each camera estimated separately" if other.cov is not None else ""
        lines.append(
            f"  images       differ by {other.apart_rotation_deg:.3f} deg, "
            f"{1000 * other.apart_translation_m:.1f} mm{separately}"
        )
    lines.append(f"  boards       {1000 * other.board_rms_m:.1f} mm apart")
    return lines


if TYPE_CHECKING:
    from lce_rig.pipeline.result_files import WrittenResult


@click.command()
@click.argument("sessions", nargs=-1, type=click.Path(path_type=Path), metavar="[SESSION]...")
@click.option(
    "--reference",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Report the error from the T_cam_lidar of this JSON file; the estimate does not use it.",
)
@cameras_option
@click.option(
    "--channels",
    callback=split_names,
    metavar="NAME[,NAME]",
    help="Use only these channels, such as frames or events [default: all, in one joint estimate].",
)
@event_image_option
@click.option(
    "--method",
    type=click.Choice(get_args(Method)),
    default=DEFAULT_METHOD,
    show_default=True,
    help="Estimate by maximum likelihood, from the result of Algorithm 1 of LCE-Calib (ml), or by that alone "
    "(paper).",
)
@click.option(
    "--use-scene", is_flag=True, help="Estimate from the edges of the scene too, not from the board alone."
)
@click.option(
    "--name",
    metavar="NAME",
    help="Write the result to SESSION/results/NAME/ and leave SESSION/calibration/ unchanged "
    "[default of several sessions: union].",
)
@robot_option
@click.option("--json", "as_json", is_flag=True, help="Print result.json on stdout.")
@click.option("--force", is_flag=True, help="Export failed results too, marked NOT FOR USE.")
@click.option("--no-report", is_flag=True, help="Do not write report.html.")
@click.option(
    "--seed", default=0, show_default=True, type=click.IntRange(0), help="Set the seed of the random subsets."
)
@click.option(
    "--draws",
    "n_draws",
    type=click.IntRange(0, 10_000),
    help="Set the number of random subsets per size, I in the paper [default: 30; with --method paper 100].",
)
def calibrate(
    sessions: tuple[Path, ...],
    reference: Path | None,
    cameras: tuple[str, ...],
    channels: list[str] | None,
    event_image: Any,
    use_scene: bool,
    name: str | None,
    robot: str | None,
    as_json: bool,
    force: bool,
    no_report: bool,
    method: Any,
    seed: int,
    n_draws: int | None,
) -> None:
    """Estimate the extrinsics between the LiDAR and each camera of SESSION (default: session/).

    Writes SESSION/calibration/ in one step: result.json, report.html (the result explained, with drawings),
    extrinsics.yaml, URDF, camera_info and static transforms. The earlier result moves to
    SESSION/calibration/previous/. A run without a result leaves it unchanged.

    Several SESSIONs of one rig whose sensors were not moved in between give one result from all captures. It
    goes into results/union/ of the first; nothing else changes. Each session is calibrated alone before, and
    sessions that disagree are refused.

    Exits with 7 if a result has failed; the exports then skip that camera, unless --force is given. Exits
    with 7 if sessions disagree, and with 6 if a camera has no result.
    """
    import lce_rig as lce
    from lce_rig.core.errors import UsageError
    from lce_rig.export.reference import read_reference
    from lce_rig.pipeline.result_files import OVERLAYS, UNION, new_result_parts
    from lce_rig.pipeline.union import require_unit
    from lce_rig.session.provenance import provenance_of

    paths = sessions or (Path("session"),)
    name = UNION if name is None and len(paths) > 1 else name
    new_result_parts(name)
    opened = [lce.Session.open(path) for path in paths]
    require_unit(opened)
    for each in opened:
        each.rig = each.rig.of_robot(robot)
    provenance_of(opened)
    first, rig = opened[0], opened[0].rig
    require_sensors("camera", cameras, rig.cameras)
    options = lce.CalibrateOptions(method, n_draws, seed)
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
    with _earlier_result_named(first.path.joinpath(*new_result_parts(name))):
        detections = []
        for each in opened:
            with show.progress_bar("detecting") as progress:
                detections.append(lce.detect(each, event_image=event_image, progress=progress))
        with show.progress_bar("calibrating") as progress:
            result = lce.calibrate(
                opened,
                detections,
                options=options,
                cameras=cameras or None,
                channels=channels,
                reference=truth,
                use_scene=use_scene,
                progress=progress,
            )
        for shortage in result.shortages:
            show.warn(str(not_enough(shortage)))
        if truth is not None and any(c.egt_rotation_deg is None for c in result.pairs):
            show.warn(f"{reference} has no T_cam_lidar for these sensors")
        written = result.write(name=name, force=force, report=not no_report)
    if written.had_overlays:
        with show.progress_bar("drawing") as progress:
            lce.verify(first, result, detections[0], name=name, event_image=event_image).write(
                progress=progress
            )
        show.note(f"overlays drawn again in {written.files[0].parent / OVERLAYS}")
    if as_json:
        show.print_json(result.document())
    else:
        for calibration in result.pairs:
            show.print_lines(_lines(calibration))
        for calibration in result.pairs:
            show.print_lines(camera_lines(calibration, result.pairs))
        folder = written.files[0].parent
        names = ", ".join(str(file.relative_to(folder)) for file in written.files)
        show.note(f"written: {names} in {folder}")
    if written.report is not None:
        show.note(f"report: {written.report}")
    for finding in written.findings:
        if finding.severity != "note":
            show.warn(sentence(finding))
    _tell_earlier(written)
    seen = {pair.camera for own in detections for pair in own.pairs}
    _exit(result.pairs, wanted, seen, are_printed=not as_json)


@contextmanager
def _earlier_result_named(folder: Path) -> Iterator[None]:
    """Say that the files are those of an earlier run if this one ends without a result."""
    from lce_rig.core.errors import LceRigError
    from lce_rig.pipeline.result_files import RESULT

    try:
        yield
    except LceRigError:
        with suppress(OSError):
            if (folder / RESULT).exists():
                show.note(f"{folder} is unchanged, with the result of an earlier run")
        raise


def _tell_earlier(written: "WrittenResult") -> None:
    """Say where the earlier run's files are, and which are usable."""
    has_exports = len(written.files) > 1
    if written.previous is None:
        return
    if not has_exports and written.has_usable_previous:
        show.warn(f"this result is not exported; the last usable result is in {written.previous}")
    elif not written.is_same:
        show.note(f"the earlier result is in {written.previous}")
    if written.only_previous:
        show.note(f"not calibrated in this run: {', '.join(written.only_previous)}")


def _exit(
    calibrations: Sequence[Calibration], wanted: Sequence[str], seen: Collection[str], *, are_printed: bool
) -> None:
    """Exit with 7 if a result has failed, else with 6 if a camera has no result."""
    lacking = lacking_extrinsics(wanted, seen, calibrations)
    if lacking is not None and any(c.verdict == "fail" for c in calibrations):
        show.warn(str(lacking))
    exit_by_verdict(calibrations, are_printed=are_printed)
    if lacking is not None:
        raise lacking


def exit_by_verdict(calibrations: Sequence[Calibration], *, are_printed: bool = False) -> None:
    """Exit with 7 if a result has failed.

    Raises:
        ResultRefusedError: the worst verdict is "fail".
    """
    from lce_rig.core.errors import ResultRefusedError

    failed = [c for c in calibrations if c.verdict == "fail"]
    if failed:
        pairs = ", ".join(str(Pair.of(c)) for c in failed)
        causes = "\n".join(sentence(finding) for c in failed for finding in c.findings)
        raise ResultRefusedError(f"failed: {pairs}; do not use this result", "" if are_printed else causes)


def _held_out(held_out_m: float) -> str:
    return f"held out {1000 * held_out_m:.1f} mm, " if math.isfinite(held_out_m) else ""


def _lines(calibration: Calibration) -> list[str]:
    c = calibration
    colour = show.COLOURS[c.verdict]
    metrics = c.metrics
    lines = [
        f"[bold]{Pair.of(c)}[/]: [bold {colour}]{c.verdict.upper()}[/]",
        "  T_cam_lidar (p_cam = R p_lidar + t)",
        *("    " + "  ".join(f"{value: .6f}" for value in row) for row in c.T_cam_lidar[:3]),
        *uncertainty_lines(c),
        f"  captures     {len(c.captures_used)} used of {c.n_captures}, "
        f"board found by both sensors in {c.n_detected}",
        f"  residuals    planes {1000 * metrics.mpe_m:.1f} mm, edges {1000 * metrics.mee_m:.1f} mm, "
        f"{_held_out(c.held_out_m)}corners {metrics.reprojection_px:.2f} px",
        f"  certificate  {_certificate(c)}",
    ]
    lines += [*_channel_lines(c), *together_lines(c)]
    if c.egt_rotation_deg is not None and c.egt_translation_m is not None:
        lines.append(
            f"  reference    error {c.egt_rotation_deg:.3f} deg, {1000 * c.egt_translation_m:.1f} mm"
        )
    for k, text in enumerate([] if c.scene is None else scene_texts(c.scene)):
        lines.append(f"  {'scene' if k == 0 else '':<13}{text}")
    for name, why in c.captures_refused.items():
        lines.append(f"  [dim]{show.escape(f'{name} {why.stage}: {sentence(why)}')}[/]")
    lines += [f"  [{colour}]{show.escape(sentence(finding))}[/]" for finding in c.findings]
    return lines


def _certificate(calibration: Calibration) -> str:
    is_optimal, gap = calibration.certificate.is_optimal, calibration.certificate.gap
    if not math.isfinite(gap):
        return f"none (method {calibration.method} has no certificate)"
    of_start = " of Algorithm 1, where the estimate starts" if calibration.is_start_certified else ""
    return f"{'global minimum' if is_optimal else '[red]not proven[/]'}{of_start}, gap {gap:.0e}"


def _channel_lines(calibration: Calibration) -> list[str]:
    """Say what each channel contributes if there are several, or if boards moved."""
    results = calibration.channel_results
    if len(results) == 1 and results[0].time_offset_s is None:
        return []
    texts = []
    for result in results:
        text = f"{result.channel}: {result.n_captures} captures, corner noise {result.noise_px:.2f} px"
        if result.time_offset_s is not None and result.time_offset_sigma_s is not None:
            text += (
                f", time offset {1000 * result.time_offset_s:+.0f} +- "
                f"{1000 * result.time_offset_sigma_s:.0f} ms, "
                f"depth scatter {1000 * result.depth_scatter_m:.1f} mm "
                f"({1000 * result.depth_scatter_still_m:.1f} without motion compensation)"
            )
        texts.append(text)
    figures = calibration.diagnostics
    if math.isfinite(figures.channels_rotation_deg):
        texts.append(
            f"channels differ by {figures.channels_rotation_deg:.2f} deg, "
            f"{1000 * figures.channels_translation_m:.1f} mm"
        )
    return [f"  {'channels' if k == 0 else '':<13}{text}" for k, text in enumerate(texts)]
