"""The layout of a folder: its images and point clouds, and the camera of each image folder."""

from collections.abc import Collection, Sequence
from pathlib import Path

from lce_rig.core.errors import SourceError
from lce_rig.sources import cloud_file, image_file
from lce_rig.sources.pairing import natural_order

IMAGE_FOLDERS = ("img", "imgs", "image", "images", "camera", "cam", "rgb", "color", "frames")
CLOUD_FOLDERS = (
    "pcd",
    "raw_pcd",
    "pcds",
    "cloud",
    "clouds",
    "lidar",
    "velodyne",
    "points",
    "pointcloud",
    "ply",
)


def list_pictures(folder: Path, notes: list[str]) -> list[Path]:
    """List the images of one camera, in natural order; what was chosen between is noted.

    Raises:
        SourceError: there are none, or several folders have some and no name tells which is meant.
    """
    return _list(folder, IMAGE_FOLDERS, image_file.SUFFIXES, "pictures", notes)


def list_clouds(folder: Path, notes: list[str]) -> list[Path]:
    """List the point clouds, in natural order; what was chosen between is noted.

    Raises:
        SourceError: as `list_pictures`.
    """
    return _list(folder, CLOUD_FOLDERS, frozenset(cloud_file.DECODERS), "clouds", notes)


def list_pictures_by_camera(folder: Path, cameras: Collection[str]) -> dict[str, list[Path]]:
    """List the images in folders named after cameras: img/left/ and img/right/, or left/ and right/.

    Returns:
        Images by camera, in the order of `cameras`; empty where no folder is named after one.
    """
    above = [path for name, path in _folders(folder).items() if name in IMAGE_FOLDERS and name not in cameras]
    for place in (*above, folder):
        folders = _folders(place)
        found = {
            name: files
            for name in cameras
            if name in folders and (files := _files(folders[name], image_file.SUFFIXES))
        }
        if found:
            return found
    return {}


def _list(
    folder: Path, names: Sequence[str], suffixes: frozenset[str], what: str, notes: list[str]
) -> list[Path]:
    """List the files of one kind in the folder whose name says so, else in the only one that has any."""
    folders = _folders(folder)
    holding = {name: files for name, path in folders.items() if (files := _files(path, suffixes))}
    named = [name for name in names if name in holding]
    if len(named) > 1:
        notes.append(f"{folder.name}: {what} taken from {named[0]}/, not from {', '.join(named[1:])}")
    if named:
        return holding[named[0]]
    if here := _files(folder, suffixes):
        return here
    if len(holding) == 1:
        return next(iter(holding.values()))
    hint = f"Put them into {names[0]}/ below it; {', '.join(sorted(suffixes))} are read."
    if holding:
        raise SourceError(f"{folder}: {what} lie in {', '.join(sorted(holding))}: which?", hint)
    empty = next((name for name in names if name in folders), None)
    raise SourceError(f"{folder}{'/' + empty if empty else ''}: no {what} there", hint)


def _folders(folder: Path) -> dict[str, Path]:
    """List the folders in one, by name in lower case."""
    return {p.name.lower(): p for p in sorted(folder.iterdir()) if p.is_dir() and p.name[0] != "."}


def _files(folder: Path, suffixes: frozenset[str]) -> list[Path]:
    found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.is_file() and p.name[0] != "."]
    return sorted(found, key=lambda p: (natural_order(p.stem), p.name))
