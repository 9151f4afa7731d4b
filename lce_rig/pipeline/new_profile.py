"""A profile for a new rig: from data sheets, or from its recording."""

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board, BoardType
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Scan
from lce_rig.core.data_sheets import TYPICAL, find_data_sheet
from lce_rig.core.errors import SourceError, UsageError
from lce_rig.detect.lidar.segments import order_scan
from lce_rig.io import recognise
from lce_rig.io.beams import compare_beams, measure_elevations, suggest_models
from lce_rig.io.camera_description import FORMS, CameraFile, read_cameras
from lce_rig.io.cloud import to_scan
from lce_rig.io.decoding import read_cloud, read_image
from lce_rig.io.folder import list_files
from lce_rig.io.ros.bag_file import SUFFIXES as BAGS
from lce_rig.io.ros.bag_file import kind_of
from lce_rig.io.ros.topics import SensorTopic, survey_bag
from lce_rig.rig import BoardSettings, LidarSettings
from lce_rig.rig.board_settings import KEYS_OF_TYPE, board_block
from lce_rig.rig.loading import Document, board_of, dump_yaml, rig_from_document
from lce_rig.rig.sensors import lens_block

_UNKNOWN_MODEL = "other"
_PLATE = r"([^,x]+)x([^,x]+)(?:,([^,x]+),([^,x]+))?"
_BOARDS: dict[BoardType, re.Pattern[str]] = {
    "checkerboard": re.compile(rf"(?:checkerboard:)?(\d+)x(\d+),([^,x]+)(),{_PLATE}"),
    "charuco": re.compile(rf"charuco:(\d+)x(\d+),([^,x]+),([^,]+,[^,]+),{_PLATE}"),
    "aprilgrid": re.compile(rf"aprilgrid:(\d+)x(\d+),([^,x]+),([^,x]+),{_PLATE}"),
}
_SIZE = re.compile(r"(\d{1,5})x(\d{1,5})")
_FAMILIES: dict[str, Literal["radtan", "equidistant"]] = {
    "radtan": "radtan",
    "plumb_bob": "radtan",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
}
_BOARD_SIGMAS = ("pattern_offset_sigma_m", "plate_sigma_m", "bow_sigma_m")
_COMMENTS = {
    "board": "measure it; do not rely on the CAD model",
    "inner_corners": "where four squares meet: [along the width, along the height]",
    "squares": "[along the width, along the height]",
    "tags": "tagCols, tagRows of Kalibr",
    "tag_spacing": "gap between tags over their side",
    "pattern_offset_m": "pattern's centre from the plate's centre: [right, up]",
    "square_sigma_m": "standard deviation of square_m",
    "pattern_offset_sigma_m": "of each coordinate of pattern_offset_m",
    "plate_sigma_m": "of width_m and height_m",
    "bow_sigma_m": "of the height of the plate's middle over its ends",
    "elevations_deg": "of the rings, as recorded",
    "laser_bias_sigma_m": "this and the next three are typical: enter your LiDAR's",
    "clock": "device, host or utc",
    "reference": "LiDAR: first_firing or last_firing; camera: mid_exposure or start",
    "sync": "hardware (shared pulse), ptp or none",
}
BOARD_FORM = (
    "COLSxROWS,SQUARE,WIDTHxHEIGHT[,RIGHT,UP] of a checkerboard's inner corners, lengths in m, such as "
    "8x6,0.07,0.767x0.626; charuco:COLSxROWS,SQUARE,MARKER,DICTIONARY,WIDTHxHEIGHT of squares, such as "
    "charuco:9x7,0.07,0.0525,5X5_50,0.767x0.626; or aprilgrid:COLSxROWS,TAG,SPACING,WIDTHxHEIGHT of tags, "
    "such as aprilgrid:4x3,0.13,0.3,0.767x0.626"
)
_LENS_FORM = (
    "MODEL,WIDTHxHEIGHT,FX,FY,CX,CY,K1,..., such as radtan,1280x720,897.5,896.8,635.4,375.3,-0.44,0.23,0,0"
)
_USUAL_SIZE_PX = (1280, 720)
_NUMBERS_HINT = (
    "Omit --from and give the figures: lce-rig rigs new NAME --lidar VLP-16 "
    "--intrinsics radtan,1280x720,1000,1000,640,360,0,0,0,0 --board 8x6,0.07,0.767x0.626"
)


