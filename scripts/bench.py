#!/usr/bin/env python3
"""Measure what docs/benchmarks.md claims and print it as Markdown tables.

    scripts/bench.py real        recordings by others, in the folder that LCE_RIG_DATA names
    scripts/bench.py simulated   boards held still: error against exact truth over many seeds
    scripts/bench.py events      boards moved before an event camera: the same, frames against events
    scripts/bench.py speed       detection, Algorithm 1, the command line

Detections are made anew; random choices are seeded. Run it on a machine that does nothing else.
"""

import argparse


def main() -> None:
    """Run the part asked for."""
    from benchmarks.events import bench_events
    from benchmarks.real import bench_real
    from benchmarks.simulated import bench_simulated
    from benchmarks.speed import bench_speed

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=["real", "simulated", "events", "speed"])
    parser.add_argument("--seeds", type=int, help="simulated sessions (default 20, of moving boards 10)")
    parser.add_argument("--splits", type=int, default=20, help="random split halves (default 20)")
    parser.add_argument("--only", default="", help="recorded sets whose name contains this")
    arguments = parser.parse_args()
    if arguments.part == "real":
        bench_real(arguments.splits, arguments.only)
    elif arguments.part == "simulated":
        bench_simulated(arguments.seeds or 20)
    elif arguments.part == "events":
        bench_events(arguments.seeds or 10)
    else:
        bench_speed()


if __name__ == "__main__":
    main()
