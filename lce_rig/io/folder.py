"""A folder of images and point clouds: per board placement one point cloud and one image per camera."""

import hashlib
import re
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.bounds import MAX_BYTES, decoding
from lce_rig.core.data import Image, Scan, Stream
from lce_rig.core.errors import SourceError, reading
from lce_rig.core.findings import Losses
from lce_rig.core.progress import Progress
from lce_rig.io.cloud import to_scan
from lce_rig.io.decoding import DECODERS, SUFFIXES, decode_image, is_plain_png, read_cloud, require_las
from lce_rig.io.findings import NOT_DECODED, worded
from lce_rig.io.recording import (
    SourceOptions,
    choose_camera,
    choose_lidar,
    fingerprint,
)
from lce_rig.rig import LidarSettings, Rig
from lce_rig.timing.clock_fit import nearest

IMAGE_FOLDERS = ("img", "imgs", "image", "images", "camera", "cam", "rgb", "color", "frames")
CLOUD_FOLDERS = ("pcd", "raw_pcd", "cloud", "clouds", "lidar", "velodyne", "points", "pointcloud", "ply")
IN_ORDER = "paired in sorted order"


Pairs: TypeAlias = list[tuple[int, int]]
"""(image, point cloud) positions in two lists of names, in the order of the images."""


