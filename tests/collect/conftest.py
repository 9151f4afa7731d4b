"""Simulated placements of a board, shown one after the other as in a recording."""

from dataclasses import replace

import pytest

from lce_rig.io.ros.bag_recorder import BagRecorder
from tests.collect.live import replay

T0_NS = 1_700_000_000 * 10**9
STEP_NS = 100_000_000


def frames(order, lag_ns=0):
    """One scan and, at its middle plus `lag_ns`, one picture of each placement in turn, at 10 Hz."""
    for k, index in enumerate(order):
        capture, stamp_ns = replay.placements()[index], T0_NS + k * STEP_NS
        yield replace(capture.scans[0], stamp_ns=stamp_ns, host_ns=None)
        image_ns = stamp_ns + STEP_NS // 2 + lag_ns
        yield replace(capture.images[0], stamp_ns=image_ns, host_ns=None)


@pytest.fixture(scope="session")
def rig():
    return replay.rig()


@pytest.fixture(scope="session")
def write_bag(rig):
    """Write a bag of placements on the profile's topics."""

    def write(path, order, lag_ns=0):
        with BagRecorder(path, rig) as recorder:
            for sample in sorted(frames(order, lag_ns), key=lambda sample: sample.stamp_ns or 0):
                recorder.write(sample)
        return path

    return write
