"""How the report of a calibration states what several cameras have to do with each other."""

from collections.abc import Sequence

from lce_rig.core.geometry import sigma_sizes
from lce_rig.core.results import Calibration, OtherCamera


def together_lines(calibration: Calibration) -> list[str]:
    """Say with which cameras an extrinsic was estimated, and how well it is known without them."""
    if not calibration.estimated_with:
        return []
    figures = calibration.diagnostics
    alone = ""
    if "alone_sigma_rotation_deg" in figures:
        sigma_mm = 1000 * figures["alone_sigma_translation_m"]
        alone = f"; alone it is known to {figures['alone_sigma_rotation_deg']:.3f} deg, {sigma_mm:.1f} mm"
    return [f"  together     with {', '.join(calibration.estimated_with)}{alone}"]


def camera_lines(calibration: Calibration, calibrations: Sequence[Calibration]) -> list[str]:
    """State where cameras earlier in the result sit to this one; each two cameras are stated once."""
    c = calibration
    earlier = [each.camera for each in calibrations[: calibrations.index(c)] if each.lidar == c.lidar]
    return [line for other in c.other_cameras if other.camera in earlier for line in _lines(c.camera, other)]


def _lines(camera: str, other: OtherCamera) -> list[str]:
    name = other.camera
    lines = [
        f"[bold]{name} and {camera}[/], by {other.n_captures} captures of both",
        f"  T_{camera}_{name} (p_{camera} = R p_{name} + t)",
        *("    " + "  ".join(f"{value: .6f}" for value in row) for row in other.T_cam_other[:3]),
    ]
    if other.cov is not None:
        sigma_deg, sigma_m = sigma_sizes(other.cov)
        lines.append(f"  known to     {sigma_deg:.3f} deg, {1000 * sigma_m:.1f} mm (1 sigma)")
    if other.apart_rotation_deg is not None and other.apart_translation_m is not None:
        by_itself = ", each camera by itself" if other.cov is not None else ""
        lines.append(
            f"  pictures     differ by {other.apart_rotation_deg:.3f} deg, "
            f"{1000 * other.apart_translation_m:.1f} mm{by_itself}"
        )
    lines.append(f"  boards       {1000 * other.board_rms_m:.1f} mm apart")
    return lines
