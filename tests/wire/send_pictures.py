"""Write a reel's pictures to standard output at a camera's rate, as a program behind a profile's `command`.

A copy of the moment's picture leaves when its time has come; with --trigger, when a byte comes out of that
pipe. --unplug names a file: while it is there, there is no camera.
"""

import argparse
import json
import mmap
import os
import signal
import sys
import time
from pathlib import Path

from wire.timing import placement_at


def main():
    """Send until the receiver is gone."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("reel", type=Path)
    parser.add_argument("camera")
    parser.add_argument("--rate", type=float, required=True, metavar="HZ")
    parser.add_argument("--loops", type=int, required=True, help="of 0.3 s that the board is held for")
    parser.add_argument("--trigger", type=Path)
    parser.add_argument("--unplug", type=Path)
    parser.add_argument("--report", type=Path, help="for the number of pictures sent, and not sent in time")
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    sent = late = 0
    try:
        figures = json.loads((given.reel / "reel.json").read_text())
        n_pictures, n_bytes = figures["n_pictures"], figures["picture_bytes"][given.camera]
        with (given.reel / f"{given.camera}.bin").open("rb") as file:
            pictures = memoryview(mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ))
        trigger = os.open(given.trigger, os.O_RDONLY) if given.trigger else -1
        period_ns = round(1e9 / given.rate)
        number = time.time_ns() // period_ns + 1
        while not (given.unplug and given.unplug.exists()):
            if trigger >= 0:
                if not os.read(trigger, 1):
                    break
                number += 1
            else:
                behind = (time.time_ns() - number * period_ns) // period_ns
                # A camera that is not read in time skips images.
                late, number = late + max(behind, 0), number + max(behind, 0)
                time.sleep(max(0.0, (number * period_ns - time.time_ns()) * 1e-9))
                number += 1
            shown = placement_at(time.time_ns(), given.loops, figures["n_placements"])
            first = (shown * n_pictures + number % n_pictures) * n_bytes
            write_all(pictures[first : first + n_bytes])
            sent += 1
        sys.exit("the camera is not there")
    except BrokenPipeError:
        pass
    finally:
        if given.report:
            given.report.write_text(json.dumps({"sent": sent, "late": late}))


def write_all(data):
    """Write an image to standard output; waits while the pipe is full."""
    while data:
        data = data[os.write(1, data) :]


if __name__ == "__main__":
    main()
