"""Shared helpers: values made once per run, changed profiles, waiting, full disks."""

import fcntl
import os
import pickle
import resource
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")


class Shared:
    """The folder of a run that all its workers see; pytest removes it."""

    folder: Path | None = None


def find_folder(temporary):
    """Name the run's folder: above that of a worker of xdist."""
    base = temporary.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


def make_once(name, make):
    """Make a file or a folder where no other worker has, and wait for one that is about it."""
    assert Shared.folder is not None
    path, done = Shared.folder / name, Shared.folder / f"{name}.done"
    with (Shared.folder / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            make(path)
            done.touch()
    return path


def compute_once(name, compute):
    """Compute a value where no other worker has."""
    path = make_once(name, lambda path: path.write_bytes(pickle.dumps(compute())))
    return pickle.loads(path.read_bytes())


def changed(settings, **values):
    """Copy a profile or a part of it with other values, as of cameras__cam__driver__device."""
    for path, value in values.items():
        key, _, rest = path.partition("__")
        is_dict = isinstance(settings, dict)
        if rest:
            value = changed(settings[key] if is_dict else getattr(settings, key), **{rest: value})
        settings = {**settings, key: value} if is_dict else settings.model_copy(update={key: value})
    return settings


def half_size(rig):
    """Let cameras take images of half the size, which are rendered and searched in a quarter of the time."""
    for name, camera in rig.cameras.items():
        lens = camera.intrinsics.model_dump()
        halves = {key: lens[key] / 2 for key in ("fx_px", "fy_px", "cx_px", "cy_px")}
        small = tuple(length // 2 for length in camera.resolution_px)
        half = changed(camera, resolution_px=small, intrinsics=changed(camera.intrinsics, **halves))
        rig = changed(rig, **{f"cameras__{name}": half})
    return rig


def wait_until(is_so, patience_s=120.0):
    """Wait until something is so; a busy computer takes long."""
    deadline_s = time.monotonic() + patience_s
    while not is_so():
        assert time.monotonic() < deadline_s, "it never came to be"
        time.sleep(0.005)


def has_ended(pid):
    """Check whether a process is gone, or only waits to be reaped."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0] in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return True


@contextmanager
def files_up_to(n_bytes):
    """Let no file grow beyond a size, as on a disk that is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def contents(folder):
    """Read every file below a folder."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
