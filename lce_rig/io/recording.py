"""The interface of all recordings, their assignment to sensors, and recordings read together."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from heapq import merge
from itertools import product
from pathlib import Path
from typing import Protocol, runtime_checkable

from lce_rig.core.data import Events, Sample, Stream
from lce_rig.core.errors import SourceError, reading
from lce_rig.core.findings import Losses
from lce_rig.core.progress import Progress
from lce_rig.io.findings import CLOCK_SET_BACK, OUT_OF_ORDER
from lce_rig.rig import Rig
from lce_rig.timing.clock import NS_PER_S, SINCE_1970_NS
from lce_rig.timing.scan_pairing import event_channel, rig_time_ns, stream_of

_END_BYTES = 65536
_CLOCK_JUMP_NS = 1_000_000_000
# Gap below which streams count as overlapping, s: sensors start one after the other.
_ROUGH_S = 0.2
# Possible wrong units of event timestamps, and the largest relative difference of the durations.
_UNITS = (1_000, 1_000_000, 1_000_000_000)
_UNIT_TOLERANCE = 0.2
# Duration after which this is checked during reading, so that no captures are made from such events.
_UNIT_CHECK_NS = 2_000_000_000
# Sensors are switched on and off one after the other.
_USUAL_LAG_S = 2.0


@dataclass(frozen=True)
class SourceOptions:
    """Options for reading a recording; they override the profile.

    Attributes:
        camera, channel, lidar: sensors of a folder's images and point clouds; None takes the rig's first
            channel and LiDAR, and the camera from folders' names or the rig's only camera.
        topics: topic by sensor ("cam", "cam.events", "lidar"), in place of the profile's.
        is_part: whether simultaneous recordings hold the sensors missing here.
    """

    camera: str | None = None
    channel: str | None = None
    lidar: str | None = None
    topics: Mapping[str, str] = field(default_factory=dict)
    is_part: bool = False


class Recording(Protocol):
    """Any recording.

    Attributes:
        path: file or folder.
        notes: choices, assumptions and missing data, in words; grows while it is read.
    """

    path: Path
    notes: list[str]


@runtime_checkable
class ContinuousRecording(Recording, Protocol):
    """A continuous recording of a moving board.

    Attributes:
        key: fingerprint of the recording.
        n_samples: number of images and scans to come, for progress.
        streams: the sensor channels in it.
    """

    key: str
    n_samples: int
    streams: Set[Stream]

    def samples(self) -> Iterator[Sample]:
        """Yield images, scans and event packets, in order of time."""
        ...


def serials_of(recording: Recording) -> dict[str, str]:
    """Return the serial numbers in a recording, by sensor; empty for most recordings.

    Readers of formats with serial numbers have an attribute `serials`.
    """
    return dict(getattr(recording, "serials", {}))


def fingerprint(files: Iterable[Path]) -> str:
    """Hash names, sizes and both ends of files, which identify a recording in any folder."""
    digest = hashlib.sha256()
    for file in files:
        size = file.stat().st_size
        with reading(file), file.open("rb") as stream:
            head = stream.read(_END_BYTES)
            stream.seek(max(size - _END_BYTES, 0))
            digest.update(f"{file.name} {size}".encode() + head + stream.read(_END_BYTES))
    return digest.hexdigest()


def choose_camera(
    rig: Rig, options: SourceOptions, notes: list[str], camera: str | None = None
) -> tuple[str, str]:
    """Choose the (camera, channel) of a folder's images: as requested, else the rig's only camera.

    Args:
        rig: the profile.
        options: the user's choice.
        notes: receives the choice, in words.
        camera: camera named by the folder itself, or None.

    Raises:
        SourceError: the rig has no such camera or channel, or several cameras and none was named.
    """
    camera = camera or options.camera
    if camera is None:
        camera, *others = rig.cameras
        if others:  # Images assigned to the wrong camera would corrupt both extrinsics.
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
    """Choose the LiDAR of a folder's point clouds: as requested, else the rig's first.

    Raises:
        SourceError: the rig has no such LiDAR.
    """
    if not rig.lidars:
        raise SourceError(f"rig {rig.name!r} has no LiDAR", "Add it to the profile, or give images alone.")
    lidar = options.lidar or next(iter(rig.lidars))
    if lidar not in rig.lidars:
        raise SourceError(f"rig {rig.name!r} has no lidar {lidar!r}; it has {', '.join(rig.lidars)}")
    if len(rig.lidars) > 1 and not options.lidar:
        notes.append(f"point clouds assigned to lidar {lidar}")
    return lidar


def choose_event_camera(rig: Rig, options: SourceOptions, notes: list[str]) -> tuple[str, str]:
    """Choose the (camera, channel) of an event file: as requested, else the first with events.

    Raises:
        SourceError: the rig has no camera with a channel of kind events, or not the requested one.
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


