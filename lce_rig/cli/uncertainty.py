"""How the report of a calibration states what is uncertain: by axis, and for points at several distances."""

import numpy as np

from lce_rig.core.geometry import Array
from lce_rig.core.results import Calibration

_AXES = ("x right", "y down", "z forward")


def uncertainty_lines(calibration: Calibration) -> list[str]:
    """State an extrinsic's standard deviations and its least certain motion, in lines of 80 columns."""
    c = calibration
    sigmas = np.sqrt(np.diag(c.cov))
    return [
        f"  known to     {c.sigma_rotation_deg:.3f} deg, {1000 * c.sigma_translation_m:.1f} mm (1 sigma)",
        f"               about {_by_axis(np.degrees(sigmas[3:]), '.3f')} deg",
        f"               along {_by_axis(1000 * sigmas[:3], '.1f')} mm",
        f"  weakest: {c.weak_direction}",
        *_at_distances(c),
    ]


def _by_axis(values: Array, digits: str) -> str:
    return ", ".join(f"{axis} {value:{digits}}" for axis, value in zip(_AXES, values, strict=True))


def _at_distances(c: Calibration) -> list[str]:
    if not c.uncertainty:
        return []
    columns = [f"{each.distance_m:g} m away" for each in c.uncertainty]
    centre = [f"{each.centre_px:.1f} px, {100 * each.centre_m:.1f} cm" for each in c.uncertainty]
    corner = [f"{each.corner_px:.1f} px, {100 * each.corner_m:.1f} cm" for each in c.uncertainty]
    return [
        f"  {title:<13}" + "".join(f"{cell:<20}" for cell in cells).rstrip()
        for title, cells in (("a point", columns), ("  in centre", centre), ("  in corner", corner))
    ]
