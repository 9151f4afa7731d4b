"""Recordings of all kinds: `open_recording` finds the reader for a path."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from pkgutil import resolve_name

from lce_rig.core.errors import SourceError
from lce_rig.io import findings as findings  # Readers may name their kinds by code.
from lce_rig.io.folder.recorded_folder import list_parts
from lce_rig.io.protocol import Recording, SourceOptions
from lce_rig.io.ros.bag_file import kind_of
from lce_rig.io.sensor_choice import choose_lidar
from lce_rig.rig import Rig

RECORDINGS = {
    "folder": "lce_rig.io.folder.folder:FolderRecording",
    ".bag": "lce_rig.io.ros.rosbag:BagRecording",
    ".db3": "lce_rig.io.ros.rosbag:BagRecording",
    ".mcap": "lce_rig.io.ros.rosbag:BagRecording",
    ".pcap": "lce_rig.io.velodyne.pcap:PcapRecording",
    ".pcapng": "lce_rig.io.velodyne.pcap:PcapRecording",
    ".aedat4": "lce_rig.io.events.camera_file:EventCameraFile",
    ".raw": "lce_rig.io.events.camera_file:EventCameraFile",
    ".h5": "lce_rig.io.events.camera_file:EventCameraFile",
    ".hdf5": "lce_rig.io.events.camera_file:EventCameraFile",
    ".npz": "lce_rig.io.events.camera_file:EventCameraFile",
    ".txt": "lce_rig.io.events.camera_file:EventCameraFile",
    ".zip": "lce_rig.io.events.camera_file:EventCameraFile",
}
"""Reader by suffix, or "folder"; imported when wanted."""
_PACKETS, _OUSTER = (".pcap", ".pcapng"), "lce_rig.io.ouster:OusterRecording"


def open_recording(path: Path | str, rig: Rig, options: SourceOptions | None = None) -> Recording:
    """Open what lies at a path: a folder of images and point clouds, a bag, or a file of an event camera.

    Raises:
        SourceError: nothing is there, or nothing that can be read.
    """
    path = Path(path)
    if not path.exists():
        raise SourceError(f"{path} does not exist")
    kind = kind_of(path)
    if kind not in RECORDINGS:
        known = ", ".join(suffix for suffix in RECORDINGS if suffix != "folder")
        hint = f"Give a folder with img/ and pcd/, a bag, or a file of events ({known})."
        raise SourceError(f"{path} is not a recording that lce-rig reads", hint)
    options = options or SourceOptions()
    reader = _OUSTER if kind in _PACKETS and _is_of_ouster(rig, options) else RECORDINGS[kind]
    recording: Recording = resolve_name(reader)(path, rig, options)
    return recording


def _is_of_ouster(rig: Rig, options: SourceOptions) -> bool:
    """Return whether the LiDAR that packets belong to is an Ouster: OS0, OS1, OS2."""
    lidar = rig.lidars[choose_lidar(rig, options, [])]
    return lidar.model.upper().removeprefix("OUSTER").lstrip(" -_").startswith("OS")


def open_recordings(
    paths: Iterable[Path], rig: Rig, options: SourceOptions | Sequence[SourceOptions] | None = None
) -> list[Recording]:
    """Open what lies at several paths; a folder that several recorders filled gives each of their files.

    Args:
        paths: of the recordings.
        rig: the profile.
        options: how they are read: all alike, or each by its own.

    Raises:
        SourceError: as `open_recording`; of a folder's files only where none of them can be read.
    """
    paths, options = list(paths), options or SourceOptions()
    by_path = [options] * len(paths) if isinstance(options, SourceOptions) else options
    recordings: list[Recording] = []
    for path, own in zip(paths, by_path, strict=True):
        own = replace(own, is_part=own.is_part or len(paths) > 1)
        recordings += _open_parts(list_parts(path, rig, own), rig)
    return recordings


def _open_parts(parts: list[tuple[Path, SourceOptions]], rig: Rig) -> list[Recording]:
    """Open the recordings of one folder; a file that a killed recorder left empty is skipped."""
    opened: list[Recording] = []
    failures: list[SourceError] = []
    for path, options in parts:
        try:
            opened.append(open_recording(path, rig, options))
        except SourceError as error:
            failures.append(error)
    if not opened:
        raise failures[0]
    opened[0].notes.extend(f"skipped: {error.what}" for error in failures)
    return opened
