"""A bag tells what a profile has to say of its sensors."""

import numpy as np
import pytest

from lce_rig.core.errors import SourceError, UsageError
from lce_rig.io.ros.topics import survey_bag
from lce_rig.pipeline.new_profile import new_profile, parse_board, parse_intrinsics
from lce_rig.rig import parse_rig

K = [897.5, 0.0, 635.4, 0.0, 896.8, 375.3, 0.0, 0.0, 1.0]
D = [-0.44, 0.233, -0.001, 0.0002, -0.073]


def camera_info(stamp_ns, model="plumb_bob", coefficients=D):
    return {
        "stamp_ns": stamp_ns, "width": 64, "height": 48, "distortion_model": model,
        "D": np.array(coefficients), "K": np.array(K), "R": np.eye(3).ravel(), "P": np.zeros(12),
        "binning_x": 0, "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }  # fmt: skip


def messages(room, cloud_message, image_message, info=None):
    pixels = np.zeros((48, 64, 3), np.uint8)
    for k in range(5):
        t = 10**18 + k * 50_000_000
        yield "/front/camera_info", "CameraInfo", t, info or camera_info(t)
        yield "/front/image_raw", "Image", t, image_message(pixels, t)
        if k % 2 == 0:
            yield "/rear/image_raw", "Image", t, image_message(pixels, t)
            yield "/points", "PointCloud2", t, cloud_message(room, t)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_sensors_rates_frames_rings_and_lenses_are_found(
    tmp_path, write_bag, room, cloud_message, image_message, kind
):
    path = write_bag(tmp_path / "bag", kind, messages(room, cloud_message, image_message))
    front, points, rear = survey_bag(path)
    assert (front.topic, front.kind, front.size_px, front.frame) == (
        "/front/image_raw",
        "frames",
        (64, 48),
        "sensor",
    )
    assert front.rate_hz == pytest.approx(20) and points.rate_hz == pytest.approx(10)
    assert (points.kind, points.n_rings, points.n_messages) == ("scans", 16, 3)
    assert front.intrinsics is not None and rear.intrinsics is None
    assert (front.intrinsics.fx_px, front.intrinsics.cy_px, front.intrinsics.width_px) == (897.5, 375.3, 64)
    assert front.intrinsics.distortion == tuple(D)


@pytest.mark.parametrize(
    "info",
    [camera_info(0, "plumb_bob", [0.1]), camera_info(0, "thin_prism"), {**camera_info(0), "K": np.zeros(9)}],
)
def test_a_lens_that_cannot_be_used_is_named_and_not_invented(
    tmp_path, write_bag, room, cloud_message, image_message, info
):
    path = write_bag(tmp_path / "bag", "ros1", messages(room, cloud_message, image_message, info))
    front = survey_bag(path)[0]
    assert front.intrinsics is None and front.note.startswith("/front/camera_info")


def test_a_bag_without_sensors_is_refused_with_what_it_holds(tmp_path, write_bag):
    path = write_bag(
        tmp_path / "bag", "ros1", [("/front/camera_info", "CameraInfo", 10**18, camera_info(10**18))]
    )
    with pytest.raises(SourceError) as caught:
        survey_bag(path)
    assert "/front/camera_info" in caught.value.hint


def test_a_camera_of_a_bag_without_a_lens_is_named(tmp_path, write_bag, room, cloud_message, image_message):
    path = write_bag(tmp_path / "bag", "ros1", messages(room, cloud_message, image_message))
    with pytest.raises(UsageError, match="rear"):
        new_profile("truck", parse_board("5x7,0.095,0.61x0.85"), recording=path)
    with pytest.raises(UsageError, match="2 cameras"):
        new_profile("truck", parse_board("5x7,0.095,0.61x0.85"), recording=path, cameras=["front"])
    lenses = [parse_intrinsics("radtan,64x48,50,50,32,24")] * 2
    rig = parse_rig(
        new_profile("truck", parse_board("5x7,0.095,0.61x0.85"), recording=path, intrinsics=lenses)[0]
    )
    assert list(rig.cameras) == ["front", "rear"]


@pytest.mark.parametrize(("model", "rate_hz"), [("Mid-360", 1.0), ("unstructured", 1.0), ("VLP-16", 10.0)])
def test_new_profile_rate_is_written_for_rings_only(
    tmp_path, write_bag, room, cloud_message, image_message, model, rate_hz
):
    sent = [each for each in messages(room, cloud_message, image_message) if "rear" not in each[0]]
    bag = write_bag(tmp_path / "bag", "mcap", sent)
    lens = parse_intrinsics("radtan,64x48,50,50,32,24,0,0,0,0")
    board = parse_board("8x6,0.07,0.767x0.626")
    text, _ = new_profile("a", board, recording=bag, lidar_model=model, intrinsics=[lens])
    assert parse_rig(text).lidars["lidar"].rate_hz == rate_hz
    assert ("rate_hz" in text) == (rate_hz == 10.0)
