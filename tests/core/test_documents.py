"""JSON that is too much, or no JSON, says so; what is read can be computed with and shown."""

import os

import pytest

from lce_rig.core.documents import parse_json, read_json


@pytest.mark.parametrize(
    ("data", "cause"),
    [
        (b"[" * 100_000, "too deeply nested"),
        (b"[" * 40 + b"]" * 40, "too deeply nested"),
        (b"[1e999]", "too large"),
        (b"[" + b"9" * 401 + b"]", "too large"),
        (b"[" + b"9" * 10_000 + b"]", "too large"),
        (b"[NaN]", "NaN is not a number"),
        (b"[-Infinity]", "-Infinity is not a number"),
        (b'{"a": 1, "a": 2}', "'a' is given twice"),
        (b"\xff\xfe[1]", "not UTF-8"),
        (b'["\\ud800"]', "half a character"),
        (b'{"\\udc00": 1}', "half a character"),
        (b"", "not JSON"),
        (b"[{}" + b",{}" * 1_000_000 + b"]", "more than 1000000 lists"),
    ],
)
def test_what_cannot_be_worked_with_is_refused(data, cause):
    with pytest.raises(ValueError, match=cause):
        parse_json(data)


def test_ordinary_documents_are_read_with_or_without_a_mark_of_their_encoding():
    assert parse_json(b'\xef\xbb\xbf{"a": [1, 2.5, "\\ud83d\\ude00", null]}') == {"a": [1, 2.5, "😀", None]}


def test_large_files_and_pipes_are_not_read(tmp_path):
    with (tmp_path / "large").open("wb") as file:
        file.truncate(1 << 30)
    os.mkfifo(tmp_path / "pipe")
    for name, cause in (("large", "too large"), ("pipe", "pipe")):
        with pytest.raises(ValueError, match=cause):
            read_json(tmp_path / name)
