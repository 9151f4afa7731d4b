"""camera_info_CAMERA.yaml: intrinsics as ROS's camera_info_manager reads them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import ProfileError
from lce_rig.export.job import ExportJob
from lce_rig.export.writing import numbers, quoted
from lce_rig.session.durable import write_atomically

# How files of cv::FileStorage begin.
_OPENCV = b"%YAML:1.0"


def export_camera_info(job: ExportJob) -> list[Path]:
    """Write a file for each calibrated camera."""
    paths = []
    for name, calibration in {c.camera: c for c in job.chosen}.items():
        path = job.folder / f"camera_info_{name}.yaml"
        head = job.head("camera_info", calibration, of_one_camera=True)
        write_atomically(path, camera_info_text(name, job.rig.cameras[name].to_intrinsics(), head))
        paths.append(path)
    return paths


def ros_distortion(intrinsics: Intrinsics) -> tuple[str, tuple[float, ...]]:
    """Return the name of the ROS distortion model and its coefficients (4, 5 or 8)."""
    coefficients = intrinsics.distortion
    if intrinsics.model == "equidistant":
        return "equidistant", coefficients
    # plumb_bob has five coefficients, k3 last; rational_polynomial eight.
    model, count = ("plumb_bob", 5) if len(coefficients) <= 5 else ("rational_polynomial", 8)
    return model, (*coefficients, *(0.0,) * (count - len(coefficients)))


def camera_info_text(name: str, intrinsics: Intrinsics, head: Sequence[str]) -> str:
    """Write the content of a camera_info file, after `head` as comments."""
    model, coefficients = ros_distortion(intrinsics)
    projection = np.hstack([intrinsics.matrix, np.zeros((3, 1))])
    lines = [f"# {line}" for line in head]
    lines += [
        f"image_width: {intrinsics.width_px}",
        f"image_height: {intrinsics.height_px}",
        f"camera_name: {quoted(name)}",
        *_matrix("camera_matrix", intrinsics.matrix),
        f"distortion_model: {model}",
        *_matrix("distortion_coefficients", np.array([coefficients])),
        *_matrix("rectification_matrix", np.eye(3)),
        *_matrix("projection_matrix", projection),
    ]
    return "\n".join(lines) + "\n"


def _matrix(key: str, matrix: Any) -> list[str]:
    n_rows, n_cols = matrix.shape
    return [f"{key}:", f"  rows: {n_rows}", f"  cols: {n_cols}", f"  data: {numbers(matrix.ravel())}"]


def load_camera_info(path: Path) -> Intrinsics:
    """Read a camera_info file of any maker, or the lens that OpenCV's calibration sample writes.

    The projection_matrix, of a rectified image, is not used.

    Raises:
        ProfileError: it cannot be read, or is none, or of a camera that was not calibrated.
    """
    import yaml

    try:
        text = path.read_bytes()
        is_opencv = text.startswith(_OPENCV)
        # OpenCV's directive and tags are no YAML; what they mark reads as plain mappings.
        data = yaml.safe_load(text.removeprefix(_OPENCV).replace(b"!!opencv-matrix", b""))
        coefficients = tuple(float(value) for value in data["distortion_coefficients"]["data"])
        size = int(data["image_width"]), int(data["image_height"])
        K = np.array(data["camera_matrix"]["data"], dtype=np.float64)
        if is_opencv:
            perspective = "plumb_bob" if len(coefficients) <= 5 else "rational_polynomial"
            data.setdefault("distortion_model", "fisheye" if data.get("fisheye_model") else perspective)
        return Intrinsics.from_ros(str(data["distortion_model"]), K, coefficients, size)
    except OSError as error:
        raise ProfileError(f"{path}: cannot be read: {error.strerror}") from None
    except KeyError as error:
        raise ProfileError(f"{path}: not a camera_info file: it has no key {error.args[0]}") from None
    except TypeError:
        raise ProfileError(f"{path}: not a camera_info file: a block of it has no keys") from None
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        raise ProfileError(f"{path}: not a usable camera_info file: {' '.join(str(error).split())}") from None
