#!/usr/bin/env python3
"""Feed hostile input to what reads from devices, and print what became of it as JSON.

    scripts/fuzz.py vlp16 --n 1000000     data and position packets of a VLP-16
    scripts/fuzz.py serial --n 1000000    lines of sync boards, all dialects
    scripts/fuzz.py kills --n 200         `lce-rig collect`, killed while it captures

Exits with 1 where anything wrong was believed, or the process grew by more than 32 MB.
"""

import argparse
import json
import sys
from collections.abc import Callable
from typing import Any

_MAX_GROWTH_BYTES = 32 << 20


def fuzz_vlp16(n: int, seed: int) -> Any:
    """Damage packets of a VLP-16."""
    from fuzzing.vlp16_packets import fuzz_packets

    return fuzz_packets(n, seed)


def fuzz_serial(n: int, seed: int) -> Any:
    """Damage lines of sync boards."""
    from fuzzing.serial_lines import fuzz_lines

    return fuzz_lines(n, seed)


def fuzz_kill(n: int, seed: int) -> Any:
    """Kill a live collection."""
    from fuzzing.kills import fuzz_kills

    return fuzz_kills(n, seed)


TARGETS: dict[str, Callable[[int, int], Any]] = {
    "vlp16": fuzz_vlp16,
    "serial": fuzz_serial,
    "kills": fuzz_kill,
}
"""Target by name; its report has `n_wrong` and `grown_bytes`."""


def main() -> None:
    """Run the target asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("target", choices=sorted(TARGETS))
    parser.add_argument("--n", type=int, default=100_000, help="damaged inputs (default 100000)")
    parser.add_argument("--seed", type=int, default=0, help="same seed, same input (default 0)")
    arguments = parser.parse_args()
    report = TARGETS[arguments.target](arguments.n, arguments.seed)
    print(json.dumps(vars(report), indent=2, default=str))
    sys.exit(report.n_wrong > 0 or report.grown_bytes > _MAX_GROWTH_BYTES)


if __name__ == "__main__":
    main()
