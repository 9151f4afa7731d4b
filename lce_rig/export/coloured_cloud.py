"""The point clouds of a session with the colours of the camera, as PLY files.

References:
    http://paulbourke.net/dataformats/ply
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.calibration import Calibration
from lce_rig.core.data import Image, Scan
from lce_rig.export import NO_IMAGES, NO_SESSION, ExportJob
from lce_rig.scene.colouring import colour_points
from lce_rig.session.durable import write_atomically

_FIELDS = [
    *(("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")),
    *(("intensity", "<f4"), ("capture", "<i4")),
]
_POINT = np.dtype(_FIELDS)
_PLY_TYPES = {"<f4": "float", "u1": "uchar", "<i4": "int"}


def export_ply(job: ExportJob) -> list[Path]:
    """Write coloured_CAMERA.ply with the points of all captures that the camera sees.

    Points are in the LiDAR's frame; the clouds of captures coincide if the rig stood still.

    Raises:
        SessionError: a capture is damaged, or the disk is full.
    """
    if job.session is None:
        job.findings.append(NO_SESSION(format="ply"))
        return []
    paths = []
    for calibration in job.of_cameras:
        clouds = {}
        for capture in job.session.captures:
            channels = [channel for camera, channel in capture.image_keys if camera == calibration.camera]
            channels.sort(key=calibration.channels.__contains__, reverse=True)
            if channels and calibration.lidar in capture.lidars:
                image = capture.image(calibration.camera, channels[0])
                scan = job.rig.corrected(capture.scan(calibration.lidar))
                clouds[capture.name] = coloured(image, scan, calibration, job, int(capture.name))
        if not clouds:
            job.findings.append(NO_IMAGES(calibration.camera, format="ply"))
            continue
        points = np.concatenate([*clouds.values()])
        path = job.folder / f"coloured_{job.name_of(calibration)}.ply"
        lines = job.head("coloured point cloud", calibration, of_one_camera=True)
        lines.append(f"points in frame {job.rig.lidars[calibration.lidar].frame}, m")
        lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in lines)]
        lines.append(f"element vertex {len(points)}")
        lines += [f"property {_PLY_TYPES[kind]} {name}" for name, kind in _FIELDS]
        head = "\n".join([*lines, "end_header"]) + "\n"
        write_atomically(path, head.encode("ascii", "replace") + points.tobytes())
        paths.append(path)
    return paths


def coloured(
    image: Image, scan: Scan, calibration: Calibration, job: ExportJob, number: int
) -> NDArray[np.void]:
    """Colour the points in the camera's view by their pixels; return them as records of the file."""
    lens = job.rig.cameras[calibration.camera].to_intrinsics()
    colours, is_seen = colour_points(scan, image.pixels, calibration.T_cam_lidar, lens)
    points = np.empty(int(is_seen.sum()), _POINT)
    for axis, name in enumerate("xyz"):
        points[name] = scan.points[is_seen, axis]
    for place, name in enumerate(("red", "green", "blue")):
        points[name] = colours[is_seen, place]
    points["intensity"], points["capture"] = scan.intensity[is_seen], number
    return points
