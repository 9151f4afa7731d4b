"""Simultaneous recordings of several recorders, read as one."""

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from lce_rig.core.data import Sample, Stream
from lce_rig.core.errors import SourceError
from lce_rig.io.merging import merge_by_time
from lce_rig.io.overlap import check_overlap
from lce_rig.io.protocol import ContinuousRecording, Recording, Span, serials_of
from lce_rig.rig import Rig
from lce_rig.timing.rig_time import stream_of


def join_recordings(recordings: Iterable[Recording], rig: Rig) -> list[Recording]:
    """Join continuous recordings of the same moment, in the order given.

    A recording is of the same moment as those before it where it repeats no LiDAR, and adds a sensor or runs
    while their LiDAR does; what else it repeats is skipped.
    """
    groups: list[list[Recording]] = []
    for recording in recordings:
        if groups and _belongs(recording, groups[-1], rig):
            groups[-1].append(recording)
        else:
            groups.append([recording])
    return [_joined(group, rig) for group in groups]


def require_sensors(recording: ContinuousRecording) -> None:
    """Make sure that a recording holds a LiDAR and a camera.

    Raises:
        SourceError: it does not; the hint says what to give as well.
    """
    kinds = {stream.kind for stream in recording.streams}
    holds = ", ".join(f"{stream.kind} of {stream}" for stream in sorted(recording.streams))
    if "scans" not in kinds:
        raise SourceError(
            f"{recording.path}: no scans of a LiDAR; it holds {holds}",
            "Also give the LiDAR's recording of the same time: --from lidar.bag --from events.aedat4",
        )
    if kinds == {"scans"}:
        raise SourceError(
            f"{recording.path}: no images and no events; it holds {holds}",
            "Also give the camera's recording of the same time: --from lidar.bag --from events.aedat4",
        )


class JoinedRecording:
    """Several simultaneous recordings; see `ContinuousRecording`.

    Attributes:
        path: of the first.
        notes: those of all, and what was skipped.
        key: fingerprint of all, in whatever order they were given.
        n_samples: images and scans of all.
        streams: each from the first recording that holds it.
        serials: serial numbers by sensor, as far as a part tells them.
    """

    def __init__(self, parts: Sequence[ContinuousRecording], rig: Rig) -> None:
        self.path: Path = parts[0].path
        self.notes: list[str] = [note for part in parts for note in part.notes]
        self.key = hashlib.sha256(" ".join(sorted(part.key for part in parts)).encode()).hexdigest()
        self.n_samples = sum(part.n_samples for part in parts)
        self.serials = {name: serial for part in parts for name, serial in serials_of(part).items()}
        self._parts = parts
        self._rig = rig
        self._owner: dict[Stream, ContinuousRecording] = {}
        for part in parts:
            for stream in part.streams:
                owner = self._owner.setdefault(stream, part)
                if owner is not part:
                    self.notes.append(f"{stream}: taken from {owner.path.name}, not from {part.path.name}")
        self.streams: dict[Stream, Span | None] = {s: part.streams[s] for s, part in self._owner.items()}

    def samples(self) -> Iterator[Sample]:
        """Yield the samples of all parts, merged by the rig's time.

        Raises:
            SourceError: images or events of one part lie wholly before or after the scans of another; or,
                after everything that can be read, a part is torn.
        """
        self._check_overlap()
        try:
            yield from merge_by_time([self._own_samples(part) for part in self._parts], self._rig)
        finally:
            self.notes += [n for part in self._parts for n in part.notes if n not in self.notes]

    def _own_samples(self, part: ContinuousRecording) -> Iterator[Sample]:
        return (
            sample for sample in part.samples() if self._owner.get(stream_of(sample, self._rig), part) is part
        )

    def _check_overlap(self) -> None:
        for scans_part in self._parts:
            scans = {s: span for s, span in scans_part.streams.items() if s.kind == "scans"}
            others = {s: self.streams[s] for s, part in self._owner.items() if part is not scans_part}
            self.notes += check_overlap(
                scans, {s: o for s, o in others.items() if s.kind != "scans"}, self._rig
            )


def _belongs(recording: Recording, group: Sequence[Recording], rig: Rig) -> bool:
    parts = [other for other in group if isinstance(other, ContinuousRecording)]
    if not isinstance(recording, ContinuousRecording) or len(parts) < len(group):
        return False
    known = {stream for part in parts for stream in part.streams}
    ours = set(recording.streams)
    if any(stream.kind == "scans" for stream in known & ours):
        return False
    return bool(ours - known) or _is_copy(recording, parts, rig)


def _is_copy(recording: ContinuousRecording, parts: Sequence[ContinuousRecording], rig: Rig) -> bool:
    """Return whether all of a recording runs while a LiDAR does, whose cameras are there already."""
    scans = {s: span for part in parts for s, span in part.streams.items() if s.kind == "scans"}
    if not any(scans.values()) or not all(recording.streams.values()):
        return False
    try:
        check_overlap(scans, recording.streams, rig)
    except SourceError:
        return False
    return True


def _joined(group: Sequence[Recording], rig: Rig) -> Recording:
    parts = [recording for recording in group if isinstance(recording, ContinuousRecording)]
    return group[0] if len(group) == 1 else JoinedRecording(parts, rig)
