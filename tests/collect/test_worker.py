"""An object in another process: its answers, its errors, and what happens when its process ends."""

import os
import signal

import numpy as np
import pytest

from lce_rig.collect.worker import Worker
from lce_rig.core.errors import ProfileError, SourceError


class Adder:
    """Keeps a running sum of its arguments."""

    def __init__(self, first):
        self.total = first
        self.kept = None

    def add(self, values):
        self.total += int(values.sum())
        self.kept = values if self.kept is None else self.kept
        return self.total

    def keep(self):
        return self.kept

    def process(self):
        return os.getpid()

    def threads(self):
        return os.environ.get("OPENBLAS_NUM_THREADS")

    def refuse(self):
        raise ProfileError("what", "hint")

    def fail(self):
        raise ZeroDivisionError

    def die(self):
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture(scope="module")
def adder():
    with Worker("add", Adder, 5) as opened:
        yield opened


def test_worker_arrays_are_not_overwritten(adder):
    first = np.arange(300_000, dtype=np.uint16).reshape(300, 1000)
    assert adder.call("add", first) == 5 + int(first.sum())
    adder.call("add", np.zeros_like(first))
    assert np.array_equal(adder.call("keep"), first)


@pytest.fixture
def two_threads(monkeypatch):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")


def test_worker_is_a_process_of_one_thread(two_threads, adder):
    assert adder.call("process") != os.getpid()
    assert adder.call("threads") == "1" and os.environ["OPENBLAS_NUM_THREADS"] == "2"


def test_worker_errors_and_bugs_pass_through(adder):
    with pytest.raises(ProfileError) as caught:
        adder.call("refuse")
    assert (caught.value.what, caught.value.hint) == ("what", "hint")
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        adder.call("fail")


def test_worker_killed_process_is_restarted():
    """A process that dies in every call is an error."""
    with Worker("add", Adder, 7) as opened:
        os.kill(opened.call("process"), signal.SIGKILL)
        assert opened.call("add", np.ones(3)) == 10
        with pytest.raises(SourceError):
            opened.call("die")