def new_profile(
    name: str,
    board: Board,
    *,
    recording: Path | None = None,
    lidar_model: str | None = None,
    cameras: Sequence[str] = (),
    intrinsics: Sequence[Intrinsics | CameraFile] = (),
    source: str = "profile",
) -> tuple[str, list[str]]:
    """Write the text of a profile.

    Args:
        name: name of the rig.
        board: the measured board.
        recording: a bag, whose topics name the sensors, frames, rates and, by camera_info, the lenses; or a
            folder with images and point clouds. The beams of an unknown LiDAR are measured in it.
        lidar_model: maker's name of the LiDAR's model; None if unknown.
        cameras: names of the cameras, in the order of a bag's topics.
        intrinsics: one per camera, in the same order, or one file for all; empty to read the bag's.
        source: name of the profile in errors.

    Returns:
        The text; and a line for each value found or chosen.

    Raises:
        UsageError: a camera without intrinsics, or names or intrinsics of missing cameras.
        SourceError: the bag cannot be read, or holds no camera or no LiDAR.
        ProfileError: the parts do not make a valid profile.
    """
    skipped: list[str] = []
    topics, images, clouds = _survey(recording, skipped)
    folder_px = _image_size(images)
    scans = [topic for topic in topics if topic.kind == "scans"]
    groups = _by_camera([topic for topic in topics if topic.kind != "scans"])
    if recording is not None and not clouds:
        # Two cameras can be calibrated with each other alone.
        for seen, what in ((scans or groups[1:], "point clouds"), (groups, "images or events")):
            if not seen:
                listed = "; ".join([*map(_line, topics), *skipped])
                raise SourceError(f"{recording}: no {what}, so it is not a recording of a rig", listed)
        intrinsics = _for_each(intrinsics, len(groups))
        for n, what in ((len(cameras), "names (--camera)"), (len(intrinsics), "--intrinsics")):
            if n not in (0, len(groups)):
                raise UsageError(
                    f"{recording} holds {len(groups)} cameras, {n} {what} given",
                    "Give one for each camera, in the order of their topics, or none.",
                )
    else:
        groups = [[] for _ in cameras or ("cam",)]
        intrinsics = _for_each(intrinsics, len(groups))
        if len(intrinsics) != len(groups):
            raise UsageError(
                f"intrinsics of {len(intrinsics)} of {len(groups)} cameras given",
                f"Give --intrinsics once for each --camera: a file of a camera, or {_LENS_FORM}.\n"
                f"{_rough_lens(folder_px)}",
            )
    model = lidar_model or _UNKNOWN_MODEL
    notes = [*map(_line, topics), *skipped]
    if scans or (recording is not None and not clouds):
        names = ["lidar"] if len(scans) == 1 else [f"lidar_{k + 1}" for k in range(len(scans))]
        lidars = {
            name: _lidar(name, model, notes, topic, topic.cloud, topic.topic)
            for name, topic in zip(names, scans, strict=True)
        }
    else:
        cloud = read_cloud(clouds[0]) if clouds else None
        lidars = {"lidar": _lidar("lidar", model, notes, None, cloud, str(clouds[0]) if clouds else "")}
        if rings := lidars["lidar"].get("elevations_deg"):
            notes.append(f"lidar: {len(rings)} rings, {lidars['lidar'].get('columns', 'unknown')} columns")
    used = {block["frame"] for block in lidars.values()}
    blocks = {}
    for k, (camera, group) in enumerate(zip(list(cameras) or _names(groups), groups, strict=True)):
        frame = next((t.frame for t in group if t.frame and t.frame not in used), None)
        used.add(frame)
        given = intrinsics[k] if intrinsics else _lens(camera, group)
        if isinstance(given, CameraFile):
            size_px = next((topic.size_px for topic in group if topic.size_px), folder_px)
            lens, lines = given.intrinsics(camera, [topic.topic for topic in group], size_px)
            notes += [f"{camera}: {given.path}: {line}" for line in lines]
        else:
            lens = given
        blocks[camera] = _camera(camera, lens, frame, group)
    data = {
        "format_version": 1,
        "name": name,
        "board": {
            **board_block(board),
            # The usual standard deviations.
            "square_sigma_m": float(f"{board.square_m / 1000:.2g}"),
            **{key: BoardSettings.model_fields[key].default for key in _BOARD_SIGMAS},
        },
        "lidars": lidars,
        "cameras": blocks,
    }
    rig_from_document(Document(source, data, root=None))
    lines = [f"# {name}: written by `rigs new`; `lce-rig rigs show FILE` shows every setting."]
    for line in dump_yaml(data).splitlines():
        comment = _COMMENTS.get(line.strip().partition(":")[0])
        lines.append(f"{line:<40} # {comment}" if comment else line)
    return "\n".join(lines) + "\n", notes


