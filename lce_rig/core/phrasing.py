"""Figures formatted with their units, in templates."""

import math
import re
import string
from collections.abc import Mapping
from typing import Any

# Suffix of a format spec -> (factor, default number of decimals, unit as printed).
_UNITS: Mapping[str, tuple[float, int, str]] = {
    "mm": (1000.0, 0, " mm"),
    "cm": (100.0, 0, " cm"),
    "ms": (1000.0, 1, " ms"),
    "us": (1e6, 0, " us"),
    "deg": (1.0, 2, " deg"),
    "percent": (100.0, 0, " %"),
}


_LIMITS = ("limit_", "max_", "min_", "target_", "tolerance_")
_MOST_DIGITS, _FEW = 4, 4


def _format(value: Any, spec: str, more: int = 0) -> str:
    """Format a figure; {rms_m:mm}, {tilt_deg:1deg}, {change_m:+mm}, {share:percent} scale and add the unit.

    {axis:motion} prints a motion by its code; {captures:few} lists the first of them.

    Args:
        value: the figure; those of a tuple are listed.
        spec: format specification of the template.
        more: digits beyond those of the spec.
    """
    if value is None:
        return "unknown"
    unit = next((unit for unit in _UNITS if spec.endswith(unit)), None)
    if spec == "few":
        return ", ".join(map(str, value[:_FEW])) + (" ..." if len(value) > _FEW else "")
    if isinstance(value, tuple):
        listed = [_format(each, spec, more) for each in value]
        printed = "" if unit is None else _UNITS[unit][2]
        return ", ".join([*(text.removesuffix(printed) for text in listed[:-1]), *listed[-1:]])
    if spec == "motion":
        return motion_words(str(value))
    if unit is None:
        if re.fullmatch(r"\.\dg", spec):
            return significant(value, int(spec[1]))
        fixed = re.fullmatch(r"\.(\d)f", spec)
        return str(format(value, f".{int(fixed[1]) + more}f" if fixed else spec))
    factor, decimals, printed = _UNITS[unit]
    sign, digits = "+" if spec.startswith("+") else "", spec.removesuffix(unit).lstrip("+")
    number = factor * float(value)
    places = (int(digits) if digits else decimals) + more
    return (f"{number:{sign}.{places}f}" if math.isfinite(number) else "unknown") + printed


_CAMERA_AXES = {"x": "x axis (right)", "y": "y axis (down)", "z": "z axis (line of sight)"}


def motion_words(motion: str) -> str:
    """Return a motion's name for its code, "translation_x" to "rotation_z"; other text is unchanged."""
    kind, _, axis = motion.partition("_")
    if axis not in _CAMERA_AXES:
        return motion
    return f"{kind} {'along' if kind == 'translation' else 'about'} the {_CAMERA_AXES[axis]}"


def fill(template: str, figures: Mapping[str, Any]) -> str:
    """Fill in figures, with enough digits to distinguish a figure from its limit."""
    fields = [(text, name, spec or "") for text, name, spec, _ in string.Formatter().parse(template)]
    specs = {name: spec for _, name, spec in fields if name is not None}
    more = dict.fromkeys(specs, 0)
    for limit in filter(lambda name: name.startswith(_LIMITS), specs):
        unit = limit.rpartition("_")[2]
        for name in specs:
            if name.startswith(_LIMITS) or name.rpartition("_")[2] != unit:
                continue
            if isinstance(figures[name], float) and isinstance(figures[limit], float | int):
                more[name] = more[limit] = _more_digits(
                    (figures[name], specs[name]), (figures[limit], specs[limit])
                )
    return "".join(
        text + ("" if name is None else _format(figures[name], spec, more[name]))
        for text, name, spec in fields
    )


def _more_digits(figure: tuple[float, str], limit: tuple[float, str]) -> int:
    """Count the digits to add so that two figures print differently; 0 if they are equal."""
    for more in range(_MOST_DIGITS if figure[0] != limit[0] else 0):
        first, second = (_format(*each, more).split()[0] for each in (figure, limit))
        if "unknown" in (first, second) or float(first) != float(second):
            return more
    return 0


def significant(value: float, digits: int = 2) -> str:
    """Format a figure with significant digits and without an exponent: 110, not 1.1e+02."""
    text = f"{value:.{digits}g}"
    if "e" not in text:
        return text
    return f"{value:.0f}" if abs(value) >= 1 else "below 0.0001" if value >= 0 else f"{value:.6f}"


def sizes(rotation_deg: float, translation_m: float) -> str:
    """Format the size of a motion, or its standard deviation."""
    return f"{rotation_deg:.3f} deg, {1000 * translation_m:.1f} mm"


def captures_to_add(n_captures: Any, is_enough: Any, groups: Any) -> str:
    """Describe how many captures to add, where to stand and how to tilt the board.

    Args:
        n_captures: total number to add.
        is_enough: whether they are predicted to suffice.
        groups: number, distance in m, place in the image if off-centre, and tilts of each group.
    """
    placements = []
    for n, distance_m, place, sides in groups:
        how = f"tilted {'/'.join(sides) if len(sides) < 3 else 'all ways'}" if sides else place
        placements.append(f"{n} at {distance_m:g} m {how}".rstrip())
    return f"add {n_captures}{'' if is_enough else '+'} captures: {', '.join(placements)}"


def as_line(text: str) -> str:
    """Format text as a sentence, with a capital and a full stop."""
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."
