#!/usr/bin/env python3
"""Measure what docs/benchmarks.md claims and print it as Markdown tables.

    scripts/bench.py real        recordings by others, in the folder that LCE_RIG_DATA names
    scripts/bench.py simulated   boards held still: error against exact truth over many seeds
    scripts/bench.py events      boards moved before an event camera: the same, frames against events
    scripts/bench.py intrinsics  stale intrinsics: how often they are found
    scripts/bench.py guidance    a person who follows the guidance against random placements
    scripts/bench.py paper       the experiments of the LCE-Calib paper: tables and figures, every method
    scripts/bench.py faults      sessions with faults: how many wrong results pass
    scripts/bench.py goes_on     collections on the simulated rig: do all end with --captures?
    scripts/bench.py corruptions  sessions that are wrong as a whole: verdict, error and reported uncertainty
    scripts/bench.py live        live collection under load, over real transports, for --seconds
    scripts/bench.py offline     a bag of VLP-16 and 1280x720 at 30 Hz, of --seconds, collected from
    scripts/bench.py usable      are captures that are taken usable? live sessions, --record, recordings
    scripts/bench.py uncertainty  the joint estimate: errors against their bound, truth of its claim
    scripts/bench.py scene       extrinsics checked without a board, on recordings by others
    scripts/bench.py drift_inputs  bad input to drift: is any an all-clear? a bag of a minute: time, memory
    scripts/bench.py scene_methods  the scene's score compared with published ones, on the same recordings
    scripts/bench.py scene_sharpen  boards and scene in one estimate: simulated rooms, recordings
    scripts/bench.py witness     the scene beside the boards: good results refused, wrong ones found
    scripts/bench.py outputs     every output read by other programs: where they draw the same points
    scripts/bench.py lidars      other LiDARs, simulated: boards found, errors, time of a scan's search
    scripts/bench.py growth      calibrate after detection as sessions grow: time and memory
    scripts/bench.py fleet       500 sessions of 60 robots; lost workers, broken sessions, a million rows, S3
    scripts/bench.py speed       detection, Algorithm 1, the command line

Simulated boards are kept, as long as neither simulator nor detectors change; random choices are seeded. Run
it on a machine that does nothing else.
"""

import argparse
from importlib import import_module
from pathlib import Path

# Part -> module, and how many simulated sessions it takes by default.
PARTS = {
    "real": 0,
    "simulated": 20,
    "events": 10,
    "intrinsics": 20,
    "guidance": 20,
    "paper": 20,
    "faults": 100,
    "corruptions": 0,
    "uncertainty": 100,
    "goes_on": 10,
    "live": 0,
    "offline": 0,
    "usable": 20,
    "scene": 0,
    "drift_inputs": 0,
    "scene_methods": 0,
    "scene_sharpen": 100,
    "witness": 20,
    "outputs": 0,
    "lidars": 0,
    "growth": 0,
    "fleet": 0,
    "speed": 0,
}


def main() -> None:
    """Run the part asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=list(PARTS))
    parser.add_argument("--seeds", type=int, help="simulated sessions (default 20, of moving boards 10)")
    parser.add_argument("--splits", type=int, default=20, help="random split halves (default 20)")
    parser.add_argument(
        "--only", default="", help="sets whose name contains this; of `paper` also: simulated"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path("build/paper"),
        help="folder of `paper`, and of what `uncertainty`, `lidars`, `growth` and `fleet` keep",
    )
    parser.add_argument(
        "--captures",
        type=int,
        help="of a session of `uncertainty` (default 30), `goes_on` and `lidars` (20), `usable` (5)",
    )
    parser.add_argument("--first-seed", type=int, default=0, help="of `goes_on` and `usable` (default 0)")
    parser.add_argument(
        "--methods",
        default="",
        help="those `paper` runs anew (default: what is not kept); that of `real` (ml)",
    )
    parser.add_argument(
        "--scans", type=int, default=100, help="simulated sessions that `faults` draws from (100)"
    )
    parser.add_argument("--seconds", type=float, help="that `live` takes (60), of the bag of `offline` (15)")
    arguments = parser.parse_args()
    bench = getattr(import_module(f"benchmarks.{arguments.part}"), f"bench_{arguments.part}")
    if arguments.part == "real":
        bench(arguments.splits, arguments.only, arguments.methods or "ml")
    elif arguments.part == "paper":
        methods = arguments.methods.split(",") if arguments.methods else ()
        bench(arguments.seeds or PARTS["paper"], arguments.output, methods, arguments.only)
    elif arguments.part == "uncertainty":
        bench(
            arguments.seeds or PARTS["uncertainty"],
            arguments.output,
            arguments.only,
            arguments.captures or 30,
        )
    elif arguments.part == "goes_on":
        seeds = arguments.seeds or PARTS["goes_on"]
        bench(seeds, arguments.captures or 20, arguments.only, arguments.first_seed)
    elif arguments.part == "usable":
        seeds = PARTS["usable"] if arguments.seeds is None else arguments.seeds
        bench(seeds, arguments.captures or 5, arguments.only, arguments.first_seed)
    elif arguments.part == "faults":
        bench(arguments.seeds or PARTS["faults"], n_sessions=arguments.scans)
    elif arguments.part in ("scene", "scene_methods"):
        bench(min(arguments.splits, 2), arguments.only)
    elif arguments.part == "scene_sharpen":
        seeds = arguments.seeds or PARTS["scene_sharpen"]
        bench(seeds, min(arguments.splits, 10), arguments.only)
    elif arguments.part == "witness":
        bench(arguments.seeds or PARTS["witness"], arguments.only)
    elif arguments.part == "lidars":
        bench(arguments.captures or 20, arguments.output, arguments.only)
    elif arguments.part == "growth":
        bench(arguments.output)
    elif arguments.part == "fleet":
        bench(arguments.output, arguments.only)
    elif arguments.part == "corruptions":
        bench(arguments.only)
    elif arguments.part == "live":
        bench(arguments.seconds or 60.0)
    elif arguments.part == "offline":
        bench(arguments.seconds or 15.0)
    elif arguments.part in ("speed", "drift_inputs", "outputs"):
        bench()
    else:
        bench(arguments.seeds or PARTS[arguments.part])


if __name__ == "__main__":
    main()
