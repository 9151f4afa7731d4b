"""Checked reading of JSON documents from files."""

import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

from lce_rig.core.limits import MAX_DOCUMENT_BYTES, describe, read_file

MAX_DEPTH = 32
"""Of lists and mappings in each other; a result has six."""
MAX_BLOCKS = 1_000_000
"""Lists and mappings in a document: each costs memory, however short its text."""


def read_json(path: Path, max_bytes: int = MAX_DOCUMENT_BYTES) -> Any:
    """Read a JSON document from a file.

    Raises:
        OSError: it is not there, or cannot be read.
        ValueError: what is wrong with it, in words that follow the file's name.
    """
    return parse_json(read_file(path, max_bytes))


def parse_json(data: bytes, *, is_finite: bool = True) -> Any:
    """Parse a JSON document of any size that is in memory.

    Numbers are finite and fit a float, no key is given twice, and every text can be printed: what is read can
    be computed with, shown and written again.

    Args:
        data: the document, in UTF-8.
        is_finite: whether NaN and Infinity, which are not JSON, are refused.

    Raises:
        ValueError: what is wrong with it, in words that follow the file's name.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"it is not JSON: not UTF-8 text (byte {error.start})") from None
    if text.count("[") + text.count("{") > MAX_BLOCKS:
        raise ValueError(f"it has more than {MAX_BLOCKS} lists and mappings")
    try:
        document = (_STRICT if is_finite else _WITH_NAN).decode(text)
    except RecursionError:
        raise ValueError("it is too deeply nested") from None
    except ValueError as error:
        raise ValueError(f"it is not JSON: {error}") from None
    _check(document)
    return document


def _check(document: Any) -> None:
    """Refuse what is nested too deeply to be walked, and half characters, which cannot be printed."""
    waiting = [(document, 1)]
    while waiting:
        value, depth = waiting.pop()
        if isinstance(value, str) and not is_printable(value):
            raise ValueError(f"its text {describe(value)} holds half a character")
        if not isinstance(value, (dict, list)):
            continue
        if depth > MAX_DEPTH:
            raise ValueError("it is too deeply nested")
        inner = (*value.keys(), *value.values()) if isinstance(value, dict) else value
        waiting += [(each, depth + 1) for each in inner if isinstance(each, (str, dict, list))]


def is_printable(text: str) -> bool:
    """Return whether a text can be encoded: an escape may give half a surrogate pair."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        key, _ = Counter(key for key, _ in pairs).most_common(1)[0]
        raise ValueError(f"the key {describe(key)} is given twice")
    return found


def _integer(text: str) -> int:
    # Its length first: Python takes quadratic time over the digits.
    if len(text) > 309 or math.isinf(float(text)):
        raise ValueError(f"the number {describe(text)} is too large")
    return int(text)


def _float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {describe(text)} is too large")
    return value


def _constant(name: str) -> float:
    raise ValueError(f"{name} is not a number")


_WITH_NAN = json.JSONDecoder(object_pairs_hook=_unique, parse_int=_integer, parse_float=_float)
_STRICT = json.JSONDecoder(
    object_pairs_hook=_unique, parse_int=_integer, parse_float=_float, parse_constant=_constant
)
