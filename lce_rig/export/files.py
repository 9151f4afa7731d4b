"""Write numbers and texts so that they read back exactly."""

import json
from collections.abc import Iterable

import numpy as np

from lce_rig.core.errors import ResultRefusedError
from lce_rig.core.geometry import Array


def number(value: float) -> str:
    """Write a float with all its digits, as YAML 1.1, URDF and a shell read it.

    Raises:
        ResultRefusedError: the value is not finite.
    """
    value = float(value) + 0.0  # turns -0.0 into 0.0
    if not np.isfinite(value):
        raise ResultRefusedError(f"a figure of the result is not finite: {value}")
    text = repr(value)
    mantissa, e, exponent = text.partition("e")
    # YAML 1.1 takes 1e-05 for a text: the mantissa needs its point.
    return f"{mantissa}.0e{exponent}" if e and "." not in mantissa else text


def numbers(values: Iterable[float]) -> str:
    """Write floats as a flow list: [1.0, 2.0]."""
    return "[" + ", ".join(number(value) for value in values) + "]"


def quoted(text: str) -> str:
    """Write a text as a double-quoted scalar, valid in JSON and YAML."""
    return json.dumps(text, ensure_ascii=False)


def texts(values: Iterable[str]) -> str:
    """Write texts as a flow list."""
    return "[" + ", ".join(quoted(value) for value in values) + "]"


def rows(matrix: Array, indent: str) -> list[str]:
    """Write a matrix as YAML, one row per line."""
    return [f"{indent}- {numbers(row)}" for row in matrix]
