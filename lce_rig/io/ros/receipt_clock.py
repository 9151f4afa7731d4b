"""Sensors of a bag with timestamps of another clock, mapped by their times of receipt.

The recorder logs the time of receipt of each message on one clock. A message is received after its data: a
scan after its last firing, an image after its exposure.
"""

import struct
from collections.abc import Collection, Mapping
from dataclasses import replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.findings import Finding
from lce_rig.io.findings import CLOCK_BY_RECEIPT
from lce_rig.io.ros.bag_file import BagFile
from lce_rig.timing.clock import ClockModel
from lce_rig.timing.clock_fit import fit_clock

# Difference of two sensors' delays above which their clocks differ, s: longer than delays in any pipeline.
_MAX_DELAY_S = 2.0
# Messages read to find the delays, in total and per topic: raw images have megabytes.
_N_PROBED, _N_OF_TOPIC = 500, 5
# Maximum drift of a quartz clock; a larger one comes from the scatter of a few receipts.
_MAX_DRIFT = 200e-6
# Standard deviation of the unknown part of a delay: transport, and processing by the driver.
_DELAY_SIGMA_NS = 30_000_000.0
# Scatter about the line above which receipts do not follow the timestamps.
_MAX_RMS_NS = 500_000_000.0
# ROS 1 begins with the header's number, CDR with its encapsulation; both take 4 bytes.
_TIME_AT = 4

Stamps = NDArray[np.int64]


def find_foreign(bag: BagFile, topics: Collection[str], *, has_host: bool) -> list[str]:
    """List the topics with timestamps of another clock than the rest of the bag.

    If all timestamps differ from their receipts by the same time, they are on one clock, as in a bag
    re-recorded from another.

    Args:
        bag: bag in which all messages have headers.
        topics: topics of images and scans.
        has_host: whether other streams of the rig are on the recorder's clock.
    """
    stamps, receipts = _read_times(bag, topics, _N_PROBED, _N_OF_TOPIC)
    delay_s = {topic: 1e-9 * float(np.median(receipts[topic] - stamps[topic])) for topic in stamps}
    foreign = [topic for topic, delay in delay_s.items() if abs(delay) > _MAX_DELAY_S]
    delays_s = [*delay_s.values(), *([0.0] if has_host else [])]
    return foreign if delays_s and max(delays_s) - min(delays_s) > _MAX_DELAY_S else []


def fit_to_receipts(bag: BagFile, topic: str, *, is_sent_after: bool) -> ClockModel | None:
    """Fit the recorder's clock to the timestamps of a topic.

    Args:
        bag: bag with the topic.
        topic: topic of images or scans.
        is_sent_after: whether messages are sent a period after the moment that their timestamp marks: scans
            marked by their first firing.

    Returns:
        The model from the sensor's clock to the recorder's; None if receipts do not follow the timestamps.
    """
    stamps, receipts = _read_times(bag, [topic])
    if topic not in stamps:
        return None
    source_ns, host_ns = stamps[topic], receipts[topic]
    if is_sent_after and len(source_ns) > 1:
        host_ns = host_ns - round(float(np.median(np.diff(source_ns))))
    what = "receipts of messages"
    order = np.argsort(source_ns, kind="stable")
    model = fit_clock(source_ns[order], host_ns[order], what)
    if model is None or abs(model.drift) > _MAX_DRIFT:
        offset_ns = host_ns - source_ns
        centre_ns, middle_ns = int(source_ns[len(source_ns) // 2]), round(float(np.median(offset_ns)))
        rms_ns = float(np.sqrt(np.mean((offset_ns - float(middle_ns)) ** 2)))
        cov, ends = np.diag([rms_ns**2 / len(source_ns), 0.0]), (int(source_ns.min()), int(source_ns.max()))
        n = len(source_ns)
        model = ClockModel(centre_ns, centre_ns + middle_ns, 0.0, cov, 0.0, rms_ns, *ends, n, f"{n} {what}")
    return None if model.rms_ns > _MAX_RMS_NS else replace(model, bias_sigma_ns=_DELAY_SIGMA_NS)


def describe(subject: str, clock: ClockModel) -> Finding:
    """State the mapping of a sensor's clock, with its uncertainty."""
    return CLOCK_BY_RECEIPT(
        subject,
        offset_s=1e-9 * (clock.reference_ns - clock.anchor_ns),
        drift_ppm=1e6 * clock.drift,
        n=clock.n_used,
        sigma_ms=1e-6 * clock.sigma_ns(clock.anchor_ns),
    )


def _read_times(
    bag: BagFile, topics: Collection[str], n_probed: int | None = None, n_of_topic: int | None = None
) -> tuple[Mapping[str, Stamps], Mapping[str, Stamps]]:
    """Read header timestamps and receipts by topic, up to the end of the readable part."""
    times: dict[str, list[tuple[int, int]]] = {topic: [] for topic in topics}
    for message in islice(bag.messages(topics), n_probed):
        if len(message.data) >= _TIME_AT + 8:
            seconds, nanoseconds = struct.unpack_from("<II", message.data, _TIME_AT)
            if seconds or nanoseconds:
                times[message.topic].append((seconds * 10**9 + nanoseconds, message.log_ns))
        if n_of_topic is not None and all(
            len(rows) >= min(n_of_topic, bag.topics[t][1]) for t, rows in times.items()
        ):
            break
    columns = {topic: np.array(rows, np.int64).T for topic, rows in times.items() if rows}
    return {t: rows[0] for t, rows in columns.items()}, {t: rows[1] for t, rows in columns.items()}
