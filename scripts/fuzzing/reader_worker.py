"""The process that reads damaged files for `fuzz.py readers`: it may hang or die, and is then replaced.

Jobs come as JSON lines on standard input; each case answers with one JSON line.
"""

import json
import os
import pickle
import resource
import sys
import time
from pathlib import Path

_MAX_ADDRESSES = 8 << 30


def main() -> None:
    """Run jobs until standard input ends."""
    seeds_file, folder = Path(sys.argv[1]), Path(sys.argv[2])
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    # What libraries print is none of the answers.
    os.dup2(2, 1)
    resource.setrlimit(resource.RLIMIT_AS, (_MAX_ADDRESSES, _MAX_ADDRESSES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    from fuzzing.reader_cases import run_case

    # Written by the parent a moment ago.
    seeds = pickle.loads(seeds_file.read_bytes())
    for line in sys.stdin:
        job = json.loads(line)
        deadline_s = time.monotonic() + job["seconds"]
        for case in range(job["first"], job["end"]):
            outcome = run_case(job["name"], seeds[job["name"]], job["seed"], case, folder / f"{case}")
            answers.write(json.dumps(outcome.to_dict()) + "\n")
            if time.monotonic() > deadline_s:
                break
        answers.write("done\n")


if __name__ == "__main__":
    main()
