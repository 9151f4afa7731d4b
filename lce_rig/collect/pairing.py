"""Streams of several sensors cut into frames: one scan, and what the others saw at about that time."""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from lce_rig.core.data import Image, Scan
from lce_rig.rig import Rig

PATIENCE_NS = 1_000_000_000


@dataclass(frozen=True, eq=False)
class Frame:
    """What the rig saw at one time.

    Attributes:
        time_ns: middle of the first LiDAR's sweep, rig time (stamps plus the profile's expected offsets).
        images: the picture of each camera channel that has one within the tolerance.
        scans: the scan of the first LiDAR, and of each other that has one within the tolerance.
    """

    time_ns: int
    images: tuple[Image, ...]
    scans: tuple[Scan, ...]


@dataclass
class PairingCounts:
    """How pairing went.

    Attributes:
        n_alone: scans with no picture within the tolerance.
        nearest_ns: smallest difference in time of any picture to a scan; None where none could be compared.
    """

    n_alone: int = 0
    nearest_ns: int | None = None


def pair_by_time(samples: Iterable[Image | Scan], rig: Rig, counts: PairingCounts) -> Iterator[Frame]:
    """Give each scan of the first LiDAR heard the nearest picture of each camera channel.

    Samples come in order of receipt: a scan waits until every other sensor has passed its time, or a second
    has gone by. Where clocks are set back, what waits is given up.

    Args:
        samples: pictures and scans; each sensor's stamps rise.
        rig: its timestamps say what to add to stamps, and how far pairs may lie apart.
        counts: filled as frames are made.
    """
    waiting: deque[tuple[int, Scan]] = deque()
    buffers: dict[tuple[str, str], deque[tuple[int, Image | Scan]]] = {}
    anchor: str | None = None
    newest_ns = -(2**62)
    for sample in samples:
        time_ns = _rig_time_ns(sample, rig)
        if time_ns is None:
            continue
        if time_ns < newest_ns - 2 * PATIENCE_NS:
            waiting.clear()
            buffers.clear()
            newest_ns = time_ns
        newest_ns = max(newest_ns, time_ns)
        if isinstance(sample, Scan) and sample.sensor == (anchor or sample.sensor):
            anchor = sample.sensor
            waiting.append((time_ns, sample))
        else:
            key = (sample.sensor, sample.channel if isinstance(sample, Image) else "")
            buffers.setdefault(key, deque()).append((time_ns, sample))
        while waiting and _is_due(waiting[0][0], newest_ns, buffers):
            yield from _frame(*waiting.popleft(), buffers, rig, counts)
    while waiting:
        yield from _frame(*waiting.popleft(), buffers, rig, counts)


def _rig_time_ns(sample: Image | Scan, rig: Rig) -> int | None:
    """Find the rig's time of a picture, or of the middle of a sweep."""
    if sample.stamp_ns is None:
        return None
    if isinstance(sample, Image):
        stamps = rig.cameras[sample.sensor].channels[sample.channel].timestamps
        return sample.stamp_ns + round(stamps.expected_offset_s * 1e9)
    lidar = rig.lidars[sample.sensor]
    sweep_ns = 1e9 / lidar.rate_hz if sample.offset_ns is None else float(sample.offset_ns.max())
    return sample.stamp_ns + round(lidar.timestamps.expected_offset_s * 1e9 + sweep_ns / 2)


def _is_due(
    time_ns: int, newest_ns: int, buffers: dict[tuple[str, str], deque[tuple[int, Image | Scan]]]
) -> bool:
    has_all_passed = bool(buffers) and all(buffer[-1][0] >= time_ns for buffer in buffers.values() if buffer)
    return newest_ns > time_ns + PATIENCE_NS or (has_all_passed and all(buffers.values()))


def _frame(
    time_ns: int,
    scan: Scan,
    buffers: dict[tuple[str, str], deque[tuple[int, Image | Scan]]],
    rig: Rig,
    counts: PairingCounts,
) -> Iterator[Frame]:
    images: list[Image] = []
    scans = [scan]
    for key in sorted(buffers):
        buffer = buffers[key]
        # What lies before the nearest sample cannot be nearest to any later scan.
        while len(buffer) > 1 and abs(buffer[1][0] - time_ns) <= abs(buffer[0][0] - time_ns):
            buffer.popleft()
        if not buffer:
            continue
        apart_ns, sample = abs(buffer[0][0] - time_ns), buffer[0][1]
        if isinstance(sample, Image):
            counts.nearest_ns = apart_ns if counts.nearest_ns is None else min(apart_ns, counts.nearest_ns)
        if apart_ns > _tolerance_ns(sample, scan, rig):
            continue
        if isinstance(sample, Image):
            images.append(sample)
        else:
            scans.append(sample)
    if images:
        yield Frame(time_ns, tuple(images), tuple(scans))
    else:
        counts.n_alone += 1


def _tolerance_ns(sample: Image | Scan, scan: Scan, rig: Rig) -> float:
    lidar = rig.lidars[scan.sensor].timestamps.tolerance_s
    if isinstance(sample, Image):
        other = rig.cameras[sample.sensor].channels[sample.channel].timestamps.tolerance_s
    else:
        other = rig.lidars[sample.sensor].timestamps.tolerance_s
    return max(lidar, other) * 1e9
