"""A profile for a rig of one's own: from its data sheets, or from a bag that it recorded."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Scan
from lce_rig.core.data_sheets import find_data_sheet
from lce_rig.core.errors import SourceError, UsageError
from lce_rig.detect.lidar.segments import order_scan
from lce_rig.export.camera_info import load_camera_info
from lce_rig.io.folder.cloud import to_scan
from lce_rig.io.folder.decoding import DECODERS, read_cloud
from lce_rig.io.ros.topics import SensorTopic, survey_bag
from lce_rig.rig import LidarSettings
from lce_rig.rig.draft import CameraDraft, LidarDraft, draft_profile

_UNKNOWN_MODEL = "other"
# A ring that sees one distance only has no height: 0.1 mrad against 15 mm.
_HEIGHT_PRIOR = (1e-4 / 0.015) ** 2
_BOARD = re.compile(r"(\d+)x(\d+),([^,x]+),([^,x]+)x([^,x]+)(?:,([^,x]+),([^,x]+))?")
_SIZE = re.compile(r"(\d{1,5})x(\d{1,5})")
_FAMILIES: dict[str, Literal["radtan", "equidistant"]] = {
    "radtan": "radtan",
    "plumb_bob": "radtan",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
}
BOARD_FORM = "COLSxROWS,SQUARE,WIDTHxHEIGHT[,RIGHT,UP], lengths in m, such as 8x6,0.07,0.767x0.626"
_LENS_FORM = (
    "MODEL,WIDTHxHEIGHT,FX,FY,CX,CY,K1,..., such as radtan,1280x720,897.5,896.8,635.4,375.3,-0.44,0.23,0,0"
)


def new_profile(
    name: str,
    board: Board,
    *,
    recording: Path | None = None,
    lidar_model: str | None = None,
    cameras: Sequence[str] = (),
    intrinsics: Sequence[Intrinsics] = (),
    source: str = "profile",
) -> tuple[str, list[str]]:
    """Write the text of a profile.

    Args:
        name: of the rig.
        board: as it was measured.
        recording: a bag, whose topics name the sensors, frames, rates and, by camera_info, the lenses; or a
            folder with point clouds in pcd/. The beams of a LiDAR of no known model are measured in it.
        lidar_model: maker's name of the LiDAR's model; None where it is not known.
        cameras: names of the cameras, in the order of their topics where there is a bag.
        intrinsics: of the cameras, in the same order; those of a bag where it is empty.
        source: what to call the text in errors.

    Returns:
        The text; and what was found and chosen, a line each.

    Raises:
        UsageError: a camera without intrinsics, or names or intrinsics of cameras that are not there.
        SourceError: the bag cannot be read, or holds no camera or no LiDAR.
        ProfileError: the parts do not make a valid profile.
    """
    clouds = None if recording is None else clouds_in(recording)
    topics = survey_bag(recording) if recording is not None and not clouds else []
    lidars = list(_lidars([t for t in topics if t.kind == "scans"], lidar_model))
    if clouds:
        lidars = [_with_beams(lidars[0], read_cloud(clouds[0]), str(clouds[0]))]
    groups = _by_camera([t for t in topics if t.kind != "scans"])
    if recording is not None and not clouds:
        for kinds, what in ((("scans",), "point clouds"), (("frames", "events"), "images or events")):
            if not any(topic.kind in kinds for topic in topics):
                listed = "; ".join(map(_line, topics))
                raise SourceError(f"{recording}: no {what}, so that it is no recording of a rig", listed)
        _require_count(len(cameras), len(groups), "names (--camera)", recording)
        _require_count(len(intrinsics), len(groups), "--intrinsics", recording)
    else:
        groups = [[] for _ in cameras or ("cam",)]
        if len(intrinsics) != len(groups):
            raise UsageError(
                f"intrinsics of {len(intrinsics)} of {len(groups)} cameras given",
                f"Give --intrinsics once for each --camera: a camera_info file, or {_LENS_FORM}.",
            )
    names = list(cameras) or _names(groups)
    used = {lidar.frame for lidar in lidars}
    drafts = []
    for index, (camera, group) in enumerate(zip(names, groups, strict=True)):
        lens = intrinsics[index] if intrinsics else _lens(camera, group)
        frame = next((t.frame for t in group if t.frame and t.frame not in used), None)
        used.add(frame)
        draft = CameraDraft(camera, lens, frame)
        if group:
            draft = draft._replace(
                channels=[("events" if t.kind == "events" else "frames", t.topic) for t in group]
            )
        drafts.append(draft)
    found = [_line(topic) for topic in topics] + [f"{each.name}: {each.sees}" for each in lidars if clouds]
    return draft_profile(name, lidars, drafts, board, source), found


def clouds_in(folder: Path) -> list[Path]:
    """List the point clouds of a folder that holds images and them, by name; empty for any other."""
    there = (folder / "pcd").iterdir() if (folder / "pcd").is_dir() else ()
    return sorted(path for path in there if path.suffix in DECODERS)


def measure_beams(scan: Scan) -> tuple[list[float], int | None]:
    """Measure a LiDAR's beams in one of its scans.

    A laser h above the frame's origin and inclined by alpha draws the line z = rho tan(alpha) + h over the
    distance rho from the axis: z / rho is fitted against 1 / rho for each ring.

    Args:
        scan: of at least a few metres around, in the LiDAR's own frame.

    Returns:
        The elevation of each ring in deg, from the lowest; firings of each ring per revolution, None where
        too few returns follow each other.
    """
    rho = np.hypot(scan.points[:, 0], scan.points[:, 1]).astype(np.float64)
    x, y = 1 / rho, scan.points[:, 2] / rho
    elevations = []
    for ring in np.unique(scan.ring):
        mine = scan.ring == ring
        # Fit twice: returns of foreign rings and of edges are few, but far off.
        for _ in range(2):
            dx, dy = x[mine] - x[mine].mean(), y[mine] - y[mine].mean()
            height_m = float(np.clip((dx @ dy) / (dx @ dx + _HEIGHT_PRIOR * mine.sum()), -0.05, 0.05))
            slope = float(np.median(y[mine] - height_m * x[mine]))
            mine = mine & (np.abs(y - height_m * x - slope) < 0.01)
            if not mine.any():
                break
        elevations.append(float(np.degrees(np.arctan(slope))))
    step_rad = order_scan(scan, min_range_m=0.3).step_rad
    return sorted(elevations), round(2 * np.pi / step_rad) if step_rad > 0 else None


def parse_board(text: str) -> Board:
    """Read a board as "8x6,0.07,0.767x0.626": inner corners, square, plate and, if given, the offset.

    Raises:
        UsageError: it is not written like this.
    """
    match = _BOARD.fullmatch(text.replace(" ", ""))
    try:
        if match is None:
            raise ValueError
        cols, rows, *lengths = match.groups()
        square, width, height, right, up = (float(value or 0) for value in lengths)
    except ValueError:
        raise UsageError(f"--board {text}: give {BOARD_FORM}") from None
    return Board(int(cols), int(rows), square, width, height, (right, up))


def parse_intrinsics(text: str) -> Intrinsics:
    """Read a camera_info file, or intrinsics as "radtan,1280x720,897.5,896.8,635.4,375.3,-0.44,0.23,0,0".

    Raises:
        UsageError: it is neither.
        ProfileError: the file cannot be used.
    """
    model, *values = re.split(r"\s*,\s*|\s+", text.strip())
    if len(values) < 5 and not (values and values[0] and model in _FAMILIES):
        path = Path(text)
        if not text or len(text) > 4000 or not path.exists():
            raise UsageError(f"--intrinsics {text[:200]}: there is no such file", f"Or give {_LENS_FORM}.")
        return load_camera_info(path)
    size = _SIZE.fullmatch(values[0])
    try:
        if size is None or model not in _FAMILIES:
            raise ValueError
        fx, fy, cx, cy, *distortion = map(float, values[1:])
    except ValueError:
        models = ", ".join(_FAMILIES)
        raise UsageError(
            f"--intrinsics {text}: neither a camera_info file nor intrinsics",
            f"Give {_LENS_FORM}; models: {models}.",
        ) from None
    width, height = map(int, size.groups())
    return Intrinsics(fx, fy, cx, cy, width, height, _FAMILIES[model], tuple(distortion))


def _lidars(topics: Sequence[SensorTopic], model: str | None) -> Iterator[LidarDraft]:
    for index, topic in enumerate(topics):
        name = "lidar" if len(topics) == 1 else f"lidar_{index + 1}"
        sees = "" if topic.n_rings is None else f"{topic.n_rings} rings in the recording"
        rate_hz = None if topic.rate_hz is None else round(topic.rate_hz, 1) or None
        draft = LidarDraft(name, model or _UNKNOWN_MODEL, topic.frame or None, topic.topic, rate_hz, sees)
        yield draft if topic.cloud is None else _with_beams(draft, topic.cloud, topic.topic)
    if not topics:
        yield LidarDraft(model=model or _UNKNOWN_MODEL)


def _with_beams(lidar: LidarDraft, cloud: NDArray[Any], where: str) -> LidarDraft:
    """Add the beams that a cloud shows, where the model's are not known."""
    if find_data_sheet(lidar.model) is not None:
        return lidar
    scan = to_scan(cloud, lidar.name, LidarSettings.model_validate({"model": lidar.model}), where).scan
    elevations_deg, columns = measure_beams(scan)
    sees = f"{len(elevations_deg)} rings, {columns or 'unknown'} columns in the recording"
    return lidar._replace(elevations_deg=elevations_deg, columns=columns, sees=sees)


