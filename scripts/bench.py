#!/usr/bin/env python3
"""Measure what docs/benchmarks.md claims and print it as Markdown tables.

--record writes the figures that pages show into docs/figures.json and fills the pages from it. Figures
of scripts/fuzz.py and of `time` are entered in that file by hand.

Simulated boards are cached until simulator or detectors change; random choices are seeded. Run it on an idle
machine. Parts that read recordings by others need their folder in LCE_RIG_DATA.
"""

import argparse
import os
import shlex
import subprocess
import sys
from collections.abc import Callable
from datetime import datetime, timezone
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks.measured import MEASURED
from figures_page import fill_pages, read_figures, shown_keys, write_figures

# The stand-ins of devices, tests/wire, and simulated scans, tests/detect.
_TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path += [str(_TESTS), str(_TESTS / "detect")]

Part = Callable[[Any, argparse.Namespace], None]
PARTS: dict[str, tuple[str, Part]] = {
    "real": (
        "recordings by others: references, halves, channels",
        lambda bench, a: bench(a.splits, a.only, a.methods or "ml"),
    ),
    "sessions": ("recordings of one rig: what moved between them", lambda bench, _: bench()),
    "simulated": ("boards held still: error against exact truth", lambda bench, a: bench(a.seeds or 20)),
    "events": ("boards moved before an event camera, the same", lambda bench, a: bench(a.seeds or 10)),
    "intrinsics": ("stale intrinsics: how often they are found", lambda bench, a: bench(a.seeds or 20)),
    "paper": (
        "the paper's simulated experiment, ten levels of noise",
        lambda bench, a: bench(a.seeds or 20, a.output),
    ),
    "corruptions": (
        "sessions that are wrong as a whole: verdict, first cause, error",
        lambda bench, a: bench(a.only, a.kinds, a.methods, a.jobs, a.draws),
    ),
    "uncertainty": (
        "the joint estimate: errors against their bound, coverage of its claim",
        lambda bench, a: bench(a.seeds or 100, a.output, a.only, a.captures or 30),
    ),
    "wrong_profiles": (
        "profiles with a wrong focal length, principal point or squares",
        lambda bench, a: bench(a.seeds or 6, a.output, a.captures or 16),
    ),
    "live": ("live collection under load, over real transports", lambda bench, a: bench(a.seconds or 60.0)),
    "offline": ("a bag of VLP-16 and 1280x720 at 30 Hz", lambda bench, a: bench(a.seconds or 15.0)),
    "scene": (
        "extrinsics checked without a board, on recordings by others",
        lambda bench, a: bench(min(a.splits, 2), a.only),
    ),
    "scene_estimate": (
        "extrinsics from a scene without a board: errors, coverage, changes seen, for KITTI's views",
        lambda bench, a: bench(a.seeds or 100, a.only),
    ),
    "scene_sim": (
        "the same for simulated rooms and streets, three LiDARs",
        lambda bench, a: bench(a.seeds or 15, a.only),
    ),
    "borders": (
        "boards in scans whose border is hidden, smeared or merges with a stand, simulated",
        lambda bench, a: bench(a.captures or 50, a.only),
    ),
    "fleet": ("sessions of many robots", lambda bench, a: bench(a.output, a.only)),
    "speed": ("detection, estimate, the command line", lambda bench, _: bench()),
}


def main() -> None:
    """Run the part asked for."""
    parts = "\n".join(f"  {name:14} {what}" for name, (what, _) in PARTS.items())
    parser = argparse.ArgumentParser(
        description=f"{__doc__}\nparts:\n{parts}", formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=list(PARTS), metavar="PART")
    parser.add_argument("--seeds", type=int, help="simulated sessions")
    parser.add_argument("--splits", type=int, default=20, help="random split halves (default 20)")
    parser.add_argument("--only", default="", help="sets whose name contains this")
    parser.add_argument(
        "--methods", help="ml or paper, of `real` (default ml) and of `corruptions` (default both)"
    )
    parser.add_argument("--kinds", default="", help="of `corruptions`: those whose name contains this")
    parser.add_argument("--jobs", type=int, default=1, help="of `corruptions`: processes (default 1)")
    parser.add_argument(
        "--draws", type=int, default=0, help="of `corruptions`: random halves of sound sessions instead"
    )
    parser.add_argument("--captures", type=int, help="captures of a simulated session")
    parser.add_argument("--seconds", type=float, help="of `live` (60) and of the bag of `offline` (15)")
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("build/bench"), help="folder of simulated sessions"
    )
    parser.add_argument(
        "--record", action="store_true", help="write the figures into docs/figures.json and the pages"
    )
    arguments = parser.parse_args()
    bench = getattr(import_module(f"benchmarks.{arguments.part}"), f"bench_{arguments.part}")
    PARTS[arguments.part][1](bench, arguments)
    if arguments.record:
        record(_command(sys.argv[1:]))


def _command(words: list[str]) -> str:
    """Return the command as typed, without folders of this computer."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--record", action="store_true")
    parser.add_argument("-o", "--output")
    _, kept = parser.parse_known_args(words)
    data = "LCE_RIG_DATA=... " if os.environ.get("LCE_RIG_DATA") else ""
    return data + shlex.join(["scripts/bench.py", *kept])


def record(command: str) -> None:
    """Write the measured figures that pages show, with the command, and fill the pages."""
    state = ["git", "-C", str(_TESTS.parent), "describe", "--always", "--dirty", "--exclude", "*"]
    commit = subprocess.run(state, check=True, capture_output=True, text=True).stdout.strip()
    figures, day = read_figures(), datetime.now(timezone.utc).date().isoformat()
    for key in shown_keys() & MEASURED.keys():
        value, unit = MEASURED[key]
        source = {"command": command, "measured": day, "commit": commit}
        figures[key] = {"value": value, "unit": unit, **source}
    write_figures(figures)
    fill_pages()


if __name__ == "__main__":
    main()
