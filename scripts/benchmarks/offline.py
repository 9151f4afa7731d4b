"""How fast a bag of a VLP-16 and a camera of 1280x720 at 30 Hz is collected from."""

import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.measured import measure
from benchmarks.tables import print_head, print_row
from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import pose
from lce_rig.io.ros.bag_recorder import BagRecorder
from lce_rig.rig import load_rig
from lce_rig.session import Session
from lce_rig.simulate import SimulationOptions
from lce_rig.simulate.live_scene import LiveScene
from lce_rig.simulate.stage import PLACEMENT

FOLDER = Path("build/offline")
_RIG, _SEED = "rlfs", 0
_START_NS = 1_700_000_000_000_000_000
_SCAN_NS, _IMAGES_PER_SCAN = 100_000_000, 3
#: Time for which the board is held, is moved, and is out of sight after every third placement, s.
_HELD_SCANS, _WALK_SCANS, _AWAY_SCANS, _PLACES_PER_ROUND = 20, 15, 15, 3
#: Out of every sensor's sight.
_DOWN_M = 1000.0


def bench_offline(duration_s: float) -> None:
    """Tabulate the duration of `collect --from`, and its captures.

    Args:
        duration_s: of the bag, which is simulated first and kept.
    """
    bag = FOLDER / f"{duration_s:g}s.bag"
    if not bag.exists():
        FOLDER.mkdir(parents=True, exist_ok=True)
        unfinished = bag.with_suffix(".part.bag")
        unfinished.unlink(missing_ok=True)
        with BagRecorder(unfinished, load_rig(_RIG)) as recorder:
            for sample in _samples(round(1e9 * duration_s)):
                recorder.write(sample)
        unfinished.rename(bag)
    session = FOLDER / "session"
    shutil.rmtree(session, ignore_errors=True)
    before, began_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    command = [sys.executable, "-m", "lce_rig", "collect", "--rig", _RIG, "--from", str(bag), str(session)]
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    took_s, used = time.monotonic() - began_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    processor_s = used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
    measure("offline.time", "{:.1f} s for a bag of {:.0f} s", took_s, duration_s)
    print_head("what", "figure")
    print_row("bag", f"{duration_s:.1f} s, {bag.stat().st_size / 1e6:.0f} MB")
    print_row("captures", len(Session.open(session).captures))
    print_row("time", f"{took_s:.1f} s")
    print_row("of processors", f"{processor_s:.1f} s")
    print_row("times real time", f"{duration_s / took_s:.2f}")
    print_row("load before", f"{os.getloadavg()[0]:.1f}")


def _samples(duration_ns: int) -> Iterator[Image | Scan]:
    """Simulate boards that are held, carried on and taken away."""
    scene = LiveScene(load_rig(_RIG), _SEED, SimulationOptions.for_rig(_RIG))
    stamps = range(_START_NS, _START_NS + duration_ns, _SCAN_NS)
    for stamp_ns, _ in zip(stamps, _board(scene), strict=False):
        for k in range(_IMAGES_PER_SCAN):
            image_ns = stamp_ns + (2 * k + 1) * _SCAN_NS // (2 * _IMAGES_PER_SCAN)
            yield from scene.take_images(image_ns)
        yield from scene.take_scans(stamp_ns)


def _board(scene: LiveScene) -> Iterator[None]:
    """Put the board where it is in each scan."""
    stage, place = scene.stage, 0
    here = stage.place(place, stage.rng(place, PLACEMENT))
    while True:
        place += 1
        scene.hold(here)
        yield from (None for _ in range(_HELD_SCANS))
        if place % _PLACES_PER_ROUND == 0:
            scene.hold(pose(here[:3, :3], here[:3, 3] - [0.0, 0.0, _DOWN_M]))
            yield from (None for _ in range(_AWAY_SCANS))
        there = stage.place(place, stage.rng(place, PLACEMENT))
        for k in range(_WALK_SCANS):
            scene.pass_by(here, there, (k + 0.5) / _WALK_SCANS)
            yield
        here = there