def merge_by_time(parts: Iterable[Iterable[Sample]], rig: Rig) -> Iterator[Sample]:
    """Merge the samples of all parts by time; each part's own order is kept.

    Packets of events count by their first timestamp. Only one sample of each part is held.

    Raises:
        SourceError: a part is torn; raised after all samples of all parts.
    """
    torn: list[SourceError] = []

    def keyed(part: Iterable[Sample]) -> Iterator[tuple[int, Sample]]:
        time_ns = -(2**62)
        try:
            for sample in part:
                sample_ns = rig_time_ns(sample, rig)
                # A sample without a timestamp comes right after its predecessor.
                time_ns = time_ns if sample_ns is None else sample_ns
                yield time_ns, sample
        except SourceError as error:
            torn.append(error)

    for _, sample in merge(*map(keyed, parts), key=lambda pair: pair[0]):
        yield sample
    if torn:
        raise torn[0]


def follows(stamp_ns: int | None, last_ns: int | None, losses: Losses) -> bool:
    """Check whether a sample comes after its predecessor; count duplicate and late ones, to be skipped.

    A timestamp earlier by more than a second means that the clock was set: the sequence begins again.
    """
    if stamp_ns is None or last_ns is None or stamp_ns > last_ns:
        return True
    is_set_back = last_ns - stamp_ns >= _CLOCK_JUMP_NS
    losses.add(CLOCK_SET_BACK() if is_set_back else OUT_OF_ORDER())
    return is_set_back


