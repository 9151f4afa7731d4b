"""The story in order: captures -> detections -> extrinsics -> files and pictures. Start reading here.

    detections = detect(session)                            the board in all pictures, scans and events
    results, troubles = calibrate(session.rig, detections, options)     an extrinsic and verdict a pair
    calibrations = [calibration for calibration, _ in results]
    write_results(session, calibrations, force=False)       result.json, YAML, URDF, camera_info, transforms
    verify(session, detections, calibrations)               the LiDAR drawn into the pictures

Every step takes what the step before it made. Results are frozen dataclasses; only the
session and the export layer touch files.
"""

from lce_rig.detect.detection import Detections, ImageDetection, LidarDetection, Pair
from lce_rig.pipeline.calibration import calibrate
from lce_rig.pipeline.detection import detect, detect_image, detect_scan, detection_digest, event_picture
from lce_rig.pipeline.result_files import inputs_sha256, write_results
from lce_rig.pipeline.solving import refusals
from lce_rig.pipeline.verification import verify, write_debug_images

__all__ = [
    "Detections",
    "ImageDetection",
    "LidarDetection",
    "Pair",
    "calibrate",
    "detect",
    "detect_image",
    "detect_scan",
    "detection_digest",
    "event_picture",
    "inputs_sha256",
    "refusals",
    "verify",
    "write_debug_images",
    "write_results",
]
