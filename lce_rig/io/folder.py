"""A folder of images and point clouds: per board placement one point cloud, and one image per camera."""

import hashlib
import re
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Image, Scan, Stream
from lce_rig.core.errors import SourceError, reading
from lce_rig.core.findings import Losses
from lce_rig.io.cloud import to_scan
from lce_rig.io.decoding import DECODERS, SUFFIXES, read_cloud, read_image, require_las
from lce_rig.io.findings import NOT_DECODED, worded
from lce_rig.io.protocol import (
    PairMethod,
    SourceOptions,
    choose_camera,
    choose_lidar,
    fingerprint,
)
from lce_rig.rig import LidarSettings, Rig
from lce_rig.timing.clock_fit import nearest

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
MOSTLY = 0.9


class Pairing(NamedTuple):
    """A choice of pairs, as positions in the two lists of names.

    Attributes:
        method: how the pairs were chosen.
        pairs: (image, point cloud) positions, in the order of the images.
        reason: the choice in words.
    """

    method: Literal["stem", "order", "time"]
    pairs: list[tuple[int, int]]
    reason: str


def natural_order(name: str) -> list[tuple[int, int, str]]:
    """Give a sort key that puts "scan2" before "scan10"."""
    return [
        (0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name) if part
    ]


def parse_times(stems: Sequence[str]) -> NDArray[np.int64] | None:
    """Read file names as times in ns; None where any is not a time.

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
    images: Sequence[str],
    clouds: Sequence[str],
    method: PairMethod = "auto",
    tolerance_s: float = 0.05,
    *,
    what: str = "images",
    other: str = "point clouds",
) -> Pairing:
    """Match images and point clouds by their names (without suffix).

    `auto` takes equal names where nine in ten match; else the nearest time, where names are times and nine in
    ten find a partner within the tolerance; else sorted order, where there are as many images as point
    clouds.

    Args:
        images, clouds: names in natural order.
        method: "stem", "order", "time", or "auto".
        tolerance_s: largest difference in time, for "time".
        what, other: name them in messages.

    Raises:
        SourceError: the names do not allow the method, or no method.
    """
    n, image_ns, cloud_ns = len(images), parse_times(images), parse_times(clouds)
    candidates: list[Pairing] = []
    if method in ("auto", "stem"):
        # An image of the same name in another format makes a pair of its own.
        place = {name: j for j, name in reversed(list(enumerate(clouds)))}
        pairs = [(i, place[name]) for i, name in enumerate(images) if name in place]
        candidates.append(Pairing("stem", pairs, "paired by equal file names"))
    if method in ("auto", "time") and image_ns is not None and cloud_ns is not None:
        reason = f"paired by nearest time within {tolerance_s:g} s"
        candidates.append(Pairing("time", _nearest_pairs(image_ns, cloud_ns, tolerance_s), reason))
    for pairing in candidates:
        if len(pairing.pairs) >= MOSTLY * min(n, len(clouds)):
            return pairing
    if method in ("auto", "order") and n == len(clouds):
        reason = "paired in sorted order"
        if image_ns is not None and cloud_ns is not None:
            apart_s = np.abs(image_ns - cloud_ns).max() * 1e-9
            reason += f" (names are times up to {apart_s:.3f} s apart)"
        return Pairing("order", [(i, i) for i in range(n)], reason)
    best = max(candidates, key=lambda pairing: len(pairing.pairs), default=None)
    if best is None or not best.pairs:
        by = "" if method == "auto" else f" by {method}"
        raise SourceError(
            f"{n} {what} and {len(clouds)} {other} cannot be paired{by}: names and numbers differ",
            "Give both files of a pair the same name, or remove files without a partner (--pair order).",
        )
    return best


def _nearest_pairs(
    image_ns: NDArray[np.int64], cloud_ns: NDArray[np.int64], tolerance_s: float
) -> list[tuple[int, int]]:
    """Pair what is nearest in time to each other, both ways."""
    by_image, by_cloud = np.argsort(image_ns, kind="stable"), np.argsort(cloud_ns, kind="stable")
    cloud_of = by_cloud[nearest(image_ns, cloud_ns[by_cloud])]
    image_of = by_image[nearest(cloud_ns, image_ns[by_image])]
    is_mutual = image_of[cloud_of] == np.arange(len(image_ns))
    is_near = np.abs(image_ns - cloud_ns[cloud_of]) <= tolerance_s * 1e9
    return [(int(i), int(cloud_of[i])) for i in np.flatnonzero(is_mutual & is_near)]


def _images_by_camera(folder: Path, cameras: Collection[str]) -> dict[str, list[Path]]:
    """List the images in folders named after cameras: img/left/ and img/right/, or left/ and right/.

    Returns:
        Images by camera, in the order of `cameras`; empty where no folder is named after one.
    """
    above = [path for name, path in _folders(folder).items() if name in IMAGE_FOLDERS and name not in cameras]
    for place in (*above, folder):
        folders = _folders(place)
        found = {
            name: files for name in cameras if name in folders and (files := _files(folders[name], SUFFIXES))
        }
        if found:
            return found
    return {}


def _list(
    folder: Path, names: Sequence[str], suffixes: frozenset[str], what: str, notes: list[str]
) -> list[Path]:
    """List the files of one kind in the folder whose name says so, else in the only one that has any.

    Raises:
        SourceError: there are none, or several folders have some and no name says which is meant.
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
    hint = f"Put them into {names[0]}/ below it; {', '.join(sorted(suffixes))} are read."
    if names is CLOUD_FOLDERS:
        hint += " Or give the LiDAR's recording of the same time as well: --from lidar.pcap."
    if holding:
        raise SourceError(f"{folder}: {what} lie in several folders: {', '.join(sorted(holding))}", hint)
    empty = next((name for name in names if name in folders), None)
    raise SourceError(f"{folder}{'/' + empty if empty else ''}: no {what} found", hint)


