"""Can `check` use every capture that `collect` takes, live and from recordings?

Everything runs by the command line, so that PYTHONPATH alone decides which version of the program is judged.
"""

import json
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from benchmarks.recordings import SETS, RecordedSet
from benchmarks.tables import print_head, print_row

#: Sessions are collected here anew; recordings that are made of sets are kept.
FOLDER = Path("build/usable")
RIGS = ("rlfs", "rles")
#: One live session in so many is recorded as well, and collected again from its recording.
RECORDED_EVERY = 5
#: Recordings of a moving board with events, so long each; one of them takes minutes to simulate.
N_MOVING, MOVING_S = 3, 8
#: A set's pairs as a recording: each board stands so many scans, and they follow each other like this.
N_SCANS, SCAN_NS, AWAY_NS = 9, 100_000_000, 1_000_000_000
HANGS_S = 1800.0


def bench_usable(n_seeds: int, n_captures: int, only: str = "", first_seed: int = 0) -> None:
    """Tabulate captures taken and usable.

    Args:
        n_seeds: simulated live sessions, of each rig half.
        n_captures: wanted of each.
        only: sources whose name contains this.
        first_seed: so that a table can be made in parts.
    """
    FOLDER.mkdir(parents=True, exist_ok=True)
    print_head("source", "captures", "usable in check", "refused by check", "s")
    total: Counter[str] = Counter()
    for seed in range(first_seed, first_seed + n_seeds):
        rig = RIGS[seed % len(RIGS)]
        if only in (name := f"live {rig} {seed}"):
            _take_live(name, rig, seed, n_captures, total)
    for seed in range(first_seed, first_seed + N_MOVING):
        if only in (name := f"moving rles {seed}"):
            recording = _simulate_moving(seed)
            _take(name, total, "--rig", "rles", "--from", str(recording / "recording.bag"))
    for each in SETS:
        if each.is_there and only in (name := f"set {each.name}"):
            _take(name, total, *_as_recording(each))
    print_row("all", total["captures"], total["usable"], "", "")


def _take_live(name: str, rig: str, seed: int, n_captures: int, total: Counter[str]) -> None:
    wanted = ["--simulated", "--plain", "--frames", str(n_captures), "--seed", str(seed)]
    recording = FOLDER / f"recorded {rig} {seed}"
    shutil.rmtree(recording, ignore_errors=True)
    is_recorded = seed % RECORDED_EVERY == 0
    _take(name, total, "--rig", rig, *wanted, *(["--record", str(recording)] if is_recorded else []))
    if is_recorded:
        _take(f"{name}, --record", total, "--rig", rig, "--from", str(recording))
        shutil.rmtree(recording, ignore_errors=True)


def _take(name: str, total: Counter[str], *arguments: str) -> None:
    """Collect a session, check it, and print a row."""
    session = FOLDER / name
    shutil.rmtree(session, ignore_errors=True)
    began_s = time.monotonic()
    _run("collect", *arguments, str(session))
    took_s = time.monotonic() - began_s
    said = _run("check", "--json", str(session))
    captures = [
        (capture, record)
        for pair in (json.loads(said)["pairs"] if said.startswith("{") else ())
        for capture, record in pair["captures"].items()
    ]
    refused = [
        f"{capture}: {record['refusal'].get('code', record['refusal']['cause'])}"
        for capture, record in captures
        if not record["is_usable"]
    ]
    n_usable = len(captures) - len(refused)
    total.update(captures=len(captures), usable=n_usable)
    print_row(name, len(captures), n_usable, "; ".join(refused) or "-", f"{took_s:.0f}")


def _simulate_moving(seed: int) -> Path:
    """Simulate a recording of a moving board with its events, or take the one that is there."""
    folder = FOLDER / f"recording rles {seed}"
    if not folder.is_dir():
        made = "--recording", str(folder), "--duration", str(MOVING_S), "--seed", str(seed)
        _run("simulate", "--rig", "rles", *made)
    return folder


def _as_recording(each: RecordedSet) -> list[str]:
    """Write a set's pairs as a bag in which each board stands still for a second, for the same rig."""
    from lce_rig.core.data import Image, Scan
    from lce_rig.io.ros.bag_recorder import BagRecorder
    from lce_rig.session import Session

    pairs, bag = FOLDER / f"pairs {each.name}", FOLDER / f"{each.name}.bag"
    if not bag.exists():
        shutil.rmtree(pairs, ignore_errors=True)
        each.collect(pairs)
        rig = (session := Session.open(pairs)).rig

        def samples() -> Iterator[Image | Scan]:
            stamp_ns = 1_700_000_000_000_000_000
            for capture in session.captures:
                channels = {key: rig.cameras[key[0]].channels[key[1]] for key in capture.image_keys}
                frames = [key for key, channel in channels.items() if channel.kind == "frames"]
                for _ in range(N_SCANS if frames else 0):
                    middle_ns = stamp_ns + SCAN_NS // 2
                    for key in frames:
                        yield replace(capture.image(*key), stamp_ns=middle_ns, host_ns=middle_ns)
                    for lidar in capture.lidars:
                        scan = replace(capture.scan(lidar), stamp_ns=stamp_ns, host_ns=stamp_ns + SCAN_NS)
                        yield scan
                    stamp_ns += SCAN_NS
                stamp_ns += AWAY_NS

        with BagRecorder(bag, rig) as recorder:
            for sample in samples():
                recorder.write(sample)
    return ["--rig", each.rig, "--from", str(bag)]


def _run(*arguments: str) -> str:
    """Run lce-rig and give what it printed on stdout."""
    done = subprocess.run(
        [sys.executable, "-m", "lce_rig", *arguments],
        capture_output=True,
        text=True,
        timeout=HANGS_S,
        stdin=subprocess.DEVNULL,
        check=False,
    )
    return done.stdout
