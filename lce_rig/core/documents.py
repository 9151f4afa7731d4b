"""JSON documents from files."""

import json
import math
from pathlib import Path
from typing import Any


def read_json(path: Path) -> Any:
    """Read a JSON document from a file; see `parse_json`.

    Raises:
        OSError: it is not there, or cannot be read.
        ValueError: it is not JSON.
    """
    return parse_json(path.read_bytes())


def parse_json(data: bytes, *, is_finite: bool = True) -> Any:
    """Parse a JSON document; its numbers fit a float and its text can be printed.

    Args:
        data: the document, in UTF-8.
        is_finite: whether NaN and Infinity, which are not JSON, are refused.

    Raises:
        ValueError: it is not such a document.
    """
    constant = _not_finite if is_finite else float
    try:
        text = data.decode("utf-8-sig")
        document = json.loads(text, parse_int=_integer, parse_float=_float, parse_constant=constant)
        if "\\ud" in text.lower():  # An escape may give half a surrogate pair, which cannot be printed.
            json.dumps(document, ensure_ascii=False).encode()
    except (ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"it is not JSON: {error}") from None
    return document


def _integer(text: str) -> int:
    value = int(text)
    float(value)  # raises OverflowError
    return value


def _float(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _not_finite(text)


def _not_finite(text: str) -> float:
    raise ValueError(f"{text[:20]} is not a finite number")
