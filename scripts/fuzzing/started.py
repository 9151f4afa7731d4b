"""The program started from this checkout, to be killed; its output is stored."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

PATIENCE_S = 300.0
_ROOT = Path(__file__).parents[2]
_MAIN = "from lce_rig.cli.main import main; main()"


def start(words: list[str], *, in_own_session: bool = False) -> "subprocess.Popen[bytes]":
    """Start a command line in its own process session, so that it can be killed with its children."""
    environment = {**os.environ, "PYTHONPATH": str(_ROOT), "OMP_NUM_THREADS": "1"}
    log = tempfile.TemporaryFile()  # noqa: SIM115  closed with the process's object
    process = subprocess.Popen(
        [sys.executable, "-c", _MAIN, *words],
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        env=environment,
        start_new_session=in_own_session,
    )
    process.said = log  # type: ignore[attr-defined]
    return process


def said(process: "subprocess.Popen[bytes]") -> str:
    """Read the output of an ended process; only once."""
    log = process.said  # type: ignore[attr-defined]
    log.seek(0)
    text: str = log.read().decode(errors="replace")
    log.close()
    return text


def must_end_well(process: "subprocess.Popen[bytes]") -> None:
    """Wait for a process that is not killed."""
    code = process.wait(PATIENCE_S)
    text = said(process)
    assert code == 0, f"{process.args!r} ended with {code}:\n{text[-2000:]}"
