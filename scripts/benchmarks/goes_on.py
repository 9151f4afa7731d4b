"""Does a collection that is asked for N captures get them? Guides alone, and the simulated rig as a whole.

A guide alone is followed without images: the board is where the person holds it, and both sensors see it
wherever nothing is in the way. That takes a second for what takes minutes on the simulated rig.
"""

import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.tables import print_head, print_row
from lce_rig.collect.guidance import HeldPose, Novelty, Person, SensorPlace, build_pose, model_sensors
from lce_rig.collect.live.guide import Guide, make_guides
from lce_rig.core.geometry import Array, rotation_angle
from lce_rig.rig import Rig, load_rig
from lce_rig.session import Session

RIGS = ("rlfs", "rles")
#: Sessions of the simulated rig are collected here anew.
FOLDER = Path("build/goes_on")
#: One of them is ended after so long: it hangs.
HANGS_S = 3600.0
# The simulated person tries again after so long; longer than that a walk seldom takes.
_TRY_S = 7.0
_ENDED = "ended: "
_VERDICTS = ("PASS", "WARN", "FAIL")
_KEPT = ("uncertainty", "reference")
#: A placement nearer than both to a capture is not new.
NEW_M, NEW_DEG = Novelty().min_move_m, Novelty().min_turn_deg


@dataclass
class Followed:
    """How a person followed a guide.

    Attributes:
        captured: (4, 4) each.
        proposed: (4, 4) each, with what was held when it was.
        n_refused: placements that were refused.
        simulated_s: how long it took them.
    """

    captured: list[Array] = field(default_factory=list)
    proposed: list[tuple[Array, int]] = field(default_factory=list)
    n_refused: int = 0
    simulated_s: float = 0.0

    def nearest(self) -> list[tuple[float, float]]:
        """Measure how far each proposal was from the nearest capture before it, m and deg."""
        return [min(_apart(T, held) for held in self.captured[:n]) for T, n in self.proposed if n]


def bench_goes_on(n_seeds: int, n_captures: int = 20, only: str = "", first_seed: int = 0) -> None:
    """Tabulate guides alone, then the simulated rig by the command line.

    Args:
        n_seeds: sessions of each rig.
        n_captures: wanted of each; guides alone also twice as many.
        only: rigs whose name contains this.
        first_seed: so that a table can be made in parts.
    """
    names, seeds = [name for name in RIGS if only in name], range(first_seed, first_seed + n_seeds)
    print_head("rig", "seeds", "wanted", "captures", "placements proposed", "of them not new", "refused", "s")
    for name in names:
        for n_wanted in (n_captures, 2 * n_captures):
            print_followed(name, seeds, n_wanted)
    print()
    print_head("rig", "seed", "captures", "s", "of a processor, s", "exit code", "ended", "calibrated")
    for name in names:
        for seed in seeds:
            print_collected(name, seed, n_captures)


def print_followed(name: str, seeds: Sequence[int], n_wanted: int) -> None:
    """Follow the guide of a rig with many persons, and print a row."""
    began_s = time.monotonic()
    walks = [follow_guide(load_rig(name), n_wanted, seed) for seed in seeds]
    n_held = [len(walk.captured) for walk in walks]
    n_like = sum(way_m < NEW_M and turn_deg < NEW_DEG for walk in walks for way_m, turn_deg in walk.nearest())
    print_row(
        name,
        len(seeds),
        n_wanted,
        f"{min(n_held)} to {max(n_held)}",
        sum(len(walk.proposed) for walk in walks),
        n_like,
        sum(walk.n_refused for walk in walks),
        f"{time.monotonic() - began_s:.0f}",
    )


