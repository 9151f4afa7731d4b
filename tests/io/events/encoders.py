"""Small encoders for the formats that cameras and drivers write, one event after the other."""

import struct

import numpy as np

from lce_rig.core.data import Events

Event = tuple[int, int, int, bool]
"""t_us, x, y, polarity."""


def listed(events):
    t_us = events.t_ns // 1000
    return list(
        zip(t_us.tolist(), events.x.tolist(), events.y.tolist(), events.polarity.tolist(), strict=True)
    )


def everything(recording):
    """List all events of a recording."""
    return [event for stretch in recording for event in listed(stretch)]


def random_events(n, seed, size=(346, 260), start_us=0, step_us=20):
    """Events in order, some with equal stamps, neighbours in runs so that vectors have something to pack."""
    rng = np.random.default_rng(seed)
    steps_us = rng.integers(0, step_us, n) * (rng.random(n) < 0.4)
    x, y = rng.integers(0, size[0], n), rng.integers(0, size[1], n)
    in_run = rng.random(n) < 0.5
    steps_us[1:][in_run[1:]] = 0
    t_us = start_us + np.cumsum(steps_us)
    for i in range(1, n):
        if in_run[i]:
            x[i], y[i] = min(x[i - 1] + rng.integers(1, 4), size[0] - 1), y[i - 1]
    polarity = rng.random(n) < 0.5
    return Events("events", t_us * 1000, x.astype(np.uint16), y.astype(np.uint16), polarity, *size)


def evt3(events, with_vectors=True):
    """Prophesee's EVT3; runs in a row become a base and vectors of 12 and 8."""
    words = []
    high = low = row = -1
    for (t, x, y, p), mask in _spans(events, 20 if with_vectors else 1):
        if t >> 12 != high:
            high = t >> 12
            words.append(8 << 12 | high & 0xFFF)
            low = -1
        if t & 0xFFF != low:
            low = t & 0xFFF
            words.append(6 << 12 | low)
        if y != row:
            row = y
            words.append(y)
        if mask == 1:
            words.append(2 << 12 | int(p) << 11 | x)
        else:
            words.append(3 << 12 | int(p) << 11 | x)
            words.append(4 << 12 | mask & 0xFFF)
            if mask >> 12:
                words.append(5 << 12 | mask >> 12)
    return struct.pack(f"<{len(words)}H", *words)


def libcaer_cmp(events, base_us):
    """The ROS driver's compressed DAVIS events; runs in a column become a base and vectors of 8."""
    words = []
    high = low = column = -1
    swapped = [(t, y, x, p) for t, x, y, p in events]
    for (t, y, x, p), mask in _spans(swapped, 16):
        t -= base_us
        if t >> 12 != high:
            high = t >> 12
            words.append(high)
            low = -1
        if t & 0xFFF != low:
            low = t & 0xFFF
            words.append(1 << 12 | low)
        if x != column:
            column = x
            words.append(2 << 12 | x)
        if mask == 1:
            words.append(3 << 12 | int(p) << 11 | y)
        else:
            words += [4 << 12 | int(p) << 11 | y, 5 << 12 | mask & 0xFF, 5 << 12 | mask >> 8]
    return struct.pack(f"<{len(words)}H", *words)


def packet(payload, encoding, *, is_ros1, number=0, base_ns=0, stamp_ns=0, size=(346, 260)):
    """An event_camera_msgs/EventPacket."""
    message = b"" if is_ros1 else b"\0\1\0\0"

    def add(kind, value):
        nonlocal message
        if not is_ros1:
            message += bytes(-(len(message) - 4) % struct.calcsize(kind))
        message += struct.pack(f"<{kind}", value)

    def add_text(text):
        nonlocal message
        data = text.encode() + (b"" if is_ros1 else b"\0")
        add("I", len(data))
        message += data

    if is_ros1:
        add("I", number)
    add("I", stamp_ns // 10**9)
    add("I", stamp_ns % 10**9)
    add_text("camera")
    add("I", size[1])
    add("I", size[0])
    add("Q", number)
    add("Q", base_ns)
    add_text(encoding)
    add("B", 0)
    add("I", len(payload))
    return message + payload


def _spans(events, width):
    """Gather events of one stamp, row and polarity whose columns rise within `width` into a mask."""
    i = 0
    while i < len(events):
        t, x, y, p = events[i]
        mask, last = 1, x
        i += 1
        while i < len(events):
            t2, x2, y2, p2 = events[i]
            if (t2, y2, p2) != (t, y, p) or not last < x2 < x + width:
                break
            mask, last = mask | 1 << (x2 - x), x2
            i += 1
        yield (t, x, y, p), mask
