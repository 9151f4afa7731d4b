"""JSON documents: what is read can be computed with and shown."""

import pytest
from hypothesis import given

from lce_rig.core.documents import parse_json
from tests.damage import damaged


@pytest.mark.parametrize(
    "data",
    [
        b"[" * 100_000,
        b"[1e999]",
        b"[" + b"9" * 401 + b"]",
        b"[" + b"9" * 10_000 + b"]",
        b"[NaN]",
        b"[-Infinity]",
        b"\xff\xfe[1]",
        b'["\\ud800"]',
        b'{"\\udc00": 1}',
        b"",
    ],
)
def test_what_cannot_be_worked_with_is_refused(data):
    with pytest.raises(ValueError, match="not JSON"):
        parse_json(data)


@given(data=damaged(b'{"a": [1, 2.5e3, "\\ud83d\\ude00", null, {"b": -0.0}]}'))
def test_damaged_documents_are_read_or_refused(data):
    try:
        parse_json(data)
    except ValueError as error:
        assert str(error)


def test_ordinary_documents_are_read_with_or_without_a_mark_of_their_encoding():
    assert parse_json(b'\xef\xbb\xbf{"a": [1, 2.5, "\\ud83d\\ude00", null]}') == {"a": [1, 2.5, "😀", None]}
