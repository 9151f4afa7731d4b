"""One error for whatever a library raises about a file."""

import struct
from pathlib import Path

import pytest
import yaml

from lce_rig.core.errors import ProfileError, SessionError, SourceError, reading

PATH = Path("folder/file.bin")


@pytest.mark.parametrize(
    "error",
    [
        OSError(5, "Input/output error"),
        ValueError("it is empty"),
        ValueError("\ud800 half a character"),
        KeyError("polarity"),
        struct.error("unpack requires 4 bytes"),
        yaml.YAMLError("line 1\nline 2"),
        UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"),
        MemoryError(),
        RuntimeError("x" * 10_000),
    ],
    ids=lambda error: type(error).__name__,
)
def test_library_error_becomes_one_line(error):
    with pytest.raises(ProfileError) as raised, reading(PATH, ProfileError):
        raise error
    assert raised.value.what.startswith(f"{PATH}: ")
    assert "\n" not in raised.value.what and len(raised.value.what) < 300
    raised.value.what.encode()


def test_an_error_of_lce_rig_passes_unchanged():
    error = SessionError("capture 000003 is incomplete", "collect it again")
    with pytest.raises(SessionError) as raised, reading(PATH, SourceError):
        raise error
    assert raised.value is error


class _Ours:
    pass


_Ours.__module__ = "lce_rig.core.errors"


@pytest.mark.parametrize(
    ("broken", "raised"),
    [
        (lambda: _Ours().missing, AttributeError),
        (lambda: [].get("key"), SourceError),
        (lambda: {}["key"], SourceError),
        (lambda: undefined, SourceError),  # noqa: F821  raised outside the package
    ],
    ids=["own attribute", "attribute of a list", "missing key", "name outside the package"],
)
def test_reading_passes_bugs_and_names_damaged_files(broken, raised):
    with pytest.raises(raised), reading("file"):
        broken()
