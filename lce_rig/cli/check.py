"""`lce-rig check`: report the detections in every capture, and the cause and action for refused ones."""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

import lce_rig as lce
from lce_rig.calibrate.association import is_of_all
from lce_rig.calibrate.observations import group_placements
from lce_rig.cli import show
from lce_rig.cli.options import explain_option, json_option, session_argument
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.results import BoardPose, BoardSurface
from lce_rig.detect.detection import Detections, Pair, PoseDetection, SurfaceDetection
from lce_rig.detect.findings import IMAGE_MISFIT
from lce_rig.pipeline.detect_session import association_errors, match_sensors, unlike_models
from lce_rig.pipeline.verification import write_debug_images
from lce_rig.rig import Rig


@click.command()
@session_argument
@explain_option
@json_option
@click.option("--debug-images", is_flag=True, help="Write one image per capture into SESSION/debug/.")
def check(session: Path, explain: bool, as_json: bool, debug_images: bool) -> None:
    """Report how many captures of SESSION (default: session/) are usable, and why the others are not.

    A capture is usable if both sensors detect the board and agree on its place. Exits with 6 if no capture is
    usable.
    """
    opened = lce.Session.open(session)
    if not opened.captures:
        raise NotEnoughDataError(
            f"{session} holds no captures",
            f"Add some: `lce-rig collect --rig RIG {session}`, or with `--from RECORDING`.",
        )
    with show.progress_bar("detecting") as progress:
        detections = lce.detect_boards(opened, progress=progress)
    show.warn_of(unlike_models(opened, detections))
    if debug_images:
        with show.progress_bar("drawing") as progress:
            folder = write_debug_images(opened, detections, progress=progress)
        show.note(f"debug images: {folder}")
    documents, n_usable, is_contradicted = [], 0, False
    for pair in [*detections.pairs, *detections.peers(opened.rig.lidars)]:
        board = opened.rig.board.to_board()
        refused, _ = match_sensors(opened.rig, detections, pair)
        plates = _plates(opened.rig, detections, pair, refused)
        usable = [each for each in detections.candidates(pair, board)[0] if each.capture not in refused]
        numbers = group_placements(usable).tolist()
        placements = {each.capture: number for each, number in zip(usable, numbers, strict=True)}
        records = {
            name: _record(*both, refused.get(name)) | {"placement": placements.get(name)}
            for name, both in detections.between(pair, board).items()
        }
        sensors = {"camera": pair.camera, "channel": pair.channel, "lidar": pair.lidar}
        documents.append({**sensors, "captures": records, "findings": plates})
        if not as_json:
            if explain:
                show.print_table(_table(detections, pair, records))
            show.print_parts(_head(pair, records, refused, opened.rig.quality.min_captures))
            show.print_parts(_causes([*records], refused, plates, str(session), is_whole=explain))
            show.print_parts(_repeated(placements, is_whole=explain))
        n_usable = max(n_usable, len(records) - len(refused))
        is_contradicted |= any(each.severity == "error" for each in plates)
    if as_json:
        show.print_json({"format_version": 1, "rig": opened.rig.name, "pairs": documents})
    if n_usable >= opened.rig.quality.min_captures and not is_contradicted:
        show.name_next("calibrate", session)
    if n_usable == 0:
        raise NotEnoughDataError(
            f"{session}: no capture is usable",
            "Follow the actions above"
            + (
                "." if debug_images else f", or draw the detections: `lce-rig check {session} --debug-images`"
            ),
        )


def _plates(rig: Rig, detections: Detections, pair: Pair, refused: Mapping[str, Refusal]) -> list[Finding]:
    """Compare the plate's size in all scans of a pair, and the boards' distances, with the profile.

    Unmatched images and scans come first, and alone if they concern all captures.
    """
    from lce_rig.judge.verdict import distance_findings, plate_findings

    board, scans = rig.board.to_board(), list[BoardSurface | Refusal]()
    for name, (_, scan) in detections.between(pair, board).items():
        if isinstance(scan, Refusal):
            scans.append(scan)
        elif name not in refused or refused[name].stage == "image":
            scans.append(scan[0])
    association = association_errors(rig, detections, pair) if pair.channel else []
    if any(is_of_all(each) for each in association):
        return association
    both = detections.candidates(pair, board)[0]
    in_camera = np.array([each.pose.T_cam_board[:3, 3] for each in both]).reshape(-1, 3)
    in_lidar = np.array([each.surface.T_lidar_board[:3, 3] for each in both]).reshape(-1, 3)
    of_distances = []
    if pair.channel:
        n_misfits = sum(refusal.code == IMAGE_MISFIT.code for refusal in refused.values())
        of_distances = distance_findings(in_camera, in_lidar, rig.board.square_m, n_misfits=n_misfits)
    return [*association, *of_distances, *plate_findings(scans, board)]


def _record(pose: PoseDetection, surfaces: SurfaceDetection, refusal: Refusal | None) -> dict[str, Any]:
    """Describe a capture for JSON output; unmeasured figures are null."""

    def figures(detected: BoardPose | BoardSurface | Refusal) -> dict[str, float | None] | None:
        if isinstance(detected, Refusal):
            return None
        values = detected.figures().items()
        return {key: float(value) if math.isfinite(value) else None for key, value in values}

    return {
        "is_usable": refusal is None,
        "refusal": None if refusal is None else refusal.as_json(),
        "image": figures(pose),
        "lidar": figures(surfaces if isinstance(surfaces, Refusal) else surfaces[0]),
        "n_surfaces": 0 if isinstance(surfaces, Refusal) else len(surfaces),
    }


