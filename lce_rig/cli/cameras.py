"""How a calibration is reported of several cameras: how they sit to each other, which one has no result."""

from collections.abc import Collection, Sequence

from lce_rig.core.errors import NotEnoughDataError
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
    others = {other.camera: other for other in c.other_cameras}
    lines: list[str] = []
    for earlier in calibrations[: calibrations.index(c)]:
        if earlier.lidar == c.lidar and earlier.camera in others:
            lines += _lines(c.camera, others[earlier.camera])
        elif earlier.lidar == c.lidar:
            lines.append(
                f"[bold]{earlier.camera} and {c.camera}[/]: no board held still before both: "
                "neither is held against the other"
            )
    return lines


def lacking_extrinsics(
    wanted: Sequence[str], seen: Collection[str], calibrations: Sequence[Calibration]
) -> NotEnoughDataError | None:
    """Say which cameras have no extrinsic, None where all have: half a rig must not pass for the whole.

    Args:
        wanted: cameras that should have one.
        seen: cameras of which the session holds captures.
        calibrations: what there is, at least one.
    """
    calibrated = {calibration.camera for calibration in calibrations}
    missing = [camera for camera in wanted if camera not in calibrated]
    if not missing:
        return None
    causes = [f"No capture holds a picture of {name} and a scan." for name in missing if name not in seen]
    others = " ".join(f"--camera {name}" for name in wanted if name in calibrated)
    return NotEnoughDataError(
        f"no extrinsic of camera {', '.join(missing)}",
        "\n".join([*causes, f"Collect more captures; to do without: {others}"]),
    )


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