def _by_camera(topics: Sequence[SensorTopic]) -> list[list[SensorTopic]]:
    """Group topics by camera: frames and events in one namespace share a lens; two of a kind do not."""
    groups: list[list[SensorTopic]] = []
    for topic in topics:
        for group in groups:
            if group[0].namespace == topic.namespace and topic.kind not in [each.kind for each in group]:
                group.append(topic)
                break
        else:
            groups.append([topic])
    return [sorted(group, key=lambda topic: topic.kind == "events") for group in groups]


def _names(groups: Sequence[Sequence[SensorTopic]]) -> list[str]:
    """Name cameras by the last part of their topics' namespaces."""
    if len(groups) == 1:
        return ["cam"]
    names: list[str] = []
    for group in groups:
        word = group[0].namespace.rpartition("/")[2] if group else ""
        word = re.sub(r"[^a-z0-9_]", "_", word.lower()).lstrip("0123456789_")
        names.append(word if word and word not in [*names, "lidar"] else f"cam_{len(names) + 1}")
    return names


def _lens(camera: str, group: Sequence[SensorTopic]) -> Intrinsics:
    for topic in group:
        if topic.intrinsics is not None:
            return topic.intrinsics
    topic = group[0]
    why = next((each.note for each in group if each.note), f"no camera_info beside {topic.topic}")
    raise UsageError(
        f"no intrinsics of camera {camera} ({topic.topic}): {why}",
        f"Give --intrinsics for every camera: a camera_info file, or {_LENS_FORM}.",
    )


def _require_count(n_given: int, n_there: int, what: str, recording: Path) -> None:
    if n_given not in (0, n_there):
        raise UsageError(
            f"{recording} holds {n_there} cameras, {n_given} {what} given",
            "Give one for each camera, in the order of their topics, or none.",
        )


def _line(topic: SensorTopic) -> str:
    facts = [topic.kind, f"{topic.n_messages} messages"]
    facts += [f"{topic.rate_hz:.1f} Hz"] if topic.rate_hz else []
    facts += [f"{topic.size_px[0]}x{topic.size_px[1]}"] if topic.size_px else []
    facts += [f"{topic.n_rings} rings"] if topic.n_rings else []
    facts += ["intrinsics in camera_info"] if topic.intrinsics else []
    return f"{topic.topic}: {', '.join(facts)}"