def _survey(recording: Path | None, skipped: list[str]) -> tuple[list[SensorTopic], list[Path], list[Path]]:
    """List the topics of a bag, or the images and point clouds of a folder; also the skipped topics.

    Raises:
        SourceError: the path has no description of a rig's sensors.
    """
    if recording is None:
        return [], [], []
    kind = recognise(recording)
    if kind == "folder":
        bags = [entry for entry in sorted(recording.iterdir()) if entry.is_dir() and kind_of(entry) == ".bag"]
        if len(bags) != 1:
            return [], *list_files(recording)
        recording = bags[0]
    elif kind not in BAGS:
        raise SourceError(f"{recording}: a {kind} file does not describe the rig's sensors", _NUMBERS_HINT)
    return survey_bag(recording, skipped), [], []


def _lidar(
    name: str,
    model: str,
    notes: list[str],
    topic: SensorTopic | None,
    cloud: NDArray[Any] | None,
    where: str,
) -> dict[str, Any]:
    """List the settings of a LiDAR; for an unknown model with the beams found in a point cloud.

    Args:
        name: name of the LiDAR.
        model: name of its model, as given.
        notes: receives differences between the rings of cloud and model.
        topic: topic of the cloud; None without a bag.
        cloud: one scan; None without one.
        where: file or topic, for messages.
    """
    block: dict[str, Any] = {"model": model, "frame": f"{name}_link"}
    sheet = find_data_sheet(model)
    settings = LidarSettings.model_validate({"model": model})
    if topic is not None:
        block |= {"frame": topic.frame or block["frame"], "topic": topic.topic}
        rate_hz = round(topic.rate_hz or 0.0, 1)
        # Single scans, seconds apart, do not reveal the LiDAR's rate; without rings, scans are accumulated to
        # the profile's rate.
        block |= {"rate_hz": rate_hz} if rate_hz >= 2.0 and settings.has_rings else {}
    if sheet is not None and sheet.has_rings and cloud is not None:
        try:
            found = compare_beams(to_scan(cloud, name, settings, where), settings)
            notes.extend(finding.sentence for finding in found)
        except SourceError as error:
            notes.append(error.what)
    if sheet is None:
        if cloud is not None:
            scan = to_scan(cloud, name, settings, where)
            elevations_deg, columns = measure_beams(scan)
            block["elevations_deg"] = [round(value, 2) for value in elevations_deg]
            block |= {} if columns is None else {"columns": columns}
            if alike := suggest_models(np.array(elevations_deg)):
                notes.append(f"{name}: a {' or '.join(alike)} has such rings: name it with --lidar")
        block |= {
            "laser_bias_sigma_m": TYPICAL.laser_bias_sigma_m,
            "range_offset_sigma_m": TYPICAL.range_offset_sigma_m,
            "beam_aperture_m": TYPICAL.aperture_m,
            "beam_divergence_rad": TYPICAL.divergence_rad[0],
        }
    return block | {"timestamps": {"clock": "host", "reference": "first_firing", "sync": "none"}}


def _camera(
    name: str, lens: Intrinsics, optical_frame: str | None, topics: Sequence[SensorTopic]
) -> dict[str, Any]:
    """List the settings of a camera, with a channel for each of its topics."""
    timestamps = {"clock": "host", "reference": "mid_exposure", "sync": "none"}
    channels: dict[str, Any] = {topic.kind: {"kind": topic.kind, "topic": topic.topic} for topic in topics}
    return {
        "frame": f"{name}_link",
        "optical_frame": optical_frame or f"{name}_optical_frame",
        "resolution_px": [lens.width_px, lens.height_px],
        "intrinsics": lens_block(lens),
        "channels": {
            kind: {**channel, "timestamps": dict(timestamps)}
            for kind, channel in (channels or {"frames": {"kind": "frames"}}).items()
        },
    }


def measure_beams(scan: Scan) -> tuple[list[float], int | None]:
    """Measure a LiDAR's beams in one of its scans.

    Args:
        scan: scan of at least a few metres around, in the LiDAR's own frame.

    Returns:
        The elevation of each ring in deg, from the lowest; firings of each ring per revolution, None where
        too few returns follow each other.
    """
    elevations = measure_elevations(scan)
    step_rad = order_scan(scan, min_range_m=0.3).step_rad
    return sorted(elevations.tolist()), round(2 * np.pi / step_rad) if step_rad > 0 else None


