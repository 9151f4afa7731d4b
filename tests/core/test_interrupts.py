"""Ctrl-C in programs that cannot, or will not, end of their own accord."""

import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest

from lce_rig.core.interrupts import EXIT_INTERRUPTED, GRACE_S, INTERRUPTED

# What the installed command does; `busy` stands for a verb.
PROGRAM = """
import sys, time
from concurrent.futures import ThreadPoolExecutor
from lce_rig.core.interrupts import EXIT_INTERRUPTED, INTERRUPTED, patience, watch_for_interrupts

watch_for_interrupts()
try:
    print("ready", flush=True)
{busy}
except KeyboardInterrupt:
    print(INTERRUPTED, file=sys.stderr)
    sys.exit(EXIT_INTERRUPTED)
"""
BUSY = {
    "a pool whose job goes on": """
    with ThreadPoolExecutor(1) as pool:
        pool.submit(time.sleep, 30).result()
""",
    "a callback that cannot raise": """
    class Deaf:
        def __del__(self):
            time.sleep(5)
    Deaf()
    time.sleep(30)
""",
}


@contextmanager
def running(busy):
    words = [sys.executable, "-c", PROGRAM.format(busy=busy)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "ready\n"
            time.sleep(0.05)
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("busy", BUSY.values(), ids=BUSY)
def test_interrupt_busy_ends_after_grace(busy):
    with running(busy) as process:
        pressed_s = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=10)
        assert time.monotonic() - pressed_s < GRACE_S + 2
    assert process.returncode == EXIT_INTERRUPTED
    assert said == INTERRUPTED + "\n"


def test_who_presses_twice_does_not_wait():
    with running(BUSY["a pool whose job goes on"].replace("30", "20")) as process:
        process.send_signal(signal.SIGINT)
        time.sleep(0.3)
        pressed_s = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=10)
        assert time.monotonic() - pressed_s < GRACE_S - 0.3
    assert process.returncode == EXIT_INTERRUPTED
    assert said == INTERRUPTED + "\n"


def test_interrupt_second_press_exits():
    """The first press leaves time to write."""
    busy = """
    import signal
    asked = []
    signal.signal(signal.SIGINT, lambda *_: asked.append(1))
    with patience(20):
        end_s = time.monotonic() + {wait_s}
        while time.monotonic() < end_s:
            time.sleep(0.01)
    sys.exit(3 if asked else 4)
"""
    with running(busy.replace("{wait_s}", "1.8")) as process:
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == 3
    with running(busy.replace("{wait_s}", "20")) as process:
        process.send_signal(signal.SIGINT)
        time.sleep(0.3)
        process.send_signal(signal.SIGINT)
        assert process.wait(GRACE_S) == EXIT_INTERRUPTED