def _folders(folder: Path) -> dict[str, Path]:
    """List the folders in one, by name in lower case."""
    return {p.name.lower(): p for p in sorted(folder.iterdir()) if p.is_dir() and p.name[0] != "."}


def _files(folder: Path, suffixes: frozenset[str]) -> list[Path]:
    found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.is_file() and p.name[0] != "."]
    return sorted(found, key=lambda p: (natural_order(p.stem), p.name))


@dataclass(frozen=True)
class ImageOnDisk:
    """An image that has not been read yet; the timestamp comes from its name.

    Attributes:
        label: its name, for messages; with its folder's where several cameras may have the same names.
    """

    path: Path
    label: str
    camera: str
    channel: str
    stamp_ns: int | None

    def read(self) -> Image:
        """Decode it.

        Raises:
            SourceError: it is missing, empty, truncated or damaged.
        """
        return Image(self.camera, self.channel, self.stamp_ns, read_image(self.path))


@dataclass(frozen=True)
class PairOnDisk:
    """Images and a point cloud that have not been read yet; the timestamp comes from the file name."""

    images: tuple[ImageOnDisk, ...]
    cloud_path: Path
    lidar: str
    settings: LidarSettings
    cloud_stamp_ns: int | None

    @property
    def label(self) -> str:
        """The files' names, for messages."""
        return " + ".join([*(image.label for image in self.images), self.cloud_path.name])

    def key(self) -> str:
        """Fingerprint the bytes of all files and the sensors they are read for.

        Raises:
            SourceError: a file cannot be read.
        """
        sensors = [f"{image.camera} {image.channel}" for image in self.images]
        digest = hashlib.sha256(" ".join([*sensors, self.lidar]).encode())
        for path in (*(image.path for image in self.images), self.cloud_path):
            with reading(path):
                digest.update(hashlib.sha256(path.read_bytes()).digest())
        return digest.hexdigest()

    def read(self) -> tuple[tuple[Image, ...], tuple[Scan, ...], list[str]]:
        """Decode all files; also says, in words, what was assumed or skipped.

        Raises:
            SourceError: one is missing, empty, truncated or damaged.
        """
        images = tuple(image.read() for image in self.images)
        cloud, notes = read_cloud(self.cloud_path), set[str]()
        where, stamp_ns = str(self.cloud_path), self.cloud_stamp_ns
        scan = to_scan(cloud, self.lidar, self.settings, where, stamp_ns, notes=notes)
        return images, (scan,), sorted(notes)


@dataclass(frozen=True)
class ScansOnDisk:
    """The point clouds of one placement by several LiDARs, each as one of a pair without images."""

    parts: tuple[PairOnDisk, ...]

    @property
    def label(self) -> str:
        """The files' names, for messages."""
        return " + ".join(f"{part.lidar}/{part.label}" for part in self.parts)

    def key(self) -> str:
        """Fingerprint as `PairOnDisk.key`."""
        return hashlib.sha256(" ".join(part.key() for part in self.parts).encode()).hexdigest()

    def read(self) -> tuple[tuple[Image, ...], tuple[Scan, ...], list[str]]:
        """Decode as `PairOnDisk.read`."""
        readings = [part.read() for part in self.parts]
        scans = tuple(scan for _, of_part, _ in readings for scan in of_part)
        return (), scans, [note for _, _, notes in readings for note in notes]