def follow_guide(
    rig: Rig,
    n_wanted: int,
    seed: int = 0,
    person: Person | None = None,
    can_be_held: Callable[[Array], bool] = lambda _T_cam_board: True,
    patience_s: float = 600.0,
) -> Followed:
    """Follow a rig's first guide until there are as many captures as wanted, or none for long.

    Args:
        rig: the profile.
        n_wanted: captures.
        seed: of the person.
        person: who follows.
        can_be_held: tells where nothing is in the way of T_cam_board (4, 4).
        patience_s: simulated time without a capture after which it ends.
    """
    guide, view = make_guides(rig)[0], first_view(rig)
    person, rng, walk = person or Person(), np.random.default_rng(seed), Followed()
    present = build_pose(view, HeldPose(0.0, 2.5, 0.0, 0.0, 0.0, 45.0))
    captured_s = 0.0
    while len(walk.captured) < n_wanted and walk.simulated_s - captured_s < patience_s:
        _ask(guide, present, walk)
        walk.simulated_s += _TRY_S
        if guide.wanted is None:
            continue
        reached = person.follow(view, present, guide.wanted, rng)
        if not can_be_held(reached):
            continue
        present = reached
        if guide.adds_nothing(present) is not None:
            walk.n_refused += 1
            guide.note_refusal(present)
            continue
        guide.add(f"{len(walk.captured):06d}", present)
        walk.captured.append(present)
        captured_s = walk.simulated_s
    return walk


def first_view(rig: Rig) -> SensorPlace:
    """Look through a rig's first camera as its drawing has it."""
    camera, lidar = next(iter(rig.cameras)), next(iter(rig.lidars))
    nominal = rig.nominal(camera, lidar)
    assert nominal is not None
    return SensorPlace.upright(model_sensors(rig, camera, lidar), nominal.to_matrix())


def _ask(guide: Guide, present: Array, walk: Followed) -> None:
    """Let the guide plan, and note what it newly proposes."""
    before = guide.wanted
    guide.plan(present, walk.simulated_s)
    if guide.wanted is not None and guide.wanted is not before:
        walk.proposed.append((guide.wanted, len(walk.captured)))


def _apart(T_1: Array, T_2: Array) -> tuple[float, float]:
    # The pattern may be read from either end.
    flipped = T_1[:3, :3] @ np.diag([-1.0, -1.0, 1.0])
    turn_rad = min(float(rotation_angle(R, T_2[:3, :3])) for R in (T_1[:3, :3], flipped))
    return float(np.linalg.norm(T_1[:3, 3] - T_2[:3, 3])), float(np.degrees(turn_rad))


def print_collected(name: str, seed: int, n_captures: int) -> None:
    """Collect on the simulated rig by the command line, calibrate, and print a row."""
    path = FOLDER / f"{name}_{seed}"
    if path.exists():
        shutil.rmtree(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    began_s, before_s = time.monotonic(), _processor_s()
    wanted = ["--frames", str(n_captures), "--seed", str(seed)]
    code, said = _run("collect", "--rig", name, str(path), "--simulated", "--plain", *wanted)
    took_s, used_s = time.monotonic() - began_s, _processor_s() - before_s
    ending = next((line for line in said.splitlines() if line.startswith(_ENDED)), "-").removeprefix(_ENDED)
    n_held = len(Session.open(path).captures) if path.exists() else 0
    told = "hangs" if code is None else code
    print_row(name, seed, n_held, f"{took_s:.0f}", f"{used_s:.0f}", told, ending, _judge(path))


def _judge(path: Path) -> str:
    """Calibrate a session and compare it with the truth: verdicts and errors, or the exit code."""
    code, said = _run("calibrate", str(path), "--reference", str(path / "truth.json"))
    lines = [" ".join(line.split()) for line in said.splitlines()]
    kept = [line for line in lines if line.endswith(_VERDICTS) or line.startswith(_KEPT)]
    return "; ".join(kept) or f"exit code {code}"


def _run(*arguments: str) -> tuple[int | None, str]:
    """Run lce-rig: its exit code, None where it hangs, and all that it said."""
    command = [sys.executable, "-m", "lce_rig", *arguments]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=HANGS_S, stdin=subprocess.DEVNULL, check=False
        )
    except subprocess.TimeoutExpired:
        return None, ""
    return done.returncode, done.stdout + done.stderr


def _processor_s() -> float:
    """Tell how much of a processor the programs run so far have used."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
