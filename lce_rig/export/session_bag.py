"""The session as a ROS 2 bag (mcap) for Foxglove and RViz: images, point clouds, camera models, transforms.

Beside the images lies the point cloud projected into each of them, as the result has it.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.calibration import Calibration
from lce_rig.core.data import Image, Scan
from lce_rig.export.findings import NO_IMAGES, NO_SESSION
from lce_rig.export.job import ExportJob
from lce_rig.export.ros_bag import bag_writer, camera_info, check_bag, ros_header, write_tf_static
from lce_rig.io.ros.bag_recorder import CLOUD_TYPE, IMAGE_TYPE, encode_image, encode_scan
from lce_rig.io.ros.message_fields import typestore
from lce_rig.session.capture import Capture
from lce_rig.show.overlays.overlay import draw_projection, range_limits

_INFO_TYPE, _JPEG_TYPE = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/CompressedImage"
_JPEG_QUALITY = 92
# Captures without timestamps lie this far apart.
_STEP_NS = 10**9


class _Topics:
    """The topics of a bag; each is announced with its first message."""

    def __init__(self, writer: Any) -> None:
        self._writer = writer
        self._known: dict[str, Any] = {}
        self.counts: Counter[str] = Counter()

    def write(self, topic: str, msgtype: str, time_ns: int, message: Any) -> None:
        store = typestore(False)
        if topic not in self._known:
            self._known[topic] = self._writer.add_connection(topic, msgtype, typestore=store)
        data = message if isinstance(message, bytes | memoryview) else store.serialize_cdr(message, msgtype)
        self._writer.write(self._known[topic], time_ns, data)
        self.counts[topic] += 1


def export_mcap(job: ExportJob) -> list[Path]:
    """Write the bag RIG_session/ and check its transforms by reading them back.

    Raises:
        LceRigError: the bag reads back differently.
        SessionError: a capture is damaged, or the disk is full.
    """
    if job.session is None:
        job.findings.append(NO_SESSION(format="mcap"))
        return []
    captures = job.session.captures
    folder = job.folder / f"{job.rig.name}_session"
    seen: set[str] = set()
    with bag_writer(folder, "session as a ROS 2 bag", job) as writer:
        topics = _Topics(writer)
        before_ns, limits_m = 0, None
        for index, capture in enumerate(captures):
            scans = [capture.scan(lidar) for lidar in capture.lidars]
            images = list(_images(capture, job))
            time_ns = _time_ns(scans, images) or before_ns + _STEP_NS
            before_ns = time_ns
            limits_m = limits_m or range_limits(scans)  # the same colours in all captures
            if not index:
                write_tf_static(writer, job, time_ns)
            for scan in scans:
                _write_scan(topics, _timed(scan, time_ns), time_ns, job)
            for image in images:
                seen.add(image.sensor)
                _write_image(topics, _timed(image, time_ns), time_ns, job)
            for calibration in job.chosen:
                _write_projected(topics, calibration, scans, images, time_ns, limits_m, job)
    for name in dict.fromkeys(c.camera for c in job.chosen):
        if name not in seen:
            job.findings.append(NO_IMAGES(name, format="mcap"))
    check_bag(folder, job)
    return sorted(folder.iterdir())


def _images(capture: Capture, job: ExportJob) -> Iterator[Image]:
    for camera, channel in capture.image_keys:
        if camera in job.rig.cameras:
            yield capture.image(camera, channel)


def _time_ns(scans: list[Scan], images: list[Image]) -> int | None:
    """Choose the time of a capture: that of its scan, as the LiDAR's clock is the rig's."""
    samples: list[Scan | Image] = [*scans, *images]
    return next((sample.stamp_ns for sample in samples if sample.stamp_ns is not None), None)


def _timed(sample: Any, time_ns: int) -> Any:
    from dataclasses import replace

    return sample if sample.stamp_ns is not None else replace(sample, stamp_ns=time_ns)


def _write_scan(topics: _Topics, scan: Scan, time_ns: int, job: ExportJob) -> None:
    settings = job.rig.lidars[scan.sensor]
    topic = settings.topic or f"/{scan.sensor}/points"
    topics.write(topic, CLOUD_TYPE, time_ns, encode_scan(scan, settings, False, topics.counts[topic]))


def _write_image(topics: _Topics, image: Image, time_ns: int, job: ExportJob) -> None:
    camera = job.rig.cameras[image.sensor]
    topic = image_topic(job, image.sensor, image.channel)
    data = encode_image(image, camera.optical_frame, False, topics.counts[topic])
    topics.write(topic, IMAGE_TYPE, time_ns, data)
    info = camera_info(job, image.sensor, image.stamp_ns or 0)
    topics.write(f"{topic.rpartition('/')[0]}/camera_info", _INFO_TYPE, time_ns, info)


def image_topic(job: ExportJob, camera: str, channel: str) -> str:
    """Name the topic of a camera's images, with a namespace of its own for its camera_info."""
    topic = job.rig.cameras[camera].channels[channel].topic or f"/{camera}/{channel}"
    topic = topic if topic.startswith("/") else f"/{topic}"
    return topic if topic.count("/") > 1 else f"{topic}/image"


def _write_projected(
    topics: _Topics,
    calibration: Calibration,
    scans: list[Scan],
    images: list[Image],
    time_ns: int,
    limits_m: tuple[float, float],
    job: ExportJob,
) -> None:
    import cv2

    scan = next((scan for scan in scans if scan.sensor == calibration.lidar), None)
    own = [image for image in images if image.sensor == calibration.camera]
    own.sort(key=lambda image: image.channel not in calibration.channels)
    if scan is None or not own:
        return
    camera = job.rig.cameras[calibration.camera]
    picture = draw_projection(own[0], scan, camera.to_intrinsics(), calibration.T_cam_lidar, limits_m)
    is_done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    assert is_done
    message = typestore(False).types[_JPEG_TYPE](
        header=ros_header(own[0].stamp_ns or time_ns, camera.optical_frame),
        format="jpeg",
        data=np.asarray(data, dtype=np.uint8).ravel(),
    )
    topic = f"/lce_rig/{calibration.camera}/{calibration.lidar}/projected/compressed"
    topics.write(topic, _JPEG_TYPE, time_ns, message)
