"""The interface of every recording."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol, TypeAlias, runtime_checkable

from lce_rig.core.data import Image, Sample, Scan, Stream

PairMethod: TypeAlias = Literal["auto", "stem", "order", "time"]
Span: TypeAlias = tuple[int, int]
"""First and last timestamp, ns, the sensor's own clock."""


@dataclass(frozen=True)
class SourceOptions:
    """Options for reading a recording; they override the profile.

    Attributes:
        camera, channel, lidar: of a folder's images and point clouds; None takes the rig's first channel and
            LiDAR, and its camera where it has one only or folders are named after them.
        pair: how a folder's images and point clouds are matched.
        pair_tolerance_s: largest difference in time of a pair; None takes the profile's.
        topics: topic by sensor ("cam", "cam.events", "lidar"), in place of the profile's.
        is_part: whether other recordings of the same moment hold what this one lacks.
    """

    camera: str | None = None
    channel: str | None = None
    lidar: str | None = None
    pair: PairMethod = "auto"
    pair_tolerance_s: float | None = None
    topics: Mapping[str, str] = field(default_factory=dict)
    is_part: bool = False


@dataclass(frozen=True, eq=False)
class RecordedPair:
    """The samples of one board placement.

    Attributes:
        label: the files it came from, for messages: "00003.png + 00003.pcd".
        key: fingerprint of those files; the same files give the same key wherever they lie.
        notes: what was assumed or skipped, in words.
    """

    label: str
    key: str
    images: tuple[Image, ...]
    scans: tuple[Scan, ...]
    notes: tuple[str, ...] = ()


class PairFiles(Protocol):
    """A pair that has not been read yet."""

    @property
    def label(self) -> str:
        """The files' names, for messages."""
        ...

    def key(self) -> str:
        """Fingerprint the files without decoding them."""
        ...

    def read(self) -> RecordedPair:
        """Decode the files; SourceError names the one that cannot be read."""
        ...


class Recording(Protocol):
    """Anything recorded.

    Attributes:
        path: where it lies.
        notes: what was chosen, assumed or missing, in words; grows while it is read.
    """

    path: Path
    notes: list[str]


@runtime_checkable
class PairedRecording(Recording, Protocol):
    """A recording with matched images and point clouds of each board placement."""

    pairs: Sequence[PairFiles]


@runtime_checkable
class ContinuousRecording(Recording, Protocol):
    """A continuous recording of a moving board.

    Attributes:
        key: fingerprint of the recording.
        n_samples: number of images and scans to come, for progress.
        streams: what is in it, with the span of its timestamps where they need not all be read.
    """

    key: str
    n_samples: int
    streams: Mapping[Stream, Span | None]

    def samples(self) -> Iterator[Sample]:
        """Yield what the sensors saw, in order of time; events in packets."""
        ...


def serials_of(recording: Recording) -> dict[str, str]:
    """Give the serial numbers of sensors that a recording tells, by sensor; most tell none.

    A reader that knows them has an attribute `serials`.
    """
    return dict(getattr(recording, "serials", {}))