def _stamps_ns(files: Sequence[Path]) -> list[int | None]:
    """Read the times in files' names; None for each where they hold none."""
    times_ns = parse_times([file.stem for file in files])
    return [None] * len(files) if times_ns is None else times_ns.tolist()


def _images(folder: Path, rig: Rig, options: SourceOptions, notes: list[str]) -> list[list[ImageOnDisk]]:
    """List the images of each camera.

    Raises:
        SourceError: there are none, or none of the camera that was asked for, or their camera is not known.
    """
    found = _images_by_camera(folder, rig.cameras) if len(rig.cameras) > 1 else {}
    if options.camera in found:
        found = {options.camera: found[options.camera]}
    elif found and options.camera in rig.cameras:
        raise SourceError(f"{folder}: images of {', '.join(found)} found, none of {options.camera}")
    by_camera: dict[str | None, list[Path]] = dict(found.items())
    by_camera = by_camera or {None: _list(folder, IMAGE_FOLDERS, SUFFIXES, "images", notes)}
    images = []
    for name, paths in by_camera.items():
        camera, channel = choose_camera(rig, options, notes, name)
        stamps_ns = _stamps_ns(paths)
        labels = [path.name if len(by_camera) == 1 else f"{path.parent.name}/{path.name}" for path in paths]
        images.append(
            [
                ImageOnDisk(path, label, camera, channel, stamp_ns)
                for path, label, stamp_ns in zip(paths, labels, stamps_ns, strict=True)
            ]
        )
    return images


