"""The interface of every recording, and the sensors of the rig that its data belong to."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

from lce_rig.core.data import Sample, Stream
from lce_rig.core.errors import SourceError
from lce_rig.rig import Rig
from lce_rig.timing.rig_time import event_channel

_END_BYTES = 65536


@dataclass(frozen=True)
class SourceOptions:
    """Options for reading a recording; they override the profile.

    Attributes:
        camera, channel, lidar: of a folder's images and point clouds; None takes the rig's first channel and
            LiDAR, and its camera where it has one only or folders are named after them.
        topics: topic by sensor ("cam", "cam.events", "lidar"), in place of the profile's.
        is_part: whether other recordings of the same moment hold what this one lacks.
    """

    camera: str | None = None
    channel: str | None = None
    lidar: str | None = None
    topics: Mapping[str, str] = field(default_factory=dict)
    is_part: bool = False


class Recording(Protocol):
    """Anything recorded.

    Attributes:
        path: where it lies.
        notes: what was chosen, assumed or missing, in words; grows while it is read.
    """

    path: Path
    notes: list[str]


@runtime_checkable
class ContinuousRecording(Recording, Protocol):
    """A continuous recording of a moving board.

    Attributes:
        key: fingerprint of the recording.
        n_samples: number of images and scans to come, for progress.
        streams: what is in it.
    """

    key: str
    n_samples: int
    streams: Set[Stream]

    def samples(self) -> Iterator[Sample]:
        """Yield what the sensors saw, in order of time; events in packets."""
        ...


def serials_of(recording: Recording) -> dict[str, str]:
    """Give the serial numbers of sensors that a recording tells, by sensor; most tell none.

    A reader that knows them has an attribute `serials`.
    """
    return dict(getattr(recording, "serials", {}))


def fingerprint(files: Iterable[Path]) -> str:
    """Hash names, sizes and both ends of files: enough to know a recording again, wherever it lies."""
    digest = hashlib.sha256()
    for file in files:
        size = file.stat().st_size
        with file.open("rb") as stream:
            head = stream.read(_END_BYTES)
            stream.seek(max(size - _END_BYTES, 0))
            digest.update(f"{file.name} {size}".encode() + head + stream.read(_END_BYTES))
    return digest.hexdigest()


def choose_camera(
    rig: Rig, options: SourceOptions, notes: list[str], camera: str | None = None
) -> tuple[str, str]:
    """Name the (camera, channel) that a folder's images belong to: as asked, else the rig's only camera.

    Args:
        rig: the profile.
        options: what was asked for.
        notes: takes what was chosen.
        camera: that the folder itself names; None where it does not.

    Raises:
        SourceError: the rig has no such camera or channel, or several cameras and none was named.
    """
    camera = camera or options.camera
    if camera is None:
        camera, *others = rig.cameras
        if others:  # Images of one that are taken for another's would spoil both extrinsics.
            raise SourceError(
                f"rig {rig.name!r} has cameras {', '.join(rig.cameras)}: the images' camera is not known",
                f"Name it with --camera {camera}, or put each camera's images into a folder of its name: "
                f"img/{camera}/, img/{others[0]}/ and pcd/.",
            )
    if camera not in rig.cameras:
        raise SourceError(f"rig {rig.name!r} has no camera {camera!r}; it has {', '.join(rig.cameras)}")
    channels = rig.cameras[camera].channels
    channel = options.channel or next(iter(channels))
    if channel not in channels:
        raise SourceError(f"camera {camera!r} has no channel {channel!r}; it has {', '.join(channels)}")
    if len(channels) > 1 and not options.channel:
        notes.append(f"images assigned to camera {camera}, channel {channel}")
    return camera, channel


def choose_lidar(rig: Rig, options: SourceOptions, notes: list[str]) -> str:
    """Name the LiDAR that a folder's point clouds belong to: as asked, else the rig's first.

    Raises:
        SourceError: the rig has no such LiDAR.
    """
    lidar = options.lidar or next(iter(rig.lidars))
    if lidar not in rig.lidars:
        raise SourceError(f"rig {rig.name!r} has no lidar {lidar!r}; it has {', '.join(rig.lidars)}")
    if len(rig.lidars) > 1 and not options.lidar:
        notes.append(f"point clouds assigned to lidar {lidar}")
    return lidar


def choose_event_camera(rig: Rig, options: SourceOptions, notes: list[str]) -> tuple[str, str]:
    """Name the (camera, channel) that a file of events belongs to: as asked, else the first with events.

    Raises:
        SourceError: the rig has no camera with a channel of kind events, or not the one asked for.
    """
    with_events = {name: channel for name in rig.cameras if (channel := event_channel(rig, name))}
    if not with_events:
        raise SourceError(
            f"rig {rig.name!r} has no camera with events",
            "Give one a channel of `kind: events` in the profile, or start from the rig rles.",
        )
    if options.camera and options.camera not in with_events:
        has = ", ".join(with_events)
        raise SourceError(f"rig {rig.name!r} has no event camera {options.camera!r}; it has {has}")
    camera = options.camera or next(iter(with_events))
    if len(with_events) > 1 and not options.camera:
        notes.append(f"events assigned to camera {camera}")
    return camera, with_events[camera]
