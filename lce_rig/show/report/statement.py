"""The sentences at the head of a report: what the result is good for, and what to do next."""

from lce_rig.core.calibration import Calibration, PointUncertainty
from lce_rig.words import as_line, describe, recommend

_USUAL_M = 10.0


def statement(c: Calibration) -> str:
    """Sum a result up in one paragraph that anyone can sign, with its figures."""
    known = (
        f"The pose of camera {c.camera} relative to {c.lidar} has a standard deviation of "
        f"{c.sigma_rotation_deg:.2g} deg and {1000 * c.sigma_translation_m:.2g} mm, from "
        f"{len(c.captures_used)} of {c.n_captures} captures of the board"
    )
    if c.verdict == "fail":
        return "Do not use this result: " + _reason(c) + _others(c, "error")
    passed = "every check passed" if c.verdict == "pass" else "use it with care: " + _reason(c) + _others(c)
    return f"{known}; {passed.rstrip('.')}. {_at_a_distance(c)}".strip()


def _reason(c: Calibration) -> str:
    reasons = [finding for finding in c.findings if finding.severity != "note"]
    return f"{describe(reasons[0])}." if reasons else "its checks failed."


def _others(c: Calibration, severity: str = "warning") -> str:
    n = sum(finding.severity == severity for finding in c.findings) - 1
    return f" {n} other reason{'s' if n > 1 else ''} below." if n > 0 else ""


def _at_a_distance(c: Calibration) -> str:
    if not c.uncertainty:
        return ""
    at: PointUncertainty = min(c.uncertainty, key=lambda each: abs(each.distance_m - _USUAL_M))
    return (
        f"A LiDAR point {at.distance_m:g} m away falls onto the image with an expected error of "
        f"{at.centre_px:.1f} px ({100 * at.centre_m:.1f} cm) in the middle and {at.corner_px:.1f} px "
        f"({100 * at.corner_m:.1f} cm) in the corners."
    )


def next_steps(c: Calibration) -> list[str]:
    """List what to do next, the most urgent first: what findings ask for, then how to put it to use."""
    asked = [recommend(finding) for finding in sorted(c.findings, key=lambda f: f.severity != "error")]
    steps = [as_line(text) for text in dict.fromkeys(asked) if text]
    if c.verdict == "fail":
        return [*steps, "Then run `lce-rig calibrate` again. The last usable result is in `previous/`."]
    return [
        *steps,
        "Look at the overlays (`lce-rig verify`): ring ends must lie on the board's outline on all sides.",
        "Collect a second session on another day and compare both with `lce-rig repeat`.",
    ]