class ImagesRecording:
    """Images whose names are times, beside another's scans of the same moment; see `ContinuousRecording`.

    Attributes:
        path: the folder.
        notes: what was chosen, and after reading the images that could not be read.
        key: fingerprint of the first and the last image of each camera, and of their number.
        n_samples: number of images.
        streams: the images of each camera.
    """

    def __init__(self, path: Path, rig: Rig, options: SourceOptions) -> None:
        """Find the images; nothing is decoded yet.

        Raises:
            SourceError: there are none, their camera is not known, or their names are not timestamps.
        """
        self.path = path
        self.notes: list[str] = []
        self._images: list[tuple[int, ImageOnDisk]] = []
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
            self.streams.add(Stream(first.camera, first.channel, "images"))
            self._images += timed
            ends += [first.path, last.path]
        self._images.sort(key=lambda item: item[0])
        self.n_samples = len(self._images)
        self.key = f"{fingerprint(ends)}:{self.n_samples}"

    def samples(self) -> Iterator[Image]:
        """Yield the images, in order of time; those that cannot be read are counted in `notes`.

        Raises:
            SourceError: not one could be read.
        """
        losses, n_read = Losses(), 0
        try:
            for _, file in self._images:
                try:
                    image = file.read()
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
    """Images and point clouds in folders side by side, or in one; images of several cameras in a folder each.

    Attributes:
        path: the folder.
        notes: how pairs were found and what was left over.
        pairs: every point cloud with its images, by name of the point cloud; read them one by one.
    """

    def __init__(self, path: Path, rig: Rig, options: SourceOptions) -> None:
        """Find the files and pair them; nothing is decoded yet.

        Raises:
            SourceError: no images, no point clouds, no way to pair them, or images whose camera is not known.
        """
        self.path = path
        self.notes: list[str] = []
        self.pairs: Sequence[PairOnDisk | ScansOnDisk]
        self._rig, self._options = rig, options
        if not rig.cameras:
            self.pairs = self._pair_scans()
            return
        lidar = choose_lidar(rig, options, self.notes)
        images = _images(path, rig, options, self.notes)
        clouds = _list(path, CLOUD_FOLDERS, frozenset(DECODERS), "point clouds", self.notes)
        if any(cloud.suffix.lower() == ".las" for cloud in clouds):
            require_las()
        cloud_ns = _stamps_ns(clouds)
        # The second image of one camera that goes with a point cloud makes a pair of its own.
        together: dict[tuple[int, int], list[ImageOnDisk]] = {}
        lone: list[str] = []
        for of_camera, pairing in zip(images, self._pair(images, clouds), strict=True):
            n_held = Counter[int]()
            for i, j in pairing.pairs:
                together.setdefault((j, n_held[j]), []).append(of_camera[i])
                n_held[j] += 1
            with_cloud = {i for i, _ in pairing.pairs}
            lone += [image.label for i, image in enumerate(of_camera) if i not in with_cloud]
        with_image = {j for j, _ in together}
        lone += [cloud.name for j, cloud in enumerate(clouds) if j not in with_image]
        if lone:
            more = f" and {len(lone) - 6} more" if len(lone) > 6 else ""
            self.notes.append(f"{path.name}: without a partner: {', '.join(lone[:6])}{more}")
        self.pairs = [
            PairOnDisk(
                tuple(held),
                clouds[j],
                lidar,
                rig.lidars[lidar],
                cloud_ns[j],
            )
            for (j, _), held in sorted(together.items(), key=lambda item: item[0])
        ]

    def _pair_scans(self) -> list[ScansOnDisk]:
        """Match the point clouds of a rig without cameras, in folders named after its LiDARs.

        Raises:
            SourceError: a LiDAR has no folder or no point clouds, or they cannot be matched.
        """
        folders = _folders(self.path)
        place = next((folders[n] for n in CLOUD_FOLDERS if n in folders and n not in self._rig.lidars), None)
        folders = folders if place is None else {**folders, **_folders(place)}
        clouds: dict[str, list[PairOnDisk]] = {}
        for name, settings in self._rig.lidars.items():
            files = _files(folders[name.lower()], frozenset(DECODERS)) if name.lower() in folders else []
            if files:
                if any(file.suffix.lower() == ".las" for file in files):
                    require_las()
                clouds[name] = [
                    PairOnDisk((), file, name, settings, stamp_ns)
                    for file, stamp_ns in zip(files, _stamps_ns(files), strict=True)
                ]
        if len(clouds) < 2:
            names = [f"{name}/" for name in self._rig.lidars]
            raise SourceError(
                f"{self.path}: point clouds of fewer than two LiDARs found",
                f"Put each LiDAR's into a folder of its name: {', '.join(names)}; equal file names match.",
            )
        (first, firsts), *others = clouds.items()
        together: dict[int, list[PairOnDisk]] = {}
        for name, seconds in others:
            tolerance_s = self._options.pair_tolerance_s
            if tolerance_s is None:
                limits = (self._rig.lidars[each].timestamps.tolerance_s for each in (first, name))
                tolerance_s = max(limits)
            of_second, of_first = ([part.cloud_path.stem for part in parts] for parts in (seconds, firsts))
            both = {"what": f"point clouds of {name}", "other": f"of {first}"}
            pairing = pair_names(of_second, of_first, self._options.pair, tolerance_s, **both)
            self.notes.append(
                f"{self.path.name}: {first} and {name}: {len(pairing.pairs)} pairs, {pairing.reason}"
            )
            for i, j in pairing.pairs:
                together.setdefault(j, [firsts[j]]).append(seconds[i])
        return [ScansOnDisk(tuple(parts)) for _, parts in sorted(together.items())]

    def _pair(self, images: Sequence[Sequence[ImageOnDisk]], clouds: Sequence[Path]) -> list[Pairing]:
        """Match each camera's images with the point clouds, all cameras' in one way."""
        pairings = [self._pair_camera(paths, clouds, self._options.pair) for paths in images]
        methods = {pairing.method for pairing in pairings}
        if len(methods) > 1:
            # A camera whose names match less well must not be counted off against the others' names.
            method: PairMethod = "stem" if "stem" in methods else "time"
            pairings = [self._pair_camera(paths, clouds, method) for paths in images]
        for of_camera, pairing in zip(images, pairings, strict=True):
            whose = f"{of_camera[0].camera}: " if len(images) > 1 else ""
            note = f"{self.path.name}: {whose}{len(pairing.pairs)} pairs, {pairing.reason}"
            n_images = len(of_camera) - len(pairing.pairs)
            n_clouds = len(clouds) - len({j for _, j in pairing.pairs})
            if n_images or n_clouds:
                note += f"; {n_images} images and {n_clouds} point clouds have no partner"
            self.notes.append(note)
        return pairings

    def _pair_camera(
        self, images: Sequence[ImageOnDisk], clouds: Sequence[Path], method: PairMethod
    ) -> Pairing:
        first, tolerance_s = images[0], self._options.pair_tolerance_s
        if tolerance_s is None:
            tolerance_s = self._rig.cameras[first.camera].channels[first.channel].timestamps.tolerance_s
        stems = [image.path.stem for image in images], [cloud.stem for cloud in clouds]
        try:
            return pair_names(*stems, method, tolerance_s)
        except SourceError as error:
            whose = f" (camera {first.camera})" if len(self._rig.cameras) > 1 else ""
            raise SourceError(f"{self.path}{whose}: {error.what}", error.hint) from None
