"""Calibrations that a test made up, and their result.json."""

from lce_rig.core.calibration import Calibration, Certificate, Metrics, Provenance, ResultFile
from lce_rig.session.durable import write_atomically


def made_calibration(T_cam_lidar, cov, **fields):
    """Make up a calibration that passes, of camera "cam" and LiDAR "lidar"; `fields` replace these."""
    usual = {
        "camera": "cam",
        "channels": ("frames",),
        "lidar": "lidar",
        "certificate": Certificate(True, 1e-9),
        "metrics": Metrics(0.008, 0.006, 0.1),
        "n_captures": 20,
        "n_detected": 20,
        "captures_used": ("000000",),
        "captures_refused": {},
        "verdict": "pass",
    }
    return Calibration(T_cam_lidar=T_cam_lidar, cov=cov, **{**usual, **fields})


def result_file(rig, calibrations, inputs=None, provenance=None):
    """Build result.json of a rig."""
    return ResultFile(
        rig=rig, pairs=tuple(calibrations), inputs_sha256=inputs or {}, provenance=provenance or Provenance()
    )


def write_result(path, rig, calibrations, inputs=None):
    """Write result.json of a rig."""
    write_atomically(path, result_file(rig, calibrations, inputs).text())
