"""Sensors of a profile from a bag."""

import numpy as np
import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

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


def messages(room, cloud_message, image_message, info=None, encoding="bgr8"):
    pixels = np.zeros((48, 64, 3), np.uint8)
    for k in range(5):
        t = 10**18 + k * 50_000_000
        yield "/front/camera_info", "CameraInfo", t, info or camera_info(t)
        yield "/front/image_raw", "Image", t, image_message(pixels, t)
        if k % 2 == 0:
            yield "/rear/image_raw", "Image", t, image_message(pixels, t, encoding)
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
def test_survey_unusable_lens_is_named(tmp_path, write_bag, room, cloud_message, image_message, info):
    path = write_bag(tmp_path / "bag", "ros1", messages(room, cloud_message, image_message, info))
    front = survey_bag(path)[0]
    assert front.intrinsics is None and front.note.startswith("/front/camera_info")


def test_survey_without_sensors_lists_topics(tmp_path, write_bag):
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


def test_survey_undecodable_topics_are_listed(tmp_path, write_bag, room, cloud_message, image_message):
    sent = messages(room, cloud_message, image_message, encoding="32FC1")
    path = write_bag(tmp_path / "bag", "mcap", sent)
    _, notes = new_profile("truck", parse_board("5x7,0.095,0.61x0.85"), recording=path, intrinsics=[LENS])
    assert any("/rear/image_raw: skipped, its encoding '32fc1' is not known" in note for note in notes)


def test_survey_video_topics_are_listed(tmp_path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    name = "foxglove_msgs/msg/CompressedVideo"
    store.register(get_types_from_msg("uint8[] data", name))
    with Writer(tmp_path / "bag", version=9) as writer:
        connection = writer.add_connection("/front/video", name, typestore=store)
        message = store.types[name](np.zeros(8, np.uint8))
        writer.write(connection, 10**18, store.serialize_cdr(message, name))
    with pytest.raises(SourceError) as caught:
        survey_bag(tmp_path / "bag")
    assert "/front/video: skipped, foxglove_msgs/CompressedVideo is not supported" in caught.value.hint


LENS = parse_intrinsics("radtan,64x48,50,50,32,24")
SMALL = np.array([50.0, 0, 32, 0, 50, 24, 0, 0, 1])
RECTIFIED = np.array([45.0, 0, 31, 0, 0, 45, 23, 0, 0, 0, 1, 0])


@pytest.mark.parametrize("kind", ["ros1", "sqlite3"])
def test_survey_each_image_has_its_own_camera_info(tmp_path, write_bag, image_message, kind):
    pixels, t = np.zeros((48, 64, 3), np.uint8), 10**18
    infos = {
        name: {**camera_info(t), "K": SMALL + [k, 0, 0, 0, 0, 0, 0, 0, 0], "P": RECTIFIED}
        for k, name in enumerate(
            (
                "/a/camera_info",
                "/a/image_x/camera_info",
                "/s/left_camera_info",
                "/s/right_camera_info",
                "/t/x_camera_info",
                "/r/camera_info",
            )
        )
    }
    images = (
        "/a/image_raw",
        "/r/image_rect_color",
        "/a/image_x",
        "/s/left_image",
        "/s/right_image",
        "/t/image",
    )
    sent = [(name, "CameraInfo", t, info) for name, info in infos.items()]
    sent += [(name, "Image", t, image_message(pixels, t)) for name in images]
    found = {topic.topic: topic for topic in survey_bag(write_bag(tmp_path / "bag", kind, sent))}
    focal = {name: topic.intrinsics and topic.intrinsics.fx_px for name, topic in found.items()}
    assert focal == dict(zip(images, (50, 45, 51, 52, 53, None), strict=True))
    rectified = found["/r/image_rect_color"]
    assert rectified.intrinsics.distortion == () and "P without distortion" in rectified.note


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ({"width": 0, "height": 0}, "it states 0x0 px"),
        ({"width": 128, "height": 96, "binning_x": 2, "binning_y": 2}, "binning 2x2 applied"),
        ({"width": 128, "height": 96}, "it belongs to 128x96 px, the images have 64x48 px"),
        ({"K": np.zeros(9)}, "uncalibrated, K is all zero"),
    ],
)
def test_survey_camera_info_notes_name_its_topic(tmp_path, write_bag, image_message, more, told):
    t = 10**18
    info = {**camera_info(t), "K": SMALL, **more}
    sent = [("/a/camera_info", "CameraInfo", t, info)]
    sent += [("/a/image", "Image", t, image_message(np.zeros((48, 64), np.uint8), t, "mono8"))]
    (found,) = survey_bag(write_bag(tmp_path / "bag", "ros1", sent))
    assert found.note.startswith("/a/camera_info: ") and told in found.note


def test_survey_computed_images_are_no_second_camera(tmp_path, write_bag, image_message):
    pixels, t = np.zeros((48, 64, 3), np.uint8), 10**18
    names = ("/a/image_raw", "/a/image_rect_color", "/a/image_mono", "/b/image_rect")
    sent = [(name, "Image", t, image_message(pixels, t)) for name in names]
    skipped = []
    found = survey_bag(write_bag(tmp_path / "bag", "ros1", sent), skipped)
    assert [topic.topic for topic in found] == ["/a/image_raw", "/b/image_rect"]
    assert skipped[1] == "/a/image_rect_color: skipped, it is computed from /a/image_raw"


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
