"""Rows of numbers as text, as point cloud formats have them."""

import io
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.limits import MAX_LINE_BYTES

_MAX_EMPTY = 1000


def read_table(
    data: bytes, start: int, dtype: np.dtype[Any], n_rows: int, n_skipped: int = 0
) -> NDArray[Any]:
    """Read rows of numbers, separated by blanks or commas; empty lines do not count.

    Args:
        data: a whole file.
        start: where the rows begin in it.
        dtype: structured, of scalar fields: the columns.
        n_rows: how many to read.
        n_skipped: rows before them, with any content.

    Returns:
        Structured (n_rows,).

    Raises:
        ValueError: what is wrong with the text, in words that follow the file's name.
    """
    if n_rows == 0:
        return np.empty(0, dtype=dtype)
    # A row is a figure and the end of a line at least: no memory is taken for rows that cannot be there.
    n_possible = (len(data) - start + 1) // 2
    if n_possible < n_rows + n_skipped:
        raise ValueError(
            f"it is truncated: {max(n_possible - n_skipped, 0)} of {n_rows} points are there at most"
        )
    # Numbers are read as the columns' own types first: float64 would round 64-bit timestamps. Some writers
    # put "nan" or "3.0" into integer columns; then float64 and a cast must do.
    rows = _Rows(data, start, n_rows, n_skipped)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # of integers read by way of floats
            return np.loadtxt(rows, dtype=dtype, ndmin=1, comments=None)
    except _BadRowsError:
        raise
    except (ValueError, OverflowError, DeprecationWarning):
        return _read_as_floats(rows, dtype)


class _BadRowsError(ValueError):
    """Malformed lines, with any figures."""


class _Rows:
    """Lines that are not empty, read one by one: a list of them takes several times the file."""

    def __init__(self, data: bytes, start: int, n_rows: int, n_skipped: int) -> None:
        self._data, self._start = data, start
        self._n_rows, self._n_skipped = n_rows, n_skipped

    def __iter__(self) -> Iterator[bytes]:
        text, n_read, n_empty = io.BytesIO(self._data), 0, 0
        text.seek(self._start)
        while n_read < self._n_skipped + self._n_rows:
            line = text.readline(MAX_LINE_BYTES + 1)
            if len(line) > MAX_LINE_BYTES:
                raise _BadRowsError(f"a line of its text is longer than {MAX_LINE_BYTES} bytes")
            if not line:
                n_there = max(n_read - self._n_skipped, 0)
                raise _BadRowsError(f"it is truncated: {n_there} of {self._n_rows} points are there")
            if line.isspace():
                n_empty += 1
                if n_empty > n_read + _MAX_EMPTY:
                    raise _BadRowsError("most lines of its text are empty")
                continue
            n_read += 1
            if n_read > self._n_skipped:
                yield line.replace(b",", b" ")


def _read_as_floats(rows: _Rows, dtype: np.dtype[Any]) -> NDArray[Any]:
    try:
        values = np.loadtxt(rows, dtype=np.float64, ndmin=2, comments=None)
    except _BadRowsError:
        raise
    except ValueError as error:
        raise ValueError(f"its text cannot be read as numbers: {error}") from None
    names = dtype.names or ()
    if values.shape[1] != len(names):
        raise ValueError(f"its rows have {values.shape[1]} numbers where the header has {len(names)}")
    table = np.empty(len(values), dtype=dtype)
    for k, name in enumerate(names):
        is_float = dtype[name].kind == "f"
        with np.errstate(invalid="ignore", over="ignore"):
            table[name] = values[:, k] if is_float else np.nan_to_num(values[:, k], posinf=0.0, neginf=0.0)
    return table