# Heading and unit, sensor, figure in SI units, digits.
Column = tuple[str, str, str, int]
_PER_UNIT = {"mm": 1000, "cm/s": 100}
_IMAGE: tuple[Column, ...] = (
    ("dist\nm", "image", "distance_m", 2),
    ("tilt\ndeg", "image", "tilt_deg", 0),
    ("corner\npx", "image", "corner_rms_px", 2),
    ("sharp", "image", "sharpness", 1),
)
_EVENTS: tuple[Column, ...] = (
    ("events\npx/s", "image", "events_px_s", 1),
    ("speed\ncm/s", "image", "speed_mps", 0),
)
_POINTS: tuple[Column, ...] = (("points", "lidar", "n_points", 0),)
_LIDAR: tuple[Column, ...] = (
    ("rings", "lidar", "n_rings", 0),
    ("plane\nmm", "lidar", "plane_rms_m", 1),
    ("wide\nm", "lidar", "width_m", 3),
    ("high\nm", "lidar", "height_m", 3),
    ("edges\nmm", "lidar", "edge_rms_m", 1),
)
# A side without ring ends has a larger standard deviation; its length is the profile's, not a measurement.
_SIDE_SIGMA_MAX_M = 0.05


def _table(detections: Detections, pair: Pair, records: Mapping[str, dict[str, Any]]) -> Any:
    """List the captures, in columns that fit a terminal of 80 characters."""
    images = detections.images.get((pair.camera, pair.channel), {}).values()
    # Images from events have their own figures.
    is_from_events = any(not isinstance(image, Refusal) and image.events is not None for image in images)
    columns = (*_IMAGE, *(_EVENTS if is_from_events else _POINTS), *_LIDAR)
    rows = []
    for name, record in records.items():
        cells = []
        for heading, sensor, key, digits in columns:
            figures, scale = record[sensor] or {}, _PER_UNIT.get(heading.partition("\n")[2], 1)
            sigma_m = figures.get(f"{key.removesuffix('_m')}_sigma_m") or 0.0
            value = None if sigma_m > _SIDE_SIGMA_MAX_M else figures.get(key)
            cells.append("-" if value is None else f"{scale * value:.{digits}f}")
        state = "[green]ok[/]" if record["is_usable"] else f"[red]{record['refusal']['stage']}[/]"
        rows.append((name, *cells, state))
    headings = (f">{title}" for title, *_ in columns)
    return show.plain_table(str(pair), "capture", *headings, "", rows=rows)


def _head(
    pair: Pair, captures: Collection[str], refused: Mapping[str, Refusal], needed: int
) -> Iterator[str]:
    """State how many captures are usable, and whether they suffice."""
    n_usable = len(captures) - len(refused)
    n_detected = n_usable + sum(why.stage == "pair" for why in refused.values())
    colour = "red" if n_usable < needed else "yellow" if refused else "green"
    minimum = f" (minimum {needed})" if n_usable < needed else ""
    yield f"[bold]{pair}[/]: [{colour}]{n_usable} of {len(captures)} captures usable[/]{minimum}"
    if n_detected > n_usable:
        yield f"  both sensors detect the board in {n_detected}"


def _causes(
    names: Sequence[str],
    refused: Mapping[str, Refusal],
    plates: Sequence[Finding],
    session: str,
    *,
    is_whole: bool,
) -> list[str]:
    """List refused captures, grouped by cause and action; causes of the whole session come first.

    Args:
        names: names of all captures.
        refused: refusals by capture name.
        plates: findings about the plate's size in all scans.
        session: path, for the commands of actions.
        is_whole: whether to list every capture with its figures.
    """
    lines = []
    for finding in plates:
        colour = "red" if finding.severity == "error" else "yellow"
        lines += show.cause_lines(finding.text, finding.advice_at(session), colour)
    groups: dict[tuple[str, str], list[str]] = {}
    for name in names:
        if name in refused:
            groups.setdefault((refused[name].code, refused[name].advice_at(session)), []).append(name)
    for (_, advice), captures in sorted(groups.items(), key=lambda group: -len(group[1])):
        stage, texts = refused[captures[0]].stage, [refused[name].text for name in captures]
        if len(set(texts)) == 1:
            who = f"all {len(names)}" if len(captures) == len(names) > 1 else show.name_ranges(captures)
            lines += show.cause_lines(f"{who} {stage}: {texts[0]}", advice)
        elif len(captures) > _MOST_LISTED and not is_whole:
            lines += show.cause_lines(
                f"{len(captures)} captures, {stage}, such as {captures[0]}: {texts[0]}", advice
            )
        else:
            lines += [
                f"  {name} {stage}: {show.escape(text)}" for name, text in zip(captures, texts, strict=True)
            ]
            lines.append(f"    -> {show.escape(advice)}")
    return lines


# Maximum number of captures listed individually per cause; beyond it the first one represents all.
_MOST_LISTED = 4


def _repeated(placements: Mapping[str, int], *, is_whole: bool) -> list[str]:
    """Name captures that show one placement; such captures are not independent."""
    groups: dict[int, list[str]] = {}
    for name, number in placements.items():
        groups.setdefault(number, []).append(name)
    repeated = sorted((names for names in groups.values() if len(names) > 1), key=len, reverse=True)
    if not repeated:
        return []
    shown = repeated if is_whole else repeated[:2]
    texts = [f"{show.name_ranges(names)} show one" for names in shown]
    texts += [f"{len(repeated) - len(shown)} more repeated"] if len(shown) < len(repeated) else []
    return [f"  {show.counted(len(groups), 'placement')}: {'; '.join(texts)}"]
