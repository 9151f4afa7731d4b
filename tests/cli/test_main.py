"""The command line as a whole: help, unknown words, exit codes."""

import subprocess
import sys

import pytest

from lce_rig import __version__
from lce_rig.cli.main import COMMANDS


def test_help_lists_every_verb_and_every_exit_code(lce_rig):
    outcome = lce_rig("--help")
    assert outcome.code == 0
    assert all(f"  {verb} " in outcome.out for verb in COMMANDS)
    assert "7 result refused" in outcome.out


def test_help_imports_nothing_heavy():
    script = (
        "import sys; from lce_rig.cli.main import run; run(['--help']);"
        "print([m for m in ('numpy', 'cv2', 'scipy', 'open3d', 'rich', 'pydantic') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("[]")


@pytest.mark.parametrize("verb", COMMANDS)
def test_every_verb_has_help(lce_rig, verb):
    outcome = lce_rig(verb, "--help")
    assert outcome.code == 0
    assert f" lce-rig {verb} " in outcome.out.strip().splitlines()[0]


def test_misspelt_command_suggests_nearest(lce_rig):
    outcome = lce_rig("calibrat")
    assert outcome.code == 2
    assert "'calibrate'." in outcome.err


def test_version_is_printed(lce_rig):
    assert lce_rig("--version").out == f"lce-rig {__version__}\n"


def test_an_unknown_rig_exits_with_3_and_names_the_nearest(lce_rig, tmp_path):
    outcome = lce_rig("simulate", "--rig", "rlf", tmp_path / "s")
    assert outcome.code == 3
    assert "rlfs" in outcome.err


@pytest.mark.parametrize("verb", ["check", "calibrate", "verify"])
def test_folder_without_session_exits_with_4(lce_rig, tmp_path, verb):
    outcome = lce_rig(verb, tmp_path)
    assert outcome.code == 4
    assert str(tmp_path) in outcome.err


def test_the_module_runs_like_the_command():
    words = [sys.executable, "-m", "lce_rig", "--version"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert done.stdout == f"lce-rig {__version__}\n"


# Press Ctrl-C so long after the library of a module began to load, then run a command line.
INTERRUPTED = """
import signal, sys
from lce_rig.cli.main import run

module, after_s, *words = sys.argv[1:]

def press_ctrl_c(event, arguments):
    if event == "import" and arguments[0] == module and arguments[1]:
        signal.setitimer(signal.ITIMER_REAL, float(after_s))

signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
sys.addaudithook(press_ctrl_c)
sys.exit(run(words))
"""


@pytest.mark.realtime
def test_main_interrupt_in_open3d_exits_130(tmp_path):
    # Interrupted during initialisation, it would report a lack of memory and exit with 1.
    words = ["open3d.pybind", "0.2", "simulate", "--rig", "rles", tmp_path / "session", "--captures", "1"]
    done = subprocess.run([sys.executable, "-c", INTERRUPTED, *words], capture_output=True, text=True)
    assert done.returncode == 130
    assert len(done.stderr.split("\n")) == 3 and done.stderr.startswith("\ninterrupted")


@pytest.mark.realtime
def test_main_interrupt_in_onnx_exits_130(tmp_path):
    words = ["onnxruntime.capi.onnxruntime_pybind11_state", "0.01", "reconstruct", "none", "-o", tmp_path]
    done = subprocess.run([sys.executable, "-c", INTERRUPTED, *words], capture_output=True, text=True)
    assert done.returncode == 130
    assert len(done.stderr.split("\n")) == 3 and done.stderr.startswith("\ninterrupted")


@pytest.mark.parametrize(
    "closed", [*(pytest.param(one, marks=pytest.mark.long) for one in ("<&-", ">&-", "2>&-")), "<&- >&- 2>&-"]
)
def test_closed_standard_streams_do_not_crash(closed, tmp_path):
    missing = f'collect --rig rles "{tmp_path}/none" --from "{tmp_path}/no"'
    line = f'exec "{sys.executable}" -m lce_rig {missing} {closed}'
    assert subprocess.run(["sh", "-c", line], check=False).returncode == 5
    line = f'exec "{sys.executable}" -m lce_rig rigs {closed}'
    assert subprocess.run(["sh", "-c", line], check=False, capture_output=True).returncode == 0
