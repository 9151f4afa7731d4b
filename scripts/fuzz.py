#!/usr/bin/env python3
"""Kill the program, or give it hostile inputs, and print as JSON what went wrong.

    scripts/fuzz.py kills --n 200               `collect`, killed while it captures
    scripts/fuzz.py result-kills --n 200        `calibrate`, `verify`, `intrinsics`, killed
    scripts/fuzz.py deploy-kills --n 200        `deploy`, killed, into a folder and over ssh
    scripts/fuzz.py interrupts --n 100          Ctrl-C at any moment of any verb
    scripts/fuzz.py inputs                      hostile files, links and pipes as inputs
    scripts/fuzz.py mutations --n 1000          files with random damage as inputs

Exits with 1 if anything was lost. CONTRIBUTING.md describes the checks.
"""

import argparse
import json
import sys
from importlib import import_module
from pathlib import Path

# The stand-ins of devices: tests/wire.
sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

TARGETS = {
    "kills": ("fuzzing.kills:fuzz_kills", 200, "a live collection, killed"),
    "result-kills": ("fuzzing.result_kills:fuzz_result_kills", 200, "verbs killed about their results"),
    "deploy-kills": ("fuzzing.deploy_kills:fuzz_deploy_kills", 200, "deployments, killed"),
    "interrupts": ("fuzzing.interrupts:fuzz_interrupts", 100, "Ctrl-C at any moment"),
    "inputs": ("fuzzing.inputs:fuzz_inputs", 100, "hostile files, links and pipes as inputs"),
    "mutations": ("fuzzing.mutations:fuzz_mutations", 1000, "files with random damage as inputs"),
}
"""By name: a function of (n, seed) whose report has `n_wrong`; the default n; help."""


def main() -> None:
    """Run one target."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    targets = parser.add_subparsers(dest="target", required=True, metavar="TARGET")
    for name, (_, n, text) in TARGETS.items():
        target = targets.add_parser(name, help=text)
        target.add_argument("--n", type=int, default=n, help=f"kills or inputs (default {n})")
        target.add_argument("--seed", type=int, default=0, help="of the moments (default 0)")
    arguments = parser.parse_args()
    module, function = TARGETS[arguments.target][0].split(":")
    report = getattr(import_module(module), function)(arguments.n, arguments.seed)
    print(json.dumps(vars(report), indent=2, default=str))
    sys.exit(report.n_wrong > 0)


if __name__ == "__main__":
    main()
