"""A folder of simultaneous recordings: a bag, packets of LiDARs, files of event cameras."""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from lce_rig.io.protocol import SourceOptions
from lce_rig.rig import Rig

_BAGS = frozenset({".bag", ".db3", ".mcap"})
_PACKETS = frozenset({".pcap", ".pcapng"})
_EVENTS = frozenset({".aedat4", ".raw", ".h5", ".hdf5"})
_KINDS = (_BAGS, _PACKETS, _EVENTS)


def list_parts(path: Path, rig: Rig, options: SourceOptions) -> list[tuple[Path, SourceOptions]]:
    """List the recordings in a folder, with how each is read; anything else is one recording.

    Bags come first: what several hold is taken from the first. A file named after a LiDAR or a camera of the
    profile belongs to it.

    Args:
        path: a folder, such as `lce-rig collect --record` fills, or any recording.
        rig: the profile.
        options: how it is read, where names of files do not say.
    """
    if not path.is_dir() or (path / "metadata.yaml").is_file():
        return [(path, options)]
    entries = sorted(entry for entry in path.iterdir() if entry.name[0] != ".")
    kinds = {suffix: [e for e in entries if e.is_file() and e.suffix.lower() in suffix] for suffix in _KINDS}
    folders = [entry for entry in entries if entry.is_dir()]
    if not all(any(file.suffix.lower() in _BAGS for file in folder.iterdir()) for folder in folders):
        return [(path, options)]  # Of images and point clouds, whatever lies beside them.
    # A bag in several pieces lies in one folder, and is read as one.
    bags = ([path] if kinds[_BAGS] else []) + folders
    is_one_of_many = len(bags) + len(kinds[_PACKETS]) + len(kinds[_EVENTS]) > 1
    options = replace(options, is_part=options.is_part or is_one_of_many)
    parts = [(bag, options) for bag in bags]
    for file in kinds[_PACKETS]:
        parts.append((file, replace(options, lidar=_named(file, rig.lidars) or options.lidar)))
    for file in kinds[_EVENTS]:
        parts.append((file, replace(options, camera=_named(file, rig.cameras) or options.camera)))
    return parts or [(path, options)]


def _named(file: Path, sensors: Collection[str]) -> str | None:
    return file.stem if file.stem in sensors else None
