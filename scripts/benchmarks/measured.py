"""Figures that the pages show, as benches measure them."""

import re

Value = float | int | str

#: Measurements of this run: values and unit by key.
MEASURED: dict[str, tuple[list[Value], str]] = {}
DEG_MM = "{:.3f} deg, {:.1f} mm"
_DIGITS = 6


def measure(key: str, unit: str, *values: Value) -> None:
    """Keep a figure; `scripts/bench.py --record` writes it if a page shows its key.

    Args:
        key: parts separated by dots; other characters than letters, digits, dots and underscores become "-".
        unit: the figure as pages print it, with a format field for each value ("{:.3f} deg, {:.1f} mm").
        values: numbers, or words.
    """
    # Plain numbers of few digits, not those of numpy.
    plain = [
        value if isinstance(value, int | str) else float(f"{float(value):.{_DIGITS}g}") for value in values
    ]
    MEASURED[key_of(key)] = plain, unit


def key_of(text: str) -> str:
    """Return a text as a key."""
    return re.sub(r"[^a-z0-9._]+", "-", text.lower()).strip("-")
