"""The memory limit: a file that needs more is refused by name at once."""

import subprocess
import sys

import pytest

PROGRAM = """
import sys
from lce_rig.cli import entry
entry._SHARE_OF_MEMORY = 0.0
entry.limit_memory()
from lce_rig.cli.main import run
sys.exit(run(sys.argv[1:]))
"""


@pytest.mark.long
def test_huge_file_is_refused_without_memory(tmp_path):
    with (tmp_path / "huge.raw").open("wb") as file:
        file.truncate(1 << 40)
    words = [sys.executable, "-c", PROGRAM, "reconstruct", tmp_path / "huge.raw", "-o", tmp_path / "out"]
    outcome = subprocess.run(list(map(str, words)), capture_output=True, text=True, check=False)
    assert outcome.returncode == 5
    assert "huge.raw" in outcome.stderr and "memory" in outcome.stderr and "Traceback" not in outcome.stderr
