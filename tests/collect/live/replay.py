"""Simulated placements, shown to a live collection one after the other in real time."""

import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

from lce_rig.collect.live.simulated import SimulatedSource
from lce_rig.rig import load_rig
from lce_rig.simulate import simulate_captures
from tests.shared import compute_once

PERIOD_NS = 100_000_000


@cache
def rig():
    """Load the shipped event rig; its small images are searched quickly."""
    return load_rig("rles")


@cache
def placements(n=4, seed=5):
    """Simulate boards held still."""
    name = f"placements_{n}_{seed}"
    return compute_once(name, lambda: tuple(simulate_captures(rig(), n_captures=n, seed=seed)))


class Show:
    """Shows captures to two sources, each for a while, stamped as if they were taken now."""

    def __init__(self, captures, each_s):
        self.sources = [SimulatedSource("davis"), SimulatedSource("lidar")]
        self.stamps = [[] for _ in captures]
        self._captures = captures
        self._each_s = each_s
        self._stop = threading.Event()

    @contextmanager
    def running(self):
        thread = threading.Thread(target=self._run, daemon=True)
        thread.start()
        try:
            yield self
        finally:
            self._stop.set()
            thread.join()

    def _run(self):
        began_s = due_s = time.monotonic()
        while not self._stop.is_set():
            k = int((due_s - began_s) / self._each_s) % len(self._captures)
            self.send(k, time.time_ns() - PERIOD_NS)
            due_s += 0.1
            self._stop.wait(max(0.0, due_s - time.monotonic()))

    def pause(self):
        """Send nothing more."""
        self._stop.set()

    def send(self, k, stamp_ns):
        """Send a placement's picture and scan."""
        capture = self._captures[k]
        image = replace(capture.images[0], stamp_ns=stamp_ns + PERIOD_NS // 2, host_ns=stamp_ns + PERIOD_NS)
        self.sources[0].put(image)
        self.sources[1].put(replace(capture.scans[0], stamp_ns=stamp_ns, host_ns=stamp_ns + PERIOD_NS))
        self.stamps[k].append(stamp_ns)
