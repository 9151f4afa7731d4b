#!/usr/bin/env python3
"""Feed hostile input to whatever reads from devices and files, and print what became of it as JSON.

    scripts/fuzz.py readers --n 3000            every reader of files, damaged files of each kind
    scripts/fuzz.py bombs                       small files that ask for much, by the command line
    scripts/fuzz.py result-kills --n 200        `calibrate`, `verify`, `intrinsics`, killed
    scripts/fuzz.py deploy-kills --n 200        `deploy`, killed, into a folder and over ssh
    scripts/fuzz.py kills --n 200               `collect`, killed while it captures
    scripts/fuzz.py preview --n 2000            hostile clients of the preview page
    scripts/fuzz.py interrupts --n 100          Ctrl-C at any moment
    scripts/fuzz.py vlp16 --n 1000000           data and position packets of a VLP-16
    scripts/fuzz.py serial --n 1000000          lines of sync boards, all dialects

Exits with 1 where anything wrong was believed, or the process grew by more than 32 MB. docs/fuzzing.md says
what each judges.
"""

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

_MAX_GROWTH_BYTES = 32 << 20


@dataclass(frozen=True)
class Target:
    """What is tried.

    Attributes:
        function: module and function; takes (n, seed), and its report has `n_wrong` and `grown_bytes`.
        n: default number of inputs.
        help: one line.
    """

    function: str
    n: int
    help: str


TARGETS = {
    "readers": Target("fuzzing.readers:fuzz_readers", 3_000, "damaged files of each kind, for each reader"),
    "bombs": Target("fuzzing.bombs:fuzz_bombs", 1, "small files that ask for much; each n times"),
    "result-kills": Target("fuzzing.result_kills:fuzz_result_kills", 200, "verbs killed about their results"),
    "deploy-kills": Target("fuzzing.deploy_kills:fuzz_deploy_kills", 200, "deployments, killed"),
    "kills": Target("fuzzing.kills:fuzz_kills", 200, "a live collection, killed"),
    "preview": Target("fuzzing.preview:fuzz_preview", 2_000, "hostile clients of the preview page"),
    "interrupts": Target("fuzzing.interrupts:fuzz_interrupts", 100, "Ctrl-C at any moment"),
    "vlp16": Target("fuzzing.vlp16_packets:fuzz_packets", 100_000, "damaged packets of a VLP-16"),
    "serial": Target("fuzzing.serial_lines:fuzz_lines", 100_000, "damaged lines of sync boards"),
}
"""By name; imported when wanted."""


def main() -> None:
    """Run the target asked for."""
    arguments = _parse()
    report = _run(arguments)
    print(json.dumps(vars(report), indent=2, default=_plain))
    sys.exit(report.n_wrong > 0 or report.grown_bytes > _MAX_GROWTH_BYTES)


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    targets = parser.add_subparsers(dest="target", required=True, metavar="TARGET")
    for name, target in TARGETS.items():
        own = targets.add_parser(name, help=target.help)
        own.add_argument("--n", type=int, default=target.n, help=f"inputs (default {target.n})")
        own.add_argument("--seed", type=int, default=0, help="same seed, same input (default 0)")
        if name in ("readers", "bombs"):
            own.add_argument("--only", default="", metavar="NAME,...", help="these alone; ? lists them")
        if name == "readers":
            own.add_argument("--seconds", type=float, default=float("inf"), help="for all readers together")
            own.add_argument("--jobs", type=int, default=1, help="processes side by side (default 1)")
            own.add_argument("--case", type=int, help="run this one of --only alone and keep its files")
            own.add_argument("--output", type=Path, help="where --case keeps them (default fuzz-NAME-CASE)")
    return parser.parse_args()


def _run(arguments: argparse.Namespace) -> Any:
    module, function = TARGETS[arguments.target].function.split(":")
    run: Callable[..., Any] = getattr(import_module(module), function)
    if arguments.target == "readers":
        names = _names(arguments.only, import_module("fuzzing.reader_table").READERS)
        if arguments.case is not None:
            if len(names) != 1:
                sys.exit("--case needs --only with one name")
            output = arguments.output or Path(f"fuzz-{names[0]}-{arguments.case}")
            return import_module(module).run_one_case(names[0], arguments.seed, arguments.case, output)
        return run(arguments.n, arguments.seed, names=names, seconds=arguments.seconds, jobs=arguments.jobs)
    if arguments.target == "bombs":
        return run(arguments.n, arguments.seed, names=_names(arguments.only, import_module(module).BOMBS))
    return run(arguments.n, arguments.seed)


def _plain(value: Any) -> Any:
    """Give JSON what it can write: parts of a report as objects, anything else as text."""
    return vars(value) if is_dataclass(value) else str(value)


def _names(text: str, known: Any) -> list[str]:
    names = [name for name in text.split(",") if name]
    unknown = [name for name in names if name not in known]
    if unknown:
        sys.exit(f"{unknown[0]} is not known; choose from: {', '.join(known)}")
    return names


if __name__ == "__main__":
    main()