def natural_order(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that puts "scan2" before "scan10"."""
    return [
        (0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name) if part
    ]


def parse_times(stems: Sequence[str]) -> NDArray[np.int64] | None:
    """Read file names as times in ns; None if any name is not a time.

    Seconds have a decimal point; 19 digits are ns since 1970, 16 are us and 13 are ms. Counters are not
    times.
    """
    times = []
    for stem in stems:
        if re.fullmatch(r"\d{1,10}\.\d{1,9}", stem):
            times.append(int(Decimal(stem) * 10**9))
        elif re.fullmatch(r"\d{19}|\d{16}|\d{13}", stem):
            times.append(int(stem) * 10 ** (19 - len(stem)))
        else:
            return None
    if not times or max(times) > np.iinfo(np.int64).max:
        return None
    return np.array(times, dtype=np.int64)


def pair_names(
    images: Sequence[str], clouds: Sequence[str], tolerance_s: float = 0.05, *, may_count: bool = True
) -> tuple[Pairs, str]:
    """Match images, or another LiDAR's point clouds, with point clouds by name (without suffix).

    Equal names are paired if nine in ten match; else the nearest times, if names are times and nine in ten
    find a partner within the tolerance; else sorted order, if images and point clouds are equal in number;
    else the better of the first two.

    Args:
        images, clouds: names in natural order.
        tolerance_s: largest difference in time.
        may_count: whether sorted order is allowed.

    Returns:
        The pairs, and the method in words.

    Raises:
        SourceError: no name matches.
    """
    n, image_ns, cloud_ns = len(images), parse_times(images), parse_times(clouds)
    # An image of the same name in another format makes a separate pair.
    place = {name: j for j, name in reversed(list(enumerate(clouds)))}
    by_name = [(i, place[name]) for i, name in enumerate(images) if name in place]
    candidates: list[tuple[Pairs, str]] = [(by_name, "paired by equal file names")]
    if image_ns is not None and cloud_ns is not None:
        near = _nearest_pairs(image_ns, cloud_ns, tolerance_s)
        candidates.append((near, f"paired by nearest time within {tolerance_s:g} s"))
    for pairs, reason in candidates:
        # A few files may lack a partner.
        if len(pairs) >= 0.9 * min(n, len(clouds)):
            return pairs, reason
    if may_count and n == len(clouds):
        reason = IN_ORDER
        if image_ns is not None and cloud_ns is not None:
            apart_s = np.abs(image_ns - cloud_ns).max() * 1e-9
            reason += f" (names are times up to {apart_s:.3f} s apart)"
        return [(i, i) for i in range(n)], reason
    pairs, reason = max(candidates, key=lambda candidate: len(candidate[0]))
    if not pairs:
        raise SourceError(
            f"{n} and {len(clouds)} files cannot be paired: names and numbers differ",
            "Give both files of a pair the same name, or remove files without a partner.",
        )
    return pairs, reason


def _nearest_pairs(image_ns: NDArray[np.int64], cloud_ns: NDArray[np.int64], tolerance_s: float) -> Pairs:
    """Pair images and point clouds that are mutually nearest in time, within the tolerance."""
    by_image, by_cloud = np.argsort(image_ns, kind="stable"), np.argsort(cloud_ns, kind="stable")
    cloud_of = by_cloud[nearest(image_ns, cloud_ns[by_cloud])]
    image_of = by_image[nearest(cloud_ns, image_ns[by_image])]
    is_mutual = image_of[cloud_of] == np.arange(len(image_ns))
    is_near = np.abs(image_ns - cloud_ns[cloud_of]) <= tolerance_s * 1e9
    return [(int(i), int(cloud_of[i])) for i in np.flatnonzero(is_mutual & is_near)]


def _by_sensor(
    folder: Path, sensors: Collection[str], names: Sequence[str], suffixes: frozenset[str]
) -> dict[str, list[Path]]:
    """List the files in folders named after sensors: img/left/ and img/right/, or left/ and right/.

    Returns:
        Files by sensor, in the order of `sensors`; empty if no folder is named after a sensor.
    """
    above = [path for name, path in _folders(folder).items() if name in names and name not in sensors]
    for place in (*above, folder):
        folders = _folders(place)
        found = {
            name: files
            for name in sensors
            if name.lower() in folders and (files := _files(folders[name.lower()], suffixes))
        }
        if found:
            return found
    return {}


def list_files(folder: Path) -> tuple[list[Path], list[Path]]:
    """List the images and the point clouds of one camera and one LiDAR in a folder, unread.

    Returns:
        Images, empty if missing or from several cameras; point clouds.

    Raises:
        SourceError: no point clouds, or those of several LiDARs.
    """
    clouds = _list(folder, CLOUD_FOLDERS, frozenset(DECODERS), "point clouds", [])
    try:
        return _list(folder, IMAGE_FOLDERS, SUFFIXES, "images", []), clouds
    except SourceError:
        return [], clouds


def _list(
    folder: Path, names: Sequence[str], suffixes: frozenset[str], what: str, notes: list[str]
) -> list[Path]:
    """List the files of one kind in the folder named for it, else in the only folder with such files.

    Raises:
        SourceError: there are no files, or several folders have some and none is named after the sensor.
    """
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
    hint = f"Put them into its subfolder {names[0]}/; formats: {', '.join(sorted(suffixes))}."
    if names is CLOUD_FOLDERS:
        hint += " Or give the LiDAR's recording of the same time as well: --from lidar.pcap."
    if holding:
        raise SourceError(f"{folder}: {what} lie in several folders: {', '.join(sorted(holding))}", hint)
    empty = next((name for name in names if name in folders), None)
    raise SourceError(f"{folder}{'/' + empty if empty else ''}: no {what} found", hint)


def _folders(folder: Path) -> dict[str, Path]:
    """List the subfolders of a folder, by name in lower case."""
    return {p.name.lower(): p for p in sorted(folder.iterdir()) if p.is_dir() and p.name[0] != "."}


def _files(folder: Path, suffixes: frozenset[str]) -> list[Path]:
    visible = [p for p in folder.iterdir() if p.name[0] != "."]
    # Links to devices are listed too: their reader reports them.
    found = [p for p in visible if p.suffix.lower() in suffixes and not p.is_dir()]
    return sorted(found, key=lambda p: (natural_order(p.stem), p.name))


@dataclass(frozen=True)
class FileOnDisk:
    """An image or point cloud not read yet; the timestamp comes from its name.

    Attributes:
        label: name of the file, for messages; with its folder's if several sensors may have equal names.
        sensor, channel: those that it belongs to; a LiDAR has no channel.
        settings: settings of the LiDAR; None for an image.
    """

    path: Path
    label: str
    sensor: str
    channel: str
    stamp_ns: int | None
    settings: LidarSettings | None = None

    def image(self) -> Image:
        """Decode an image.

        Raises:
            SourceError: the file is missing, empty, truncated or damaged.
        """
        with reading(self.path, most_bytes=MAX_BYTES), decoding():
            data = self.path.read_bytes()
            pixels = decode_image(data)
        png = data if is_plain_png(data) else None
        return Image(self.sensor, self.channel, self.stamp_ns, pixels, png=png)


@dataclass(frozen=True)
class PlacementOnDisk:
    """Files of one placement of the board, not read yet: the images, then the point clouds."""

    files: tuple[FileOnDisk, ...]

    @property
    def label(self) -> str:
        """The files' names, for messages."""
        return " + ".join(file.label for file in self.files)

    def key(self) -> str:
        """Fingerprint the bytes of all files and the sensors they are read for.

        Raises:
            SourceError: a file cannot be read.
        """
        sensors = [f"{file.sensor} {file.channel}".rstrip() for file in self.files]
        digest = hashlib.sha256(" ".join(sensors).encode())
        for file in self.files:
            with reading(file.path, most_bytes=MAX_BYTES):
                digest.update(hashlib.sha256(file.path.read_bytes()).digest())
        return digest.hexdigest()

    def read(self) -> tuple[tuple[Image, ...], tuple[Scan, ...], list[str]]:
        """Decode all files; also return notes on assumptions and skipped points.

        Raises:
            SourceError: a file is missing, empty, truncated or damaged.
        """
        notes = set[str]()
        images = tuple(file.image() for file in self.files if file.settings is None)
        scans = tuple(
            to_scan(
                read_cloud(file.path), file.sensor, file.settings, str(file.path), file.stamp_ns, notes=notes
            )
            for file in self.files
            if file.settings is not None
        )
        return images, scans, sorted(notes)


def _stamps_ns(files: Sequence[Path]) -> list[int | None]:
    """Read the times in files' names; None for each if the names are not times."""
    times_ns = parse_times([file.stem for file in files])
    return [None] * len(files) if times_ns is None else times_ns.tolist()


def _images(folder: Path, rig: Rig, options: SourceOptions, notes: list[str]) -> list[list[FileOnDisk]]:
    """List the images of each camera.

    Raises:
        SourceError: there are no images, or none of the requested camera, or their camera is unknown.
    """
    found = _by_sensor(folder, rig.cameras, IMAGE_FOLDERS, SUFFIXES) if len(rig.cameras) > 1 else {}
    if options.camera in found:
        found = {options.camera: found[options.camera]}
    elif found and options.camera in rig.cameras:
        raise SourceError(f"{folder}: images of {', '.join(found)} found, none of {options.camera}")
    by_camera: dict[str | None, list[Path]] = dict(found.items())
    by_camera = by_camera or {None: _list(folder, IMAGE_FOLDERS, SUFFIXES, "images", notes)}
    images = []
    for name, paths in by_camera.items():
        camera, channel = choose_camera(rig, options, notes, name)
        labels = [path.name if len(by_camera) == 1 else f"{path.parent.name}/{path.name}" for path in paths]
        files = zip(paths, labels, _stamps_ns(paths), strict=True)
        images.append([FileOnDisk(path, label, camera, channel, ns) for path, label, ns in files])
    return images


def _clouds(folder: Path, rig: Rig, options: SourceOptions, notes: list[str]) -> list[list[FileOnDisk]]:
    """List the point clouds of the LiDAR, or of each LiDAR of a rig without cameras.

    Raises:
        SourceError: there are no point clouds, or LAS files without an installed reader.
    """
    suffixes = frozenset(DECODERS)
    if rig.cameras:
        lidar = choose_lidar(rig, options, notes)
        found = {lidar: _list(folder, CLOUD_FOLDERS, suffixes, "point clouds", notes)}
    else:
        found = _by_sensor(folder, rig.lidars, CLOUD_FOLDERS, suffixes)
        if len(found) < 2:
            names = [f"{name}/" for name in rig.lidars]
            raise SourceError(
                f"{folder}: point clouds of fewer than two LiDARs found",
                f"Put each LiDAR's into a folder of its name: {', '.join(names)}; equal file names match.",
            )
    if any(path.suffix.lower() == ".las" for paths in found.values() for path in paths):
        require_las()
    return [
        [
            FileOnDisk(
                path, path.name if rig.cameras else f"{lidar}/{path.name}", lidar, "", ns, rig.lidars[lidar]
            )
            for path, ns in zip(paths, _stamps_ns(paths), strict=True)
        ]
        for lidar, paths in found.items()
    ]


def read_pairs(
    pairs: Sequence[PlacementOnDisk], notes: list[str], progress: Progress
) -> Iterator[tuple[str, tuple[Image, ...], tuple[Scan, ...]]]:
    """Read pairs: label, images and scans of each; damaged ones are skipped.

    Args:
        pairs: pairs of a `FolderRecording`.
        notes: receives the pairs that were skipped.
        progress: called with (done, total).

    Raises:
        SourceError: no pair could be read; the cause is that of the first.
    """
    failures: list[SourceError] = []
    for done, files in enumerate(pairs, start=1):
        try:
            images, scans, _ = files.read()
        except SourceError as error:
            failures.append(error)
        else:
            yield files.label, images, scans
        progress(done, len(pairs))
    if failures and len(failures) == len(pairs):
        raise failures[0]
    notes += [f"skipped: {error.what}" for error in failures]


class ImagesRecording:
    """Images named by time, recorded with another recording's scans; see `ContinuousRecording`.

    Attributes:
        path: the folder.
        notes: choices made, and after reading the images that could not be read.
        key: fingerprint of the first and the last image of each camera, and of their number.
        n_samples: number of images.
        streams: the images of each camera.
    """

    def __init__(self, path: Path, rig: Rig, options: SourceOptions) -> None:
        """Find the images without decoding them.

        Raises:
            SourceError: there are no images, their camera is unknown, or their names are not timestamps.
        """
        self.path = path
        self.notes: list[str] = []
        self._images: list[tuple[int, FileOnDisk]] = []
        self.streams: set[Stream] = set()
        ends: list[Path] = []
        for images in _images(path, rig, options, self.notes):
            timed = sorted(
                ((image.stamp_ns, image) for image in images if image.stamp_ns is not None),
                key=lambda item: item[0],
            )
            if not timed:
                raise SourceError(
                    f"{path}: the names of the images are not timestamps ({images[0].path.name})",
                    "Name each after its time on the clock of the other recording, in seconds since 1970 "
                    "(1760000000.046122.jpg) or in ns; or put the point clouds into pcd/ beside them.",
                )
            (_, first), (_, last) = timed[0], timed[-1]
            self.streams.add(Stream(first.sensor, first.channel, "images"))
            self._images += timed
            ends += [first.path, last.path]
        self._images.sort(key=lambda item: item[0])
        self.n_samples = len(self._images)
        self.key = f"{fingerprint(ends)}:{self.n_samples}"

    def samples(self) -> Iterator[Image]:
        """Yield the images in order of time; unreadable ones are counted in `notes`.

        Raises:
            SourceError: no image could be read.
        """
        losses, n_read = Losses(), 0
        try:
            for _, file in self._images:
                try:
                    image = file.image()
                except SourceError as error:
                    losses.add(NOT_DECODED(where=error.what))
                    continue
                n_read += 1
                yield image
        finally:
            self.notes += [f"{self.path.name}: {line}" for line in worded(losses)]
        if n_read == 0:
            raise SourceError(f"{self.path}: not one image could be read")


class FolderRecording:
    """Images and point clouds in one folder or in two; with several sensors, one folder per sensor.

    Attributes:
        path: the folder.
        notes: the rule of pairing, and the files without a partner.
        pairs: every point cloud with its images, or other LiDARs' point clouds, by name of the point cloud.
    """

    def __init__(self, path: Path, rig: Rig, options: SourceOptions) -> None:
        """Find the files and pair them without decoding them.

        Raises:
            SourceError: no images, no point clouds, no way to pair them, or images whose camera is not known.
        """
        self.path = path
        self.notes: list[str] = []
        self._rig = rig
        images = _images(path, rig, options, self.notes) if rig.cameras else []
        if rig.lidars:
            clouds, *lidars = _clouds(path, rig, options, self.notes)
            others = images + lidars
        elif len(images) < 2:
            names = ", ".join(f"{name}/" for name in rig.cameras)
            raise SourceError(
                f"{path}: images of fewer than two cameras found",
                f"Put each camera's into a folder of its name: {names}; equal file names match.",
            )
        else:
            clouds, *others = images
        # The second image of one camera that goes with a point cloud makes a separate pair.
        together: dict[tuple[int, int], list[FileOnDisk]] = {}
        lone: list[str] = []
        for of_sensor, pairs in zip(others, self._pair(others, clouds), strict=True):
            n_held = Counter[int]()
            for i, j in pairs:
                together.setdefault((j, n_held[j]), []).append(of_sensor[i])
                n_held[j] += 1
            with_cloud = {i for i, _ in pairs}
            lone += [file.label for i, file in enumerate(of_sensor) if i not in with_cloud]
        with_image = {j for j, _ in together}
        lone += [cloud.label for j, cloud in enumerate(clouds) if j not in with_image]
        if lone:
            more = f" and {len(lone) - 6} more" if len(lone) > 6 else ""
            self.notes.append(f"{path.name}: without a partner: {', '.join(lone[:6])}{more}")
        self.pairs = [
            PlacementOnDisk(tuple(sorted([clouds[j], *held], key=lambda file: not file.channel)))
            for (j, _), held in sorted(together.items(), key=lambda item: item[0])
        ]

    def _pair(self, others: Sequence[Sequence[FileOnDisk]], clouds: Sequence[FileOnDisk]) -> list[Pairs]:
        """Match each camera's images, or other LiDAR's point clouds, with the point clouds."""
        pairings = [self._pair_sensor(files, clouds) for files in others]
        if not all(reason.startswith(IN_ORDER) for _, reason in pairings):
            # A camera with worse matching names must not affect the others.
            pairings = [self._pair_sensor(files, clouds, may_count=False) for files in others]
        for files, (pairs, reason) in zip(others, pairings, strict=True):
            whose = f"{files[0].sensor}: " if len(others) > 1 or not files[0].channel else ""
            note = f"{self.path.name}: {whose}{len(pairs)} pairs, {reason}"
            n_files = len(files) - len(pairs)
            n_clouds = len(clouds) - len({j for _, j in pairs})
            if n_files or n_clouds:
                what = "images" if files[0].channel else "of its"
                whole = f"images of {clouds[0].sensor}" if clouds[0].channel else "point clouds"
                note += f"; {n_files} {what} and {n_clouds} {whole} have no partner"
            self.notes.append(note)
        return [pairs for pairs, _ in pairings]

    def _pair_sensor(
        self, files: Sequence[FileOnDisk], clouds: Sequence[FileOnDisk], *, may_count: bool = True
    ) -> tuple[Pairs, str]:
        first, lidar = files[0], clouds[0].sensor
        settings = [
            self._rig.cameras[each.sensor].channels[each.channel]
            if each.channel
            else self._rig.lidars[each.sensor]
            for each in ((first,) if first.channel else (first, clouds[0]))
        ]
        tolerance_s = max(each.timestamps.tolerance_s for each in settings)
        stems = [file.path.stem for file in files], [cloud.path.stem for cloud in clouds]
        try:
            return pair_names(*stems, tolerance_s, may_count=may_count)
        except SourceError as error:
            raise SourceError(f"{self.path}: {first.sensor} and {lidar}: {error.what}", error.hint) from None
