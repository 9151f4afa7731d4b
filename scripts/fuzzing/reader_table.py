"""Every reader of files: what it is given, how it is called, and how it may refuse."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fnmatch import fnmatch
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from fuzzing import layers, sanity
from fuzzing import seeds_of_recordings as recordings
from fuzzing import seeds_of_sessions as sessions
from fuzzing.layers import JSON, LINES, TEXT, WHOLE, Layer
from fuzzing.samples import CAMERA, SIZE, Samples, small_rig
from fuzzing.seeds_of_recordings import Files
from lce_rig.core.errors import LceRigError

_MAX_SAMPLES = 500


@dataclass(frozen=True)
class Reader:
    """One kind of input and what reads it.

    Attributes:
        make: sound inputs of this kind.
        read: reads a folder with one input's files; what it accepts is checked there.
        damages: which of the files are damaged, a pattern of names.
        layers: what lies inside, and is damaged with lengths and checksums that fit.
        refuses: how it may refuse; of LceRigErrors any, as they carry a documented exit code.
        seal: makes good what vouches for the damaged file from elsewhere.
        is_sound: whether all that `make` gives is read; else some is of a kind that is refused.
    """

    make: Callable[[Samples], list[Files]]
    read: Callable[[Path], None]
    damages: str = "*"
    layers: tuple[Layer, ...] = (WHOLE,)
    refuses: tuple[type[Exception], ...] = (LceRigError,)
    seal: Callable[[Files], Files] | None = None
    is_sound: bool = True

    def targets(self, files: Files) -> list[str]:
        """Name the files that are damaged."""
        return [name for name in files if fnmatch(name, self.damages)]


def _cloud(folder: Path) -> None:
    from lce_rig.io.folder.cloud import to_scan
    from lce_rig.io.folder.cloud_file import read_cloud

    path = next(folder.iterdir())
    reading = to_scan(read_cloud(path), "lidar", small_rig().lidars["lidar"], str(path))
    sanity.check_scan(reading.scan)


def _image(folder: Path) -> None:
    from lce_rig.io.folder.image_file import read_image

    sanity.check_pixels(read_image(next(folder.iterdir())))


def _image_stream(folder: Path) -> None:
    from lce_rig.devices.pipe.image_streams import find_stream

    data = next(folder.iterdir()).read_bytes()
    stream = find_stream(data[:64])
    for begin in range(0, len(data) if stream else 0, 1000):
        for pixels in stream.feed(data[begin : begin + 1000]) if stream else ():
            sanity.check_pixels(pixels)


def _drain(samples: Iterator[Any]) -> None:
    for sample in islice(samples, _MAX_SAMPLES):
        sanity.check_sample(sample)


def _recording(folder: Path) -> None:
    from lce_rig.io import open_recordings
    from lce_rig.io.protocol import PairedRecording, SourceOptions

    for recording in open_recordings([next(folder.iterdir())], small_rig(), SourceOptions(is_part=True)):
        if isinstance(recording, PairedRecording):
            _read_pairs(recording)
        else:
            sanity.require(isinstance(recording.key, str), "a key that is no text")  # type: ignore[attr-defined]
            _drain(recording.samples())  # type: ignore[attr-defined]


def _read_pairs(recording: Any) -> None:
    for pair in recording.pairs[:10]:
        read = pair.read()
        for sample in (*read.images, *read.scans):
            sanity.check_sample(sample)


def _joined(folder: Path) -> None:
    """Read a folder of several recorders as `collect` does: all of its parts as one."""
    from lce_rig.io import open_recordings
    from lce_rig.io.joining import join_recordings
    from lce_rig.io.protocol import SourceOptions

    parts = open_recordings([folder / "folder"], small_rig(), SourceOptions())
    for recording in join_recordings(parts, small_rig()):
        _drain(recording.samples())  # type: ignore[attr-defined]


def _events(folder: Path) -> None:
    from lce_rig.io.events import open_events

    path = next(folder.iterdir())
    events = open_events(path, sensor=CAMERA)
    _read_events(events)


def _own_events(folder: Path) -> None:
    from lce_rig.io.events import open_events

    _read_events(open_events(next(folder.iterdir()), sensor=CAMERA, resolution=SIZE))


def _read_events(events: Any) -> None:
    for stretch in islice(events, _MAX_SAMPLES):
        sanity.check_events(stretch)
    first_ns, last_ns = events.extent_ns()
    sanity.require(isinstance(first_ns, int) and isinstance(last_ns, int), "an extent of no whole numbers")
    sanity.check_events(events.read(first_ns, first_ns + 10_000_000))
    sanity.require(all(isinstance(note, str) for note in events.notes), "a note that is no text")


def _event_camera_file(folder: Path) -> None:
    from lce_rig.io.events.camera_file import EventCameraFile
    from lce_rig.io.protocol import SourceOptions

    recording = EventCameraFile(next(folder.iterdir()), small_rig(), SourceOptions())
    _drain(recording.samples())


def _named_folder(folder: Path) -> None:
    """Read a folder of images and clouds under names that were damaged."""
    from lce_rig.io.folder.folder import FolderRecording
    from lce_rig.io.protocol import SourceOptions

    base = folder / "recording"
    base.mkdir()
    text = (folder / "names.txt").read_bytes().decode("utf-8", "replace")
    for name in text.split("\n")[:20]:
        parts = [part[:100] for part in name.split("/") if part not in ("", ".", "..") and "\0" not in part]
        path = base.joinpath(*parts[:4])
        if (
            parts
            and not path.exists()
            and all(parent.is_dir() or not parent.exists() for parent in path.parents)
        ):
            path.parent.mkdir(parents=True, exist_ok=True)
            kind = "image" if "png" in name else "cloud"
            path.write_bytes((folder / kind).read_bytes())
    _read_pairs(FolderRecording(base, small_rig(), SourceOptions()))


def _session(folder: Path) -> None:
    """Read a session as the verbs do: everything in it, and the boards in it."""
    from lce_rig import pipeline
    from lce_rig.session import Session

    opened = Session.open(folder / "s")
    opened.read_journal()
    refused: list[LceRigError] = []
    for capture in opened.captures:
        try:
            _read_capture(capture)
        except LceRigError as error:
            refused.append(error)
    pipeline.detect(opened, event_image="map")
    if refused:
        raise refused[0]


def _read_capture(capture: Any) -> None:
    names = (capture.meta, capture.content_sha256, capture.file_hashes, capture.manifest_sha256)
    sanity.require(isinstance(names[0], dict) and isinstance(names[1], str), "figures of another type")
    capture.check()
    for camera, channel in capture.image_keys:
        sanity.check_sample(capture.image(camera, channel))
    for lidar in capture.lidars:
        sanity.check_sample(capture.scan(lidar))
    for camera in capture.event_cameras:
        sanity.check_sample(capture.events(camera))


def _marker(folder: Path) -> None:
    from lce_rig.session import Session

    _read_rig(Session.open(folder / "s").rig)
    with Session.resume(folder / "s", small_rig()) as session:
        sanity.require(len(session.captures) == 2, "a session that has lost captures")


def _journal(folder: Path) -> None:
    from lce_rig.session import Session

    entries = Session.open(folder / "s").read_journal()
    sanity.require(all(isinstance(entry, dict) for entry in entries), "an entry that is no object")


def _cache(folder: Path) -> None:
    from lce_rig.core.findings import Refusal
    from lce_rig.core.results import ImageBoard, LidarBoard
    from lce_rig.detect.detection import from_arrays
    from lce_rig.session import cache

    held = cache.load(folder / "a.npz")
    if held is None:
        return
    found = from_arrays(held.arrays)
    items = found if isinstance(found, list) else [found]
    is_known = all(isinstance(item, (ImageBoard, LidarBoard, Refusal)) for item in items)
    sanity.require(is_known, f"a detection of type {type(found).__name__}")


def _profile(folder: Path) -> None:
    from lce_rig.rig import load_rig

    _read_rig(load_rig(folder / "rig.yaml"))


def _read_rig(rig: Any) -> None:
    """Use a profile as the verbs do: write it, list its warnings, and project a point with its lenses."""
    from lce_rig.rig import dump_rig, parse_rig

    sanity.require(parse_rig(dump_rig(rig)) == rig, "a profile that reads back as another")
    rig.warnings()
    rig.board.to_board()
    for camera in rig.cameras.values():
        pixels, _ = camera.to_intrinsics().project(
            np.array([[0.1, 0.1, 2.0], [0.0, 0.0, 1.0], [1.0, 1.0, -1.0]])
        )
        sanity.require(not np.isinf(pixels).any(), "a lens that projects to infinity")


def _result(folder: Path) -> None:
    from lce_rig.export.frames import require_known
    from lce_rig.export.result import read_result, result_text

    saved = read_result(folder / "result.json")
    for calibration in saved.pairs:
        sanity.check_pose(calibration.T_cam_lidar)
        sanity.require(calibration.cov.shape == (6, 6), "a covariance of another shape")
        require_known(calibration, small_rig())
    result_text(saved.rig, saved.pairs, saved.inputs_sha256)


def _reference(folder: Path) -> None:
    from lce_rig.export.reference import read_reference

    found = read_reference(folder / "a.json")
    for T in (*found.by_pair.values(), *([] if found.default is None else [found.default])):
        sanity.check_pose(T)


def _truth(folder: Path) -> None:
    from lce_rig.cli.simulate import require_kind
    from lce_rig.export.reference import read_reference

    read_reference(folder / "s/truth.json")
    require_kind(folder / "s", 0)


def _job(folder: Path) -> Any:
    from lce_rig.export.job import ExportJob

    return ExportJob([sessions.calibration()], small_rig(), folder)


def _extrinsics(folder: Path) -> None:
    from lce_rig.export.extrinsics import _check

    job = _job(folder)
    _check(folder / "extrinsics.yaml", job.calibrations, job.rig)


def _kalibr(folder: Path) -> None:
    from lce_rig.export.kalibr import _check
    from lce_rig.export.lens import lens_for

    job = _job(folder)
    lenses = {c.camera: lens_for(job, "kalibr", c.camera, 4) for c in job.chosen}
    _check(folder / "camchain_lidar.yaml", job.chosen, lenses, job.rig)


def _autoware(folder: Path) -> None:
    from lce_rig.export.autoware import KIT, KIT_FILE, read_block

    for T in read_block(folder / KIT_FILE, KIT).values():
        sanity.require(T.shape == (4, 4), "a pose of another shape")


def _launch(folder: Path) -> None:
    from lce_rig.export.ros2_launch import read_ros2_launch

    for _, joint in read_ros2_launch(folder / "fuzz.launch.py"):
        sanity.require(joint.T_parent_child.shape == (4, 4), "a pose of another shape")


def _koide3(folder: Path) -> None:
    from lce_rig.export.koide3 import _check
    from lce_rig.export.lens import lens_for

    job = _job(folder)
    (calibration,) = job.chosen
    lens = lens_for(job, "koide3", calibration.camera, 5)
    _check(folder / f"calib_{job.name_of(calibration)}.json", calibration, lens, job)


def _camera_info(folder: Path) -> None:
    from lce_rig.export.camera_info import read_camera_info

    read_camera_info(next(folder.glob("camera_info_*.yaml")))


def _urdf(folder: Path) -> None:
    from lce_rig.export.urdf import read_urdf

    for joint in read_urdf(folder / "fuzz.urdf").above.values():
        sanity.require(joint.T_parent_child.shape == (4, 4), "a pose of another shape")


def _static_tf(folder: Path) -> None:
    from lce_rig.export.static_tf import read_static_tf

    for joints in read_static_tf(folder / "static_transforms.txt").values():
        for _, joint in joints:
            sanity.require(joint.T_parent_child.shape == (4, 4), "a pose of another shape")


def _network(folder: Path) -> None:
    from lce_rig.detect.events.reconstruct.model import ReconstructionModel

    model = ReconstructionModel(folder / "a.onnx")
    picture, _ = model.step(np.zeros((model.n_bins, 16, 16), np.float32), model.initial_states(16, 16))
    sanity.require(picture.shape == (16, 16), "an image of another size")


def _web(folder: Path) -> None:
    import json

    from lce_rig.devices.vlp16.web import to_report

    try:
        pages = json.loads((folder / "pages.json").read_bytes())
    except (ValueError, RecursionError):
        return  # As `VelodyneWeb._get` refuses it.
    given = [
        pages.get(name) if isinstance(pages, dict) else None
        for name in ("info", "status", "settings", "diag")
    ]
    to_report(*(page if isinstance(page, dict) else {} for page in given))


def _recordings(make: Any, *inner: Layer, read: Callable[[Path], None] = _recording, **more: Any) -> Reader:
    return Reader(make, read, layers=(WHOLE, *inner), **more)


def _stored(name: str, *inner: Layer) -> Reader:
    return Reader(
        sessions.session, _session, f"{sessions.CAPTURE}/{name}", (WHOLE, *inner), seal=sessions.resealed
    )


_BAG, _MCAP, _DB3 = (layers.messages_of(suffix) for suffix in (".bag", ".mcap", ".db3"))

READERS: dict[str, Reader] = {
    # Point clouds
    "pcd-ascii": Reader(recordings.pcd_ascii, _cloud, layers=(TEXT,)),
    "pcd-binary": _recordings(recordings.pcd_binary, TEXT, read=_cloud),
    "pcd-compressed": _recordings(recordings.pcd_compressed, layers.PCD_COLUMNS, TEXT, read=_cloud),
    "ply-ascii": Reader(recordings.ply("ascii"), _cloud, layers=(TEXT,)),
    "ply-little-endian": _recordings(recordings.ply("binary_little_endian"), TEXT, read=_cloud),
    "ply-big-endian": _recordings(recordings.ply("binary_big_endian"), TEXT, read=_cloud),
    # Images
    "png": _recordings(recordings.image(".png"), layers.PNG_CHUNKS, layers.PNG_ROWS, read=_image),
    "png-16-bit": _recordings(
        recordings.image(".png", is_deep=True), layers.PNG_CHUNKS, layers.PNG_ROWS, read=_image
    ),
    "jpeg": _recordings(recordings.image(".jpg"), read=_image),
    "bmp": _recordings(recordings.image(".bmp"), read=_image),
    "tiff": _recordings(recordings.image(".tiff"), read=_image),
    "pgm": _recordings(recordings.image(".pgm"), TEXT, read=_image),
    "ppm": _recordings(recordings.image(".ppm"), TEXT, read=_image),
    "webp": _recordings(recordings.image(".webp"), read=_image),
    # Images that a program writes
    "stream-y4m": _recordings(recordings.y4m, TEXT, read=_image_stream, refuses=(LceRigError, ValueError)),
    "stream-pnm": _recordings(
        recordings.pnm_stream, TEXT, read=_image_stream, refuses=(LceRigError, ValueError)
    ),
    "stream-jpeg": _recordings(recordings.jpeg_stream, read=_image_stream, refuses=(LceRigError, ValueError)),
    # Bags
    "ros1": _recordings(recordings.bag(), _BAG, layers.ROS1_CHUNKS),
    "ros1-bz2": _recordings(recordings.bag("bz2"), _BAG, layers.ROS1_CHUNKS),
    "ros1-lz4": _recordings(recordings.bag("lz4"), _BAG, layers.ROS1_CHUNKS),
    "ros1-torn": _recordings(recordings.torn_bag, is_sound=False),
    "mcap": _recordings(recordings.mcap(), _MCAP, layers.MCAP_CHUNKS),
    "mcap-zstd": _recordings(recordings.mcap("zstd"), _MCAP, layers.MCAP_CHUNKS),
    "mcap-lz4": _recordings(recordings.mcap("lz4"), _MCAP, layers.MCAP_CHUNKS),
    "mcap-torn": _recordings(recordings.torn_mcap, is_sound=False),
    "db3": _recordings(recordings.db3, _DB3),
    "ros2-folder": _recordings(recordings.ros2_folder),
    "ros2-metadata": Reader(recordings.ros2_folder, _recording, "*/metadata.yaml", (TEXT,)),
    "event-packets-ros1": _recordings(recordings.event_packets(".bag"), _BAG, read=_events),
    "event-packets-mcap": _recordings(recordings.event_packets(".mcap"), _MCAP, read=_events),
    # Packets of a VLP-16
    "pcap": _recordings(recordings.pcap),
    "pcap-payloads": Reader(recordings.pcap, _recording, layers=(layers.PCAP_PAYLOADS,)),
    "pcapng": _recordings(recordings.pcapng),
    "velodyne-web": Reader(recordings.velodyne_web, _web, layers=(JSON,)),
    # Files of event cameras
    "aedat4": _recordings(recordings.aedat4("none"), layers.AEDAT4_TABLES, TEXT, read=_own_events),
    "aedat4-lz4": _recordings(recordings.aedat4("lz4"), layers.AEDAT4_TABLES, read=_own_events),
    "aedat4-zstd": _recordings(recordings.aedat4("zstd"), layers.AEDAT4_TABLES, read=_events),
    "aedat4-closed": _recordings(recordings.closed_aedat4, read=_events),
    "aedat4-frames": _recordings(recordings.aedat4_frames, layers.AEDAT4_TABLES, read=_event_camera_file),
    "evt2": _recordings(recordings.evt2, TEXT, read=_events),
    "evt2.1": _recordings(recordings.evt21, TEXT, read=_events),
    "evt3": _recordings(recordings.evt3, TEXT, read=_events),
    "hdf5": _recordings(recordings.hdf5, read=_events),
    "hdf5-strange": _recordings(recordings.hdf5_strange, read=_events, is_sound=False),
    "npz-own": _recordings(recordings.npz_own, layers.ZIP_MEMBERS, read=_events),
    "npz-foreign": _recordings(recordings.npz_foreign, layers.ZIP_MEMBERS, read=_events),
    "text": Reader(recordings.text, _events, layers=(TEXT,)),
    "text-zip": _recordings(recordings.zipped_text, layers.ZIP_TEXTS, read=_events),
    # Folders
    "folder-names": Reader(recordings.folder, _named_folder, "names.txt", (TEXT,), is_sound=False),
    "recorded-folder": _recordings(recordings.recorded_folder, read=_joined),
    # Sessions
    "session.json": Reader(sessions.session, _marker, "s/session.json", (JSON,)),
    "session-rig.yaml": Reader(sessions.session, _marker, "s/rig.yaml", (TEXT,)),
    "journal.jsonl": Reader(sessions.session, _journal, "s/journal.jsonl", (LINES,)),
    "manifest": Reader(sessions.session, _session, f"{sessions.CAPTURE}/meta.json", (JSON,)),
    "stored-image": _stored("*.png", layers.PNG_CHUNKS, layers.PNG_ROWS),
    "stored-scan": _stored("*.pcd", TEXT),
    "stored-events": _stored("*.npz", layers.ZIP_MEMBERS),
    "detection-cache": _recordings(
        sessions.cache_entries,
        layers.ZIP_MEMBERS,
        layers.cached_json("values_json"),
        layers.cached_json("head"),
        read=_cache,
        refuses=(ValueError,),
    ),
    "truth.json": Reader(sessions.truth, _truth, "s/truth.json", (JSON,)),
    # Profiles, results, networks
    "rig.yaml": Reader(sessions.profile_text, _profile, layers=(TEXT,)),
    "rig-values": Reader(sessions.profile_json, _profile, layers=(JSON,)),
    "result.json": Reader(sessions.result, _result, layers=(JSON,)),
    "reference": Reader(sessions.reference, _reference, layers=(JSON,)),
    "camera_info": Reader(sessions.exports, _camera_info, "camera_info_*.yaml", (TEXT,)),
    "extrinsics": Reader(sessions.exports, _extrinsics, "extrinsics.yaml", (TEXT,)),
    "kalibr": Reader(sessions.exports, _kalibr, "camchain_lidar.yaml", (TEXT,)),
    "autoware": Reader(sessions.exports, _autoware, "sensor_kit_calibration.yaml", (TEXT,)),
    "ros2_launch": Reader(sessions.exports, _launch, "*.launch.py", (TEXT,)),
    "koide3": Reader(sessions.exports, _koide3, "calib_*.json", (JSON,)),
    "urdf": Reader(sessions.exports, _urdf, "*.urdf", (TEXT,)),
    "static_tf": Reader(sessions.exports, _static_tf, "static_transforms.txt", (TEXT,)),
    "network": _recordings(sessions.network, read=_network),
}
"""By name; the campaign's kinds of input."""
