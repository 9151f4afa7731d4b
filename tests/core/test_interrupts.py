"""Ctrl-C in programs that cannot, or will not, end of their own accord."""

import signal
import subprocess
import sys
import textwrap
import time
from contextlib import contextmanager

import pytest

from lce_rig.core.interrupts import EXIT_INTERRUPTED, GRACE_S, INTERRUPTED

pytestmark = pytest.mark.realtime
# Patience with a process on a busy machine, s; shorter than the programs' own waits.
SOON_S = 20.0
# Like the installed command, with `busy` as the verb.
PROGRAM = """
import signal, sys, time
from concurrent.futures import ThreadPoolExecutor
from lce_rig.core.interrupts import EXIT_INTERRUPTED, INTERRUPTED, patience, watch_for_interrupts

watch_for_interrupts()
try:
{busy}
except KeyboardInterrupt:
    print(INTERRUPTED, file=sys.stderr)
    sys.exit(EXIT_INTERRUPTED)
"""
BUSY = {
    "a pool whose job goes on": """
    with ThreadPoolExecutor(1) as pool:
        job = pool.submit(time.sleep, 60)
        print("ready", flush=True)
        job.result()
""",
    "a callback that cannot raise": """
    class Deaf:
        def __del__(self):
            print("ready", flush=True)
            time.sleep(5)
    Deaf()
    time.sleep(60)
""",
}
PATIENT = """
    asked = []
    signal.signal(signal.SIGINT, lambda *_: asked.append(1))
    with patience(60):
        print("ready", flush=True)
        end_s = time.monotonic() + {wait_s}
        while time.monotonic() < end_s:
            time.sleep(0.01)
    sys.exit(3 if asked else 4)
"""


@contextmanager
def running(busy):
    words = [sys.executable, "-c", PROGRAM.format(busy=busy)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


def press_until_it_ends(process):
    """Press repeatedly; simultaneous presses count as one."""
    pressed_s = time.monotonic()
    while process.poll() is None:
        assert time.monotonic() < pressed_s + SOON_S
        process.send_signal(signal.SIGINT)
        time.sleep(0.3)


@pytest.mark.parametrize("busy", BUSY.values(), ids=BUSY)
def test_interrupt_busy_ends_after_grace(busy):
    with running(busy) as process:
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=SOON_S)
    assert process.returncode == EXIT_INTERRUPTED
    assert said == INTERRUPTED + "\n"


def test_second_interrupt_ends_at_once():
    busy = textwrap.indent(BUSY["a pool whose job goes on"], "    ")
    with running(f"    with patience(60):\n{busy}") as process:
        press_until_it_ends(process)
        _, said = process.communicate()
    assert process.returncode == EXIT_INTERRUPTED
    assert said == INTERRUPTED + "\n"


def test_interrupt_second_press_exits():
    """The first press leaves time to write."""
    with running(PATIENT.replace("{wait_s}", str(GRACE_S + 0.6))) as process:
        process.send_signal(signal.SIGINT)
        assert process.wait(SOON_S) == 3
    with running(PATIENT.replace("{wait_s}", "60")) as process:
        press_until_it_ends(process)
        assert process.returncode == EXIT_INTERRUPTED
