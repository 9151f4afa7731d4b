"""A folder of pictures and clouds, one of each for every board placement."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lce_rig.core.data import Image
from lce_rig.core.errors import SourceError
from lce_rig.rig import LidarSettings, Rig
from lce_rig.sources import cloud_file, image_file
from lce_rig.sources.base import Pair, SourceOptions
from lce_rig.sources.cloud import to_scan
from lce_rig.sources.pairing import natural_order, pair_names, parse_times
from lce_rig.sources.sensors import choose_camera, choose_lidar

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


@dataclass(frozen=True)
class PairOnDisk:
    """A picture and a cloud that have not been read yet; the stamps are those in their names."""

    image_path: Path
    cloud_path: Path
    camera: str
    channel: str
    lidar: str
    settings: LidarSettings
    image_stamp_ns: int | None
    cloud_stamp_ns: int | None

    @property
    def label(self) -> str:
        """The files' names, for messages."""
        return f"{self.image_path.name} + {self.cloud_path.name}"

    def key(self) -> str:
        """Fingerprint the bytes of both files and the sensors they are read for.

        Raises:
            SourceError: a file cannot be read.
        """
        digest = hashlib.sha256(f"{self.camera} {self.channel} {self.lidar}".encode())
        for path in (self.image_path, self.cloud_path):
            try:
                digest.update(hashlib.sha256(path.read_bytes()).digest())
            except OSError as error:
                raise SourceError(f"{path}: cannot be read: {error.strerror}") from None
        return digest.hexdigest()

    def read(self) -> Pair:
        """Decode both files.

        Raises:
            SourceError: one is missing, empty, truncated or damaged.
        """
        pixels = image_file.read_image(self.image_path)
        cloud = cloud_file.read_cloud(self.cloud_path)
        reading = to_scan(cloud, self.lidar, self.settings, str(self.cloud_path), self.cloud_stamp_ns)
        notes = list(reading.notes)
        if reading.n_not_finite or reading.n_zero_range:
            n_dropped = reading.n_not_finite + reading.n_zero_range
            notes.append(f"{self.cloud_path.name}: {n_dropped} points without a return left out")
        image = Image(self.camera, self.channel, self.image_stamp_ns, pixels)
        return Pair(self.label, self.key(), (image,), (reading.scan,), tuple(notes))


class FolderRecording:
    """Pictures and clouds in two folders side by side, or in one.

    Attributes:
        path: the folder.
        notes: how pairs were found and what was left over.
        pairs: every pair, by name of its picture; read them one by one.
    """

    def __init__(self, path: Path, rig: Rig, options: SourceOptions) -> None:
        """Find the files and pair them; nothing is decoded yet.

        Raises:
            SourceError: no pictures, no clouds, or no way to pair them.
        """
        self.path = path
        self.notes: list[str] = []
        camera, channel = choose_camera(rig, options, self.notes)
        lidar = choose_lidar(rig, options, self.notes)
        image_paths = self._list(IMAGE_FOLDERS, image_file.SUFFIXES, "pictures")
        cloud_paths = self._list(CLOUD_FOLDERS, frozenset(cloud_file.DECODERS), "clouds")
        stems = [p.stem for p in image_paths], [p.stem for p in cloud_paths]
        tolerance_s = options.pair_tolerance_s
        if tolerance_s is None:
            tolerance_s = rig.cameras[camera].channels[channel].timestamps.tolerance_s
        try:
            pairing = pair_names(*stems, options.pair, tolerance_s)
        except SourceError as error:
            raise SourceError(f"{path}: {error.what}", error.hint) from None
        self.notes.append(f"{path.name}: {pairing.explanation}")
        lone = [image_paths[i].name for i in pairing.lone_images] + [
            cloud_paths[j].name for j in pairing.lone_clouds
        ]
        if lone:
            self.notes.append(f"{path.name}: without a partner: {_shorten(lone)}")
        image_ns, cloud_ns = parse_times(stems[0]), parse_times(stems[1])
        self.pairs = [
            PairOnDisk(
                image_paths[i],
                cloud_paths[j],
                camera,
                channel,
                lidar,
                rig.lidars[lidar],
                None if image_ns is None else int(image_ns[i]),
                None if cloud_ns is None else int(cloud_ns[j]),
            )
            for i, j in pairing.pairs
        ]

    def _list(self, names: Sequence[str], suffixes: frozenset[str], what: str) -> list[Path]:
        """List the files of one kind in the folder whose name says so, else in the only one that has any."""
        folders = {p.name.lower(): p for p in sorted(self.path.iterdir()) if p.is_dir() and p.name[0] != "."}
        holding = {name: files for name, p in folders.items() if (files := _files(p, suffixes))}
        named = [name for name in names if name in holding]
        if len(named) > 1:
            self.notes.append(
                f"{self.path.name}: {what} taken from {named[0]}/, not from {', '.join(named[1:])}"
            )
        if named:
            return holding[named[0]]
        if here := _files(self.path, suffixes):
            return here
        if len(holding) == 1:
            return next(iter(holding.values()))
        hint = f"Put them into {names[0]}/ below it; {', '.join(sorted(suffixes))} are read."
        if holding:
            raise SourceError(f"{self.path}: {what} lie in {', '.join(sorted(holding))}: which?", hint)
        empty = next((name for name in names if name in folders), None)
        raise SourceError(f"{self.path}{'/' + empty if empty else ''}: no {what} there", hint)


def _files(folder: Path, suffixes: frozenset[str]) -> list[Path]:
    found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.is_file() and p.name[0] != "."]
    return sorted(found, key=lambda p: (natural_order(p.stem), p.name))


def _shorten(names: Sequence[str], n_shown: int = 6) -> str:
    shown = ", ".join(names[:n_shown])
    return shown if len(names) <= n_shown else f"{shown} and {len(names) - n_shown} more"
