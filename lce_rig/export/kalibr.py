"""camchain.yaml: cameras as Kalibr chains them, by T_cn_cnm1, plus the LiDAR as T_cam_lidar."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, invert
from lce_rig.export.files import header, numbers, quoted, reads_back, rows
from lce_rig.export.job import ExportJob
from lce_rig.export.lens import FittedLens, lens_for, lens_lines
from lce_rig.export.probes import check_projection
from lce_rig.rig import Rig
from lce_rig.session.durable import write_atomically


def export_kalibr(job: ExportJob) -> list[Path]:
    """Write camchain_LIDAR.yaml for each LiDAR and read it back.

    Kalibr has four radtan coefficients; a camera with more gets the four that fit best.

    Raises:
        LceRigError: a file reads back differently.
    """
    lenses = {name: lens_for(job, "kalibr", name, 4) for name in dict.fromkeys(c.camera for c in job.chosen)}
    paths = []
    for lidar in job.rig.lidars:
        chain = [c for c in job.chosen if c.lidar == lidar]
        if chain:
            path = job.folder / f"camchain_{lidar}.yaml"
            write_atomically(path, _text(chain, lenses, job.rig))
            _check(path, chain, lenses, job.rig)
            paths.append(path)
    return paths


def _text(chain: Sequence[Calibration], lenses: dict[str, FittedLens], rig: Rig) -> str:
    lines = [f"# {line}" for line in header("Kalibr camchain", rig, chain)]
    lines += ["# T_cam_lidar, which Kalibr ignores, takes points from the LiDAR to the camera"]
    before: Calibration | None = None
    for index, calibration in enumerate(chain):
        lens = lenses[calibration.camera]
        intrinsics = lens.intrinsics
        model = "equidistant" if intrinsics.model == "equidistant" else "radtan"
        topic = (
            rig.cameras[calibration.camera].channels[calibration.channels[0]].topic
            or f"/{calibration.camera}"
        )
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
            f"  rostopic: {quoted(topic)}",
        ]
        before = calibration
    return "\n".join(lines) + "\n"


@reads_back
def _check(path: Path, chain: Sequence[Calibration], lenses: dict[str, FittedLens], rig: Rig) -> None:
    import yaml

    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    T_chained: Array = np.array(data["cam0"]["T_cam_lidar"], dtype=np.float64)
    for index, calibration in enumerate(chain):
        block = data[f"cam{index}"]
        if index:
            T_chained = np.array(block["T_cn_cnm1"]) @ T_chained
        model = block["distortion_model"]
        distortion = tuple(block["distortion_coeffs"])
        fx, fy, cx, cy = (float(value) for value in block["intrinsics"])
        width, height = block["resolution"]
        read = Intrinsics(fx, fy, cx, cy, width, height, model=model, distortion=distortion)
        wanted = lenses[calibration.camera].intrinsics
        for what, T in (("T_cam_lidar", np.array(block["T_cam_lidar"])), ("the chain", T_chained)):
            check_projection(path, f"cam{index}: {what}", T, read, calibration, rig, wanted)
