"""camchain.yaml: cameras as Kalibr chains them, by T_cn_cnm1, plus the LiDAR as T_cam_lidar."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, invert
from lce_rig.core.results import Calibration
from lce_rig.export.files import header, numbers, quoted, reads_back, rows
from lce_rig.export.frames import choose_channels
from lce_rig.export.probes import check_projection
from lce_rig.rig import Rig
from lce_rig.session.durable import write_atomically


def export_kalibr(calibrations: Sequence[Calibration], rig: Rig, folder: Path) -> list[Path]:
    """Write camchain_LIDAR.yaml for each LiDAR whose cameras Kalibr's models describe, and read it back.

    Kalibr supports four radtan coefficients; cameras with k3 or more are skipped.

    Raises:
        LceRigError: a file reads back differently.
    """
    chosen = choose_channels(calibrations, rig)
    paths = []
    for lidar in rig.lidars:
        chain = [
            c for c in chosen if c.lidar == lidar and _is_expressible(rig.cameras[c.camera].to_intrinsics())
        ]
        if chain:
            path = folder / f"camchain_{lidar}.yaml"
            write_atomically(path, _text(chain, rig))
            _check(path, chain, rig)
            paths.append(path)
    return paths


def _is_expressible(intrinsics: Intrinsics) -> bool:
    return intrinsics.model == "equidistant" or not any(intrinsics.distortion[4:])


def _text(chain: Sequence[Calibration], rig: Rig) -> str:
    lines = [f"# {line}" for line in header("Kalibr camchain", rig, chain)]
    lines += ["# T_cam_lidar, which Kalibr ignores, takes points from the LiDAR to the camera"]
    before: Calibration | None = None
    for index, calibration in enumerate(chain):
        intrinsics = rig.cameras[calibration.camera].to_intrinsics()
        coefficients = (*intrinsics.distortion, 0.0, 0.0, 0.0, 0.0)[:4]
        model = "equidistant" if intrinsics.model == "equidistant" else "radtan"
        topic = (
            rig.cameras[calibration.camera].channels[calibration.channels[0]].topic
            or f"/{calibration.camera}"
        )
        camera_matrix = (intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px)
        lines += [f"cam{index}:"]
        if before is not None:
            lines += ["  T_cn_cnm1:", *rows(calibration.T_cam_lidar @ invert(before.T_cam_lidar), "    ")]
        lines += [
            "  T_cam_lidar:",
            *rows(calibration.T_cam_lidar, "    "),
            f"  cam_overlaps: [{', '.join(str(i) for i in range(len(chain)) if i != index)}]",
            "  camera_model: pinhole",
            f"  distortion_coeffs: {numbers(coefficients)}",
            f"  distortion_model: {model}",
            f"  intrinsics: {numbers(camera_matrix)}",
            f"  resolution: [{intrinsics.width_px}, {intrinsics.height_px}]",
            f"  rostopic: {quoted(topic)}",
        ]
        before = calibration
    return "\n".join(lines) + "\n"


@reads_back
def _check(path: Path, chain: Sequence[Calibration], rig: Rig) -> None:
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
        for what, T in (("T_cam_lidar", np.array(block["T_cam_lidar"])), ("the chain", T_chained)):
            check_projection(path, f"cam{index}: {what}", T, read, calibration, rig)
