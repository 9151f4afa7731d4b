"""Recordings of all kinds: `open_recording` finds the reader for a path."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from pkgutil import resolve_name

from lce_rig.core.errors import SourceError, reading
from lce_rig.io import findings as findings  # Readers may name their kinds by code.
from lce_rig.io.recording import Recording, SourceOptions, choose_lidar
from lce_rig.io.ros.bag_file import SUFFIXES, kind_of
from lce_rig.rig import Rig

_BAGS = frozenset(SUFFIXES)
_PACKETS = frozenset({".pcap", ".pcapng"})
_EVENTS = frozenset({".aedat4", ".raw", ".h5", ".hdf5"})
RECORDINGS = {
    "folder": "lce_rig.io.folder:FolderRecording",
    **dict.fromkeys(SUFFIXES, "lce_rig.io.ros.rosbag:BagRecording"),
    **dict.fromkeys(sorted(_PACKETS), "lce_rig.io.velodyne_scans:PcapRecording"),
    **dict.fromkeys(sorted(_EVENTS), "lce_rig.io.events:EventCameraFile"),
}
"""Reader by suffix, or "folder"; imported on first use."""
_KINDS = (_BAGS, _PACKETS, _EVENTS)
_CLOUDS = frozenset({".pcd", ".ply", ".las"})


def open_recording(path: Path | str, rig: Rig, options: SourceOptions | None = None) -> Recording:
    """Open a recording: a folder of images and point clouds, a bag, or an event camera file.

    Raises:
        SourceError: the path is missing, or no reader can open it.
    """
    path = Path(path)
    kind = recognise(path)
    options = options or SourceOptions()
    reader = RECORDINGS[kind]
    if kind in _PACKETS:
        model = rig.lidars[choose_lidar(rig, options, [])].model.upper().removeprefix("OUSTER").lstrip(" -_")
        reader = "lce_rig.io.ouster:OusterRecording" if model.startswith("OS") else reader
    if kind == "folder" and options.is_part and not _holds_clouds(path):
        reader = "lce_rig.io.folder:ImagesRecording"
    recording: Recording = resolve_name(reader)(path, rig, options)
    return recording


def recognise(path: Path) -> str:
    """Return the kind of a recording, a key of `RECORDINGS`; a folder with a bag counts as a bag.

    Raises:
        SourceError: the path is missing, or not a recording.
    """
    if not path.exists():
        raise SourceError(f"{path} does not exist")
    with reading(path):
        kind = kind_of(path)
    if kind not in RECORDINGS:
        known = ", ".join(suffix for suffix in RECORDINGS if suffix != "folder")
        hint = f"Give a folder with img/ and pcd/, a bag, or an event file ({known})."
        raise SourceError(f"{path} is not a recording that lce-rig reads", hint)
    return kind


def open_recordings(
    paths: Iterable[Path], rig: Rig, options: SourceOptions | Sequence[SourceOptions] | None = None
) -> list[Recording]:
    """Open the recordings at several paths; for a folder filled by several recorders, each of its files.

    Args:
        paths: paths of the recordings.
        rig: the profile.
        options: one for all recordings, or one per path.

    Raises:
        SourceError: see `open_recording`; for a folder, only if none of its files can be read.
    """
    paths, options = list(paths), options or SourceOptions()
    by_path = [options] * len(paths) if isinstance(options, SourceOptions) else options
    recordings: list[Recording] = []
    for path, path_options in zip(paths, by_path, strict=True):
        is_part = path_options.is_part or len(paths) > 1
        opened: list[Recording] = []
        failures: list[SourceError] = []
        for part, part_options in list_parts(path, rig, replace(path_options, is_part=is_part)):
            try:
                opened.append(open_recording(part, rig, part_options))
            except SourceError as error:
                failures.append(error)
        if not opened:
            raise failures[0]
        # A file that a killed recorder left empty is skipped.
        opened[0].notes.extend(f"skipped: {error.what}" for error in failures)
        recordings += opened
    return recordings


def list_parts(path: Path, rig: Rig, options: SourceOptions) -> list[tuple[Path, SourceOptions]]:
    """List the recordings in a folder, with the options of each; any other path is one recording.

    Bags come first, because a sensor in several recordings is read from the first. A file named after a LiDAR
    or a camera of the profile belongs to it.

    Args:
        path: a folder, such as one of `lce-rig collect --record`, or any recording.
        rig: the profile.
        options: options for reading, unless file names choose the sensor.
    """
    if not path.is_dir() or (path / "metadata.yaml").is_file():
        return [(path, options)]
    entries = sorted(entry for entry in path.iterdir() if entry.name[0] != ".")
    kinds = {suffixes: [e for e in entries if e.is_file() and kind_of(e) in suffixes] for suffixes in _KINDS}
    folders, images = [entry for entry in entries if entry.is_dir()], list[Path]()
    if not all(kind_of(folder) in _BAGS for folder in folders):
        if not kinds[_PACKETS] or _holds_clouds(path):
            return [(path, options)]  # A folder of images and point clouds; other files in it are ignored.
        folders, images = [], [path]
    # A bag split into several files is one folder, read as one recording.
    bags = ([path] if kinds[_BAGS] else []) + folders
    is_one_of_many = len(bags) + len(images) + len(kinds[_PACKETS]) + len(kinds[_EVENTS]) > 1
    options = replace(options, is_part=options.is_part or is_one_of_many)
    parts = [(part, options) for part in bags + images]
    for file in kinds[_PACKETS]:
        parts.append((file, replace(options, lidar=_named(file, rig.lidars) or options.lidar)))
    for file in kinds[_EVENTS]:
        parts.append((file, replace(options, camera=_named(file, rig.cameras) or options.camera)))
    return parts or [(path, options)]


def _holds_clouds(folder: Path) -> bool:
    return any(
        file.suffix.lower() in _CLOUDS
        for place in (folder, *folder.iterdir())
        if place.is_dir()
        for file in place.iterdir()
    )


def _named(file: Path, sensors: Collection[str]) -> str | None:
    return file.stem if file.stem in sensors else None
