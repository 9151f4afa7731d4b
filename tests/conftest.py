"""Settings all tests share."""

import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings

from lce_rig.cli.entry import limit_opencv
from lce_rig.rig import load_rig
from tests.shared import Shared, find_folder

# Long runs of the property tests try more examples, and new ones each time (CONTRIBUTING.md, Fuzzing).
_EXAMPLES = os.environ.get("LCE_RIG_EXAMPLES")
settings.register_profile(
    "lce-rig", deadline=None, derandomize=not _EXAMPLES, max_examples=int(_EXAMPLES or 50)
)
settings.load_profile("lce-rig")

# Before OpenCV is loaded, so that tests read images as the command line does.
limit_opencv()

# What a shell runs in the background ignores Ctrl-C, and so would processes that tests start to press it for.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def _shared(tmp_path_factory):
    Shared.folder = find_folder(tmp_path_factory)


@pytest.fixture(scope="session")
def rlfs():
    """The shipped profile of a camera and a VLP-16."""
    return load_rig("rlfs")


@pytest.fixture(scope="session")
def rles():
    """The shipped profile of a DAVIS346 and a VLP-16."""
    return load_rig("rles")


@pytest.fixture(scope="session")
def rig(rlfs):
    """The rig of a test that needs any."""
    return rlfs


@pytest.fixture(scope="session")
def recordings():
    """The folder of recordings by others, named by LCE_RIG_DATA."""
    folder = os.environ.get("LCE_RIG_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("LCE_RIG_DATA names no folder of recordings")
    return Path(folder)