def parse_board(text: str) -> Board:
    """Parse a board, "8x6,0.07,0.767x0.626" or another type in the form of `BOARD_FORM`.

    Raises:
        UsageError: the text has another form.
    """
    compact = text.replace(" ", "")
    try:
        for kind, pattern in _BOARDS.items():
            if match := pattern.fullmatch(compact):
                cols, rows, square, more, *lengths = match.groups()
                marker, _, dictionary = more.partition(",")
                width, height, *offset = (float(value or 0) for value in lengths)
                values: dict[str, Any] = {"type": kind, KEYS_OF_TYPE[kind][0]: (int(cols), int(rows))}
                values |= {"square_m": float(square), "pattern_offset_m": tuple(offset)}
                values |= {"marker_m": float(marker), "dictionary": dictionary} if kind == "charuco" else {}
                values |= {"tag_spacing": float(more)} if kind == "aprilgrid" else {}
                return board_of(values | {"width_m": width, "height_m": height}, f"--board {text}")
    except ValueError:
        pass
    raise UsageError(f"--board {text}: give {BOARD_FORM}")


def parse_intrinsics(text: str) -> Intrinsics | CameraFile:
    """Read a camera file, or intrinsics as "radtan,1280x720,897.5,896.8,635.4,375.3,-0.44,0.23,0,0".

    Raises:
        UsageError: the text is neither.
        ProfileError: the file cannot be used.
    """
    model, *values = re.split(r"\s*,\s*|\s+", text.strip())
    if len(values) < 5 and not (values and values[0] and model in _FAMILIES):
        path = Path(text)
        if not text or len(text) > 4000 or not path.exists():
            raise UsageError(
                f"--intrinsics {text[:200]}: there is no such file",
                f"Give {FORMS}; or {_LENS_FORM}.",
            )
        return read_cameras(path)
    size = _SIZE.fullmatch(values[0])
    try:
        if size is None or model not in _FAMILIES:
            raise ValueError
        fx, fy, cx, cy, *distortion = map(float, values[1:])
    except ValueError:
        models = ", ".join(_FAMILIES)
        raise UsageError(
            f"--intrinsics {text}: neither a file of a camera nor intrinsics",
            f"Give {_LENS_FORM}; models: {models}.",
        ) from None
    width, height = map(int, size.groups())
    return Intrinsics(fx, fy, cx, cy, width, height, _FAMILIES[model], tuple(distortion))


def _for_each(
    intrinsics: Sequence[Intrinsics | CameraFile], n_cameras: int
) -> Sequence[Intrinsics | CameraFile]:
    """Repeat the only file given for every camera if it describes several."""
    if len(intrinsics) == 1 and isinstance(intrinsics[0], CameraFile) and len(intrinsics[0].cameras) > 1:
        return [intrinsics[0]] * n_cameras
    return intrinsics


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
        f"Give --intrinsics for every camera: a file of a camera, or {_LENS_FORM}.\n"
        f"{_rough_lens(topic.size_px)}",
    )


def _image_size(images: Sequence[Path]) -> tuple[int, int] | None:
    """Return the width and height (px) of the first readable image; None without one."""
    for path in images:
        with suppress(SourceError):
            height, width = read_image(path).shape[:2]
            return width, height
    return None


def _rough_lens(size_px: tuple[int, int] | None) -> str:
    """Advise approximate intrinsics for cameras without measured ones."""
    width, height = size_px or _USUAL_SIZE_PX
    middle = f"{width / 2:g},{height / 2:g},0,0,0,0"
    lens = f"radtan,{width}x{height},{0.8 * width:.0f},{0.8 * width:.0f},{middle}"
    fisheye = f"equidistant,{width}x{height},{width / 2:.0f},{width / 2:.0f},{middle}"
    return (
        f"Not measured yet? Begin with --intrinsics {lens}, or for a fisheye {fisheye}; "
        "`lce-rig intrinsics` measures them later from these captures."
    )


def _line(topic: SensorTopic) -> str:
    facts = [topic.kind, f"{topic.n_messages} messages"]
    facts += [f"{topic.rate_hz:.1f} Hz"] if topic.rate_hz else []
    facts += [f"{topic.size_px[0]}x{topic.size_px[1]}"] if topic.size_px else []
    facts += [f"{topic.n_rings} rings"] if topic.n_rings else []
    facts += ["intrinsics in camera_info"] if topic.intrinsics else []
    return f"{topic.topic}: {', '.join(facts)}" + (f" ({topic.note})" if topic.note else "")
