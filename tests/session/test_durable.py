"""Files are there whole or not at all."""

import os
import signal
import subprocess
import sys

WRITER = """
import sys
from pathlib import Path
from lce_rig.session.durable import write_atomically
print("ready", flush=True)
while True:
    for letter in "ab":
        write_atomically(Path(sys.argv[1]), letter * 200_000)
"""


def test_a_writer_killed_at_any_moment_leaves_a_whole_file(tmp_path):
    path = tmp_path / "result.json"
    with subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b"ready\n"
        while not path.exists():
            pass
        os.kill(writer.pid, signal.SIGKILL)
    assert path.read_text(encoding="utf-8") in ("a" * 200_000, "b" * 200_000)
