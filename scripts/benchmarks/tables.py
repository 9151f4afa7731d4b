"""Markdown tables, and the figures that go into them."""

from collections.abc import Sequence

import numpy as np

from lce_rig.core.geometry import Array, difference


def print_head(*titles: str) -> None:
    """Print the head of a Markdown table."""
    print("| " + " | ".join(titles) + " |\n|" + "---|" * len(titles), flush=True)


def print_row(*cells: object) -> None:
    """Print a row of a Markdown table."""
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def compare(T: Array, T_reference: Array) -> tuple[float, float]:
    """Measure a difference in deg and mm."""
    tangent = difference(T, T_reference)
    return float(np.degrees(np.linalg.norm(tangent[3:]))), float(1000 * np.linalg.norm(tangent[:3]))


def rms(values: Array | Sequence[float]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
