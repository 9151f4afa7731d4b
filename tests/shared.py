"""What several workers of a test run need is made by the first of them, and read by the others."""

import fcntl
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

T = TypeVar("T")


class Shared:
    """The folder of a run that all its workers see; pytest removes it."""

    folder: Path | None = None


def find_folder(temporary: pytest.TempPathFactory) -> Path:
    """Name the run's folder: above that of a worker of xdist."""
    base = temporary.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


def make_once(name: str, make: Callable[[Path], object]) -> Path:
    """Make a file or a folder where no other worker has, and wait for one that is about it."""
    assert Shared.folder is not None
    path, done = Shared.folder / name, Shared.folder / f"{name}.done"
    with (Shared.folder / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            make(path)
            done.touch()
    return path


def compute_once(name: str, compute: Callable[[], T]) -> T:
    """Compute a value where no other worker has."""
    path = make_once(name, lambda path: path.write_bytes(pickle.dumps(compute())))
    value: T = pickle.loads(path.read_bytes())
    return value
