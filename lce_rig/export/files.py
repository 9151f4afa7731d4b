"""Write text: numbers that read back exactly, files that are complete or absent."""

import json
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np
import yaml

from lce_rig.core.calibration import MADE_BY, Calibration
from lce_rig.core.errors import LceRigError, ResultRefusedError
from lce_rig.core.geometry import Array
from lce_rig.rig import Rig

_Arguments = ParamSpec("_Arguments")
_Read = TypeVar("_Read")
# Errors from reading a damaged text of numbers: syntax, missing keys, other types, other shapes.
_DAMAGE = (
    *(OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError, RecursionError),
    yaml.YAMLError,
)


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


def header(
    what: str, rig: Rig, calibrations: Sequence[Calibration], *, of_one_camera: bool = False
) -> list[str]:
    """List the comment lines at the head of every file: content, program, whether to use it.

    Args:
        what: the file's content.
        rig: the profile.
        calibrations: the calibrations in the file.
        of_one_camera: whether the file is for one camera; else the head names cameras that it lacks.
    """
    lines = [f"{what} of rig {rig.name}, written by {MADE_BY}"]
    for calibration in calibrations:
        pair = f"{calibration.camera}/{calibration.channel} and {calibration.lidar}"
        deg, mm = calibration.sigma_rotation_deg, 1e3 * calibration.sigma_translation_m
        lines.append(f"{pair}: {calibration.verdict}, standard deviation {deg:.3f} deg, {mm:.2f} mm")
        if calibration.verdict == "fail":
            reasons = "; ".join(finding.sentence for finding in calibration.findings) or "no reason given"
            lines.append(f"NOT FOR USE: the calibration of {pair} failed: {' '.join(reasons.split())}")
    held = {calibration.camera for calibration in calibrations}
    lacking = [camera for camera in rig.cameras if camera not in held]
    if lacking and not of_one_camera:
        lines.append(f"not in this file, without a usable result: {', '.join(lacking)}")
    return lines


def reads_back(
    read: Callable[Concatenate[Path, _Arguments], _Read],
) -> Callable[Concatenate[Path, _Arguments], _Read]:
    """Make a function that reads an export back report any damage to the file as one error.

    Args:
        read: takes the file's path first, and refuses poses that are not finite.
    """

    @wraps(read)
    def guarded(path: Path, /, *args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Read:
        try:
            with np.errstate(all="ignore"):
                return read(path, *args, **kwargs)
        except _DAMAGE as error:
            said = " ".join(str(error).split())[:120] or type(error).__name__
            raise LceRigError(
                f"{path}: cannot be read back: {said}", "Check the disk, then run the same command again."
            ) from error

    return guarded
