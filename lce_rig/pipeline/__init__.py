"""The whole chain: captures -> detections -> extrinsics -> files and images. Start reading here.

    detections = detect(session)                 the board in all images, scans and events
    result = calibrate(session, detections)      extrinsics and a verdict for each camera and LiDAR
    result.write()                               result.json, YAML, URDF, camera_info, transforms
    verify(session, result).write()              the point clouds projected into the images

Every step takes the output of the one before. Results are frozen dataclasses; only the
session and the export layer touch files.
"""

from lce_rig.detect.detection import Detections, ImageDetection, LidarDetection, Pair
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.pipeline.detect_session import detect, detection_digest, event_picture
from lce_rig.pipeline.matching import refusals_of
from lce_rig.pipeline.result_files import Result, inputs_sha256
from lce_rig.pipeline.union import calibrate
from lce_rig.pipeline.verification import verify, write_debug_images

__all__ = [
    "Detections",
    "ImageDetection",
    "LidarDetection",
    "Pair",
    "Result",
    "calibrate",
    "calibrate_detections",
    "detect",
    "detection_digest",
    "event_picture",
    "inputs_sha256",
    "refusals_of",
    "verify",
    "write_debug_images",
]