def check_overlap(samples: Iterable[Sample], rig: Rig, notes: list[str]) -> Iterator[Sample]:
    """Pass samples on; at the end, check that images and events overlap with a LiDAR's scans.

    Args:
        samples: samples of a whole recording.
        rig: profile whose `expected_offset_s` are added to the timestamps.
        notes: receives the streams that cover only a part of the scans.

    Raises:
        SourceError: a stream lies wholly before or after the scans, with the distance and the remedy; or
            timestamps of events are in another unit than their format's.
    """
    spans_ns: dict[Stream, tuple[int, int]] = {}
    received_ns: dict[Stream, tuple[int, int]] = {}
    for sample in samples:
        time_ns = rig_time_ns(sample, rig)
        if time_ns is not None:
            stream = stream_of(sample, rig)
            first_ns, last_ns = spans_ns.get(stream, (time_ns, time_ns))
            # A file's packets of events may be as long as a scan sequence.
            length_ns = int(sample.t_ns[-1] - sample.t_ns[0]) if isinstance(sample, Events) else 0
            spans_ns[stream] = min(first_ns, time_ns), max(last_ns, time_ns + length_ns)
            if isinstance(sample, Events) and sample.host_ns is not None:
                first_ns, _ = received_ns.get(stream, (sample.host_ns, 0))
                received_ns[stream] = first_ns, sample.host_ns
                if sample.host_ns - first_ns > _UNIT_CHECK_NS:
                    _check_unit(stream, spans_ns[stream], "their packets", received_ns[stream])
        yield sample
    spans = {stream: (1e-9 * span[0], 1e-9 * span[1]) for stream, span in sorted(spans_ns.items())}
    scans = {stream: span for stream, span in spans.items() if stream.kind == "scans"}
    for stream, span_ns in sorted(spans_ns.items()):
        if stream.kind == "events" and stream in received_ns:
            _check_unit(stream, span_ns, "their packets", received_ns[stream])
        elif stream.kind == "events" and scans:
            lidar = next(iter(scans))
            _check_unit(stream, span_ns, f"{lidar}'s scans", spans_ns[lidar])
    for (lidar, (scan_0, scan_1)), (camera, (first, last)) in product(scans.items(), spans.items()):
        if camera in scans:
            continue
        overlap_s, length_s = min(last, scan_1) - max(first, scan_0), scan_1 - scan_0
        if overlap_s < -_ROUGH_S:
            key = f"cameras.{camera.sensor}.channels.{camera.channel}.timestamps.expected_offset_s"
            hint = "Record both at the same time on one computer's clock, preferably into one bag."
            if abs(scan_0 - first) <= 3600.0:  # further apart, they belong to two recordings
                hint = (
                    "If they were recorded together, add the difference of their clocks to "
                    f"{key} in the profile ({scan_0 - first:+.1f} s if both were started at once)."
                )
            if min(scan_0, first) < SINCE_1970_NS / NS_PER_S <= max(scan_0, first):
                if scan_0 < first:
                    key = f"lidars.{lidar.sensor}.timestamps.expected_offset_s"
                hint = (
                    f"{lidar if scan_0 < first else camera} counts from its start. Record both into one bag, "
                    "whose times of receipt relate the clocks, or add their difference to "
                    f"{key} in the profile ({abs(scan_0 - first):+.1f} s if both were started at once)."
                )
            raise SourceError(
                f"{camera}: {camera.kind} run from {first:.3f} to {last:.3f} s, "
                f"scans from {scan_0:.3f} to {scan_1:.3f} s: {-overlap_s:.1f} s apart",
                hint,
            )
        if length_s - overlap_s > _USUAL_LAG_S:
            covered = f"{max(overlap_s, 0.0):.1f} of the {length_s:.1f} s of {lidar}'s scans"
            notes.append(f"{camera}: {camera.kind} cover {covered}")


def read_samples(recording: ContinuousRecording, rig: Rig, progress: Progress) -> Iterator[Sample]:
    """Read a whole recording, as in `check_overlap`; events do not count in the progress."""
    done = 0
    for sample in check_overlap(recording.samples(), rig, recording.notes):
        yield sample
        if not isinstance(sample, Events):
            done += 1
            progress(done, recording.n_samples)


def _check_unit(stream: Stream, span_ns: tuple[int, int], other: str, other_ns: tuple[int, int]) -> None:
    """Compare the duration of events with that of their packets' receipt, or of a LiDAR's scans.

    Raises:
        SourceError: the durations differ by the factor between two units of time.
    """
    length_s, other_s = (1e-9 * max(last - first, 1) for first, last in (span_ns, other_ns))
    for unit, (name, remedy) in product(_UNITS, (("small", "Multiply"), ("large", "Divide"))):
        factor = unit if name == "small" else 1 / unit
        if abs(other_s / (length_s * factor) - 1) < _UNIT_TOLERANCE:
            raise SourceError(
                f"{stream}: events span {length_s:.4g} s, {other} {other_s:.4g} s: the events' timestamps "
                f"are {unit} times too {name}, in another unit than declared",
                f"{remedy} them by {unit}: bags hold ns, HDF5 and AEDAT4 us.",
            )


