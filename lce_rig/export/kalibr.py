"""camchain.yaml: cameras as Kalibr chains them, by T_cn_cnm1, plus the LiDAR as T_cam_lidar."""

from collections.abc import Sequence
from pathlib import Path

from lce_rig.core.calibration import Calibration
from lce_rig.core.geometry import invert
from lce_rig.export.files import numbers, quoted, rows
from lce_rig.export.job import ExportJob
from lce_rig.export.lens import FittedLens, lens_for, lens_lines


def export_kalibr(job: ExportJob) -> list[Path]:
    """Write camchain_LIDAR.yaml for each LiDAR.

    Kalibr has four radtan coefficients; a camera with more gets the four that fit best.
    """
    lenses = {name: lens_for(job, "kalibr", name, 4) for name in dict.fromkeys(c.camera for c in job.chosen)}
    chains = {lidar: [c for c in job.chosen if c.lidar == lidar] for lidar in job.rig.lidars}
    return [
        job.write(f"camchain_{lidar}.yaml", _camchain(chain, lenses, job))
        for lidar, chain in chains.items()
        if chain
    ]


def _camchain(chain: Sequence[Calibration], lenses: dict[str, FittedLens], job: ExportJob) -> list[str]:
    lines = [f"# {line}" for line in job.head("Kalibr camchain", *chain)]
    lines += ["# T_cam_lidar, which Kalibr ignores, takes points from the LiDAR to the camera"]
    before: Calibration | None = None
    for index, calibration in enumerate(chain):
        lens = lenses[calibration.camera]
        intrinsics = lens.intrinsics
        model = "equidistant" if intrinsics.model == "equidistant" else "radtan"
        camera_matrix = (intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px)
        lines += [*(f"# cam{index}: {line}" for line in lens_lines(lens)), f"cam{index}:"]
        if before is not None:
            lines += ["  T_cn_cnm1:", *rows(calibration.T_cam_lidar @ invert(before.T_cam_lidar), "    ")]
        lines += [
            "  T_cam_lidar:",
            *rows(calibration.T_cam_lidar, "    "),
            f"  cam_overlaps: [{', '.join(str(i) for i in range(len(chain)) if i != index)}]",
            "  camera_model: pinhole",
            f"  distortion_coeffs: {numbers(intrinsics.distortion)}",
            f"  distortion_model: {model}",
            f"  intrinsics: {numbers(camera_matrix)}",
            f"  resolution: [{intrinsics.width_px}, {intrinsics.height_px}]",
            f"  rostopic: {quoted(job.image_topic(calibration))}",
        ]
        before = calibration
    return lines
