"""Write numbers and texts so that they read back exactly, and rotations in each format's form.

References:
    K. Shoemake, "Euler angle conversion", Graphics Gems IV, 1994.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from lce_rig.core.errors import ResultRefusedError
from lce_rig.core.geometry import Array, project_to_so3
from lce_rig.rig.loading import dump_yaml


def number(value: float) -> str:
    """Format a float with all its digits, valid in YAML 1.1, URDF and shells.

    Raises:
        ResultRefusedError: the value is not finite.
    """
    value = float(value) + 0.0  # turns -0.0 into 0.0
    if not np.isfinite(value):
        raise ResultRefusedError(f"a figure of the result is not finite: {value}")
    text = repr(value)
    mantissa, e, exponent = text.partition("e")
    # YAML 1.1 reads 1e-05 as text: the mantissa needs a decimal point.
    return f"{mantissa}.0e{exponent}" if e and "." not in mantissa else text


def yaml_text(head: Iterable[str], document: Mapping[str, Any]) -> str:
    """Format comments and a document as YAML; number lists stay on one line and read back exactly."""
    return "".join(f"# {line}\n" for line in head) + dump_yaml(document, math.inf)


def quaternion_xyzw(R: Array) -> Array:
    """Compute the unit quaternion (4,), scalar last and not negative, of R (3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(R).as_quat(canonical=True))


def rpy(R: Array) -> Array:
    """Compute (roll, pitch, yaw) in rad with R = Rz(yaw) Ry(pitch) Rx(roll), to rounding at every pitch.

    Near pitch = +-90 deg yaw is ill-determined. Pitch and roll are therefore read from Rz(yaw)^T R for the
    chosen yaw, so that roll compensates for an error in yaw.
    """
    R = project_to_so3(R)
    yaw = np.arctan2(R[1, 0], R[0, 0])
    cos_yaw, sin_yaw = np.cos(yaw), np.sin(yaw)
    pitch = np.arctan2(-R[2, 0], cos_yaw * R[0, 0] + sin_yaw * R[1, 0])
    cos_roll = cos_yaw * R[1, 1] - sin_yaw * R[0, 1]
    sin_roll = sin_yaw * R[0, 2] - cos_yaw * R[1, 2]
    return np.array([np.arctan2(sin_roll, cos_roll), pitch, yaw])