def join_recordings(recordings: Sequence[Recording], rig: Rig) -> list[Recording]:
    """Join simultaneous continuous recordings, in the given order.

    A recording belongs to those before it if it repeats no LiDAR, and either adds a sensor or no later
    recording holds only a LiDAR. Other repeated sensors are skipped.
    """
    groups: list[list[Recording]] = []
    for place, recording in enumerate(recordings):
        if groups and _belongs(recording, groups[-1], recordings[place + 1 :]):
            groups[-1].append(recording)
        else:
            groups.append([recording])
    return [
        group[0]
        if len(group) == 1
        else JoinedRecording([part for part in group if isinstance(part, ContinuousRecording)], rig)
        for group in groups
    ]


def _belongs(recording: Recording, group: Sequence[Recording], later: Sequence[Recording]) -> bool:
    parts = [other for other in group if isinstance(other, ContinuousRecording)]
    if not isinstance(recording, ContinuousRecording) or len(parts) < len(group):
        return False
    held = {stream for part in parts for stream in part.streams}
    if any(stream.kind == "scans" for stream in held & recording.streams):
        return False
    kinds_later = [{s.kind for s in r.streams} for r in later if isinstance(r, ContinuousRecording)]
    return bool(recording.streams - held) or {"scans"} not in kinds_later


def require_sensors(recording: ContinuousRecording, rig: Rig) -> None:
    """Check that a recording holds a LiDAR and a camera, or two sensors of a rig of one kind.

    Raises:
        SourceError: a sensor is missing; the hint names the recording to add.
    """
    kinds = {stream.kind for stream in recording.streams}
    holds = ", ".join(f"{stream.kind} of {stream}" for stream in sorted(recording.streams))
    example = "recording of the same time: --from lidar.bag --from events.aedat4"
    if not rig.lidars:
        if len({stream.sensor for stream in recording.streams}) < 2:
            what = f"{recording.path}: images of one camera only; it holds {holds}"
            raise SourceError(what, "Also give the other camera's recording of the same time.")
        return
    if "scans" not in kinds:
        what = f"{recording.path}: no scans of a LiDAR; it holds {holds}"
        raise SourceError(what, f"Also give the LiDAR's {example}")
    if not rig.cameras:
        if len([stream for stream in recording.streams if stream.kind == "scans"]) < 2:
            what = f"{recording.path}: scans of one LiDAR only; it holds {holds}"
            hint = (
                "Also give the other LiDAR's recording of the same time: --from front.pcap --from side.pcap"
            )
            raise SourceError(what, f"{hint} --lidar front --lidar side.")
        return
    if kinds == {"scans"}:
        what = f"{recording.path}: no images and no events; it holds {holds}"
        raise SourceError(what, f"Also give the camera's {example}, or a folder of images")


class JoinedRecording:
    """Several simultaneous recordings; see `ContinuousRecording`.

    Attributes:
        path: path of the first recording.
        notes: notes of all recordings, and the skipped sensors.
        key: fingerprint of all, in any order.
        n_samples: images and scans of all.
        streams: each from the first recording that holds it.
        serials: serial numbers by sensor, as far as the parts have them.
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
            for stream in sorted(part.streams):
                owner = self._owner.setdefault(stream, part)
                if owner is not part:
                    self.notes.append(f"{stream}: taken from {owner.path.name}, not from {part.path.name}")
        self.streams = frozenset(self._owner)

    def samples(self) -> Iterator[Sample]:
        """Yield the samples of all parts, merged by the rig's time.

        Raises:
            SourceError: a part is torn; raised after everything that can be read.
        """
        try:
            yield from merge_by_time([self._owned(part) for part in self._parts], self._rig)
        finally:
            self.notes += [n for part in self._parts for n in part.notes if n not in self.notes]

    def _owned(self, part: ContinuousRecording) -> Iterator[Sample]:
        """Yield the samples of the streams read from a part."""
        return (
            sample for sample in part.samples() if self._owner.get(stream_of(sample, self._rig), part) is part
        )
