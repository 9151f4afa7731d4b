"""Bags of all three kinds, with various layouts, topics, timestamps and damage."""

import os
import shutil
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import SourceError
from lce_rig.io import SourceOptions, open_recording
from lce_rig.io.recording import ContinuousRecording
from lce_rig.io.ros.messages import decode_ros_image
from lce_rig.rig import load_rig
from tests.damage import damaged
from tests.notes import has_note
from tests.yuv import to_420, to_422

KINDS = ["ros1", "sqlite3", "mcap"]
CAM, LIDAR = "/camera/image_raw", "/velodyne_points"
T0_NS = 1_700_000_000 * 10**9
STEP_NS = 100_000_000


@pytest.fixture
def picture():
    noise = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 2)


@pytest.fixture
def stream(room, picture, cloud_message, image_message):
    """Messages of a camera and a LiDAR at 10 Hz."""

    def build(n, cam=CAM, lidar=LIDAR, t0_ns=T0_NS):
        for k in range(n):
            stamp_ns = t0_ns + k * STEP_NS
            yield lidar, "PointCloud2", stamp_ns + 2_000_000, cloud_message(room, stamp_ns)
            pixels = picture.copy()
            pixels[0, 0] = k % 256
            yield cam, "Image", stamp_ns + 60_000_000, image_message(pixels, stamp_ns + 50_000_000)

    return build


def read(recording):
    samples = list(recording.samples())
    return [s for s in samples if isinstance(s, Image)], [s for s in samples if isinstance(s, Scan)]


@pytest.mark.parametrize("kind", KINDS)
def test_every_message_is_read_with_its_header_stamp(tmp_path, rig, room, picture, write_bag, stream, kind):
    recording = open_recording(write_bag(tmp_path / "bag", kind, stream(5)), rig)
    assert isinstance(recording, ContinuousRecording) and recording.n_samples == 10
    images, scans = read(recording)
    assert [i.stamp_ns for i in images] == [T0_NS + 50_000_000 + k * STEP_NS for k in range(5)]
    assert [s.stamp_ns for s in scans] == [T0_NS + k * STEP_NS for k in range(5)]
    assert scans[0].host_ns == T0_NS + 2_000_000
    assert np.array_equal(images[2].pixels[1:], picture[1:])
    np.testing.assert_array_equal(scans[0].ring, room["ring"])
    np.testing.assert_array_equal(scans[0].points[:, 0], room["x"])
    assert scans[0].offset_ns.max() == pytest.approx(1e8, abs=100)


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_bag_without_metadata_is_read(tmp_path, rig, write_bag, stream, kind):
    """Also the storage file alone."""
    folder = write_bag(tmp_path / "bag", kind, stream(3))
    (file,) = (p for p in folder.iterdir() if p.suffix in (".db3", ".mcap"))
    assert len(read(open_recording(file, rig))[0]) == 3
    (folder / "metadata.yaml").unlink()
    assert len(read(open_recording(folder, rig))[0]) == 3


def test_a_folder_of_split_bags_is_read_in_order(tmp_path, rig, write_bag, stream):
    folder = tmp_path / "split"
    folder.mkdir()
    for k in range(2):
        write_bag(folder / f"part_{k}", "ros1", stream(3, t0_ns=T0_NS + 3 * k * STEP_NS))
    images, _ = read(open_recording(folder, rig))
    assert np.diff([i.stamp_ns for i in images]).tolist() == [STEP_NS] * 5


def _as_mosaic(bgr, pattern):
    letters = {"b": 0, "g": 1, "r": 2}
    mosaic = np.empty(bgr.shape[:2], np.uint8)
    for k, letter in enumerate(pattern):
        mosaic[k // 2 :: 2, k % 2 :: 2] = bgr[k // 2 :: 2, k % 2 :: 2, letters[letter]]
    return mosaic


@pytest.mark.parametrize(
    "encoding",
    ["mono8", "8UC1", "bgr8", "8UC3", "rgb8", "bgra8", "rgba8", "yuv422", "uyvy", "yuv422_yuy2", "mono16"]
    + [f"bayer_{pattern}8" for pattern in ("rggb", "bggr", "gbrg", "grbg")],
)
def test_bag_images_of_all_encodings_are_equal(
    tmp_path, rig, room, write_bag, cloud_message, image_message, encoding
):
    # Colours that change slowly, so that mosaics and half the chroma lose next to nothing.
    ramp = np.linspace(60, 200, 64)
    bgr = np.dstack([np.tile(ramp, (48, 1)), np.full((48, 64), 90), np.tile(ramp[::-1], (48, 1))]).astype(
        np.uint8
    )
    grey = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
    alpha = np.full((48, 64, 1), 7, np.uint8)
    pixels, wanted = {
        "mono8": (grey, grey), "8UC1": (grey, grey), "bgr8": (bgr, bgr), "8UC3": (bgr, bgr),
        "rgb8": (bgr[..., ::-1], bgr), "bgra8": (np.dstack([bgr, alpha]), bgr),
        "rgba8": (np.dstack([bgr[..., ::-1], alpha]), bgr), "yuv422": (to_422(bgr, "uyvy"), bgr),
        "uyvy": (to_422(bgr, "uyvy"), bgr), "yuv422_yuy2": (to_422(bgr, "yuyv"), bgr),
        "mono16": (grey.astype(np.uint16) * 256, None),
    }.get(encoding) or (_as_mosaic(bgr, encoding[6:10]), bgr)  # fmt: skip
    messages = [
        (LIDAR, "PointCloud2", T0_NS, cloud_message(room, T0_NS)),
        (CAM, "Image", T0_NS, image_message(np.ascontiguousarray(pixels), T0_NS, encoding)),
    ]
    (image,), _ = read(open_recording(write_bag(tmp_path / "bag", "sqlite3", messages), rig))
    if wanted is None:
        assert (
            image.pixels.dtype == np.uint8 and np.corrcoef(image.pixels.ravel(), grey.ravel())[0, 1] > 0.999
        )
    else:
        assert image.pixels.shape == wanted.shape
        inner = (slice(2, -2), slice(2, -2))
        assert np.abs(image.pixels[inner].astype(int) - wanted[inner]).max() <= 12


@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
@pytest.mark.parametrize("n_padding", [0, 16])
@pytest.mark.parametrize("counts_both_planes", [False, True])
def test_image_of_two_planes_is_decoded(image_message, encoding, n_padding, counts_both_planes):
    ramp = np.linspace(60, 200, 64)
    bgr = np.dstack([np.tile(ramp, (48, 1)), np.full((48, 64), 90), np.tile(ramp[::-1], (48, 1))])
    bgr = bgr.astype(np.uint8)
    planes = np.pad(to_420(bgr, encoding), ((0, 0), (0, n_padding)))
    fields = {**image_message(planes, T0_NS, encoding), "width": 64, "step": planes.shape[1]}
    fields["height"] = 72 if counts_both_planes else 48
    pixels = decode_ros_image(SimpleNamespace(**fields))
    assert pixels.shape == bgr.shape
    assert np.abs(pixels.astype(int) - bgr).max() <= 12
    fields["data"] = fields["data"][:-1]
    with pytest.raises(ValueError, match="bytes are not"):
        decode_ros_image(SimpleNamespace(**fields))


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_bag_compressed_images_are_found(tmp_path, rig, room, picture, write_bag, cloud_message, suffix):
    data = cv2.imencode(suffix, picture)[1].ravel()
    fields = {"stamp_ns": T0_NS, "format": f"bgr8; {suffix[1:]} compressed bgr8", "data": data}
    messages = [
        (LIDAR, "PointCloud2", T0_NS, cloud_message(room, T0_NS)),
        (f"{CAM}/compressed", "CompressedImage", T0_NS, fields),
    ]
    (image,), _ = read(open_recording(write_bag(tmp_path / "bag", "ros1", messages), rig))
    assert np.abs(image.pixels.astype(int) - picture).mean() < (8 if suffix == ".jpg" else 1e-9)


def test_bag_wrong_topics_list_the_others(tmp_path, rig, write_bag, stream):
    bag = write_bag(tmp_path / "bag", "ros1", stream(2, cam="/front/image", lidar="/points"))
    with pytest.raises(SourceError) as caught:
        open_recording(bag, rig)
    assert has_note([caught.value.hint], "/front/image", "Image, 2", "/points", "PointCloud2, 2")
    topics = {"cam": "/front/image", "lidar": "/points"}
    images, scans = read(open_recording(bag, rig, SourceOptions(topics=topics)))
    assert (len(images), len(scans)) == (2, 2)
    for wrong, name in [({"cam": "/x"}, "/x"), ({"cam": "/points"}, "PointCloud2"), ({"side": "/x"}, "side")]:
        with pytest.raises(SourceError, match=name):
            open_recording(bag, rig, SourceOptions(topics={**topics, **wrong}))


def test_bag_absent_channel_is_skipped(tmp_path, write_bag, stream):
    rig = load_rig("rles")
    bag = write_bag(tmp_path / "bag", "ros1", stream(2, cam="/davis/image_raw"))
    images, scans = read(open_recording(bag, rig))
    assert {i.channel for i in images} == {"frames"} and len(scans) == 2


def test_bag_backward_times_are_skipped(
    tmp_path, rig, room, picture, write_bag, cloud_message, image_message
):
    order = [0, 1, 3, 2, 3, 4]
    messages = [
        message
        for k, place in enumerate(order)
        for message in (
            (LIDAR, "PointCloud2", T0_NS + k * STEP_NS, cloud_message(room, T0_NS + place * STEP_NS)),
            (CAM, "Image", T0_NS + k * STEP_NS + 1, image_message(picture, T0_NS + k * STEP_NS)),
        )
    ]
    recording = open_recording(write_bag(tmp_path / "bag", "sqlite3", messages), rig)
    images, scans = read(recording)
    assert len(images) == 6 and [(s.stamp_ns - T0_NS) // STEP_NS for s in scans] == [0, 1, 3, 4]
    assert has_note(recording.notes, LIDAR, "2")


def test_bag_clock_set_back_restarts_order(tmp_path, rig, write_bag, stream):
    messages = [*stream(3)]
    hour_ns = 3600 * 10**9
    earlier = stream(3, t0_ns=T0_NS - hour_ns)
    messages += [(topic, msgtype, log_ns + 2 * hour_ns, f) for topic, msgtype, log_ns, f in earlier]
    recording = open_recording(write_bag(tmp_path / "bag", "ros1", messages), rig)
    images, scans = read(recording)
    assert (len(images), len(scans)) == (6, 6)
    assert has_note(recording.notes, CAM, "1 jumps", "clock back")


def test_messages_without_timestamps_use_time_of_receipt(
    tmp_path, rig, room, picture, write_bag, cloud_message, image_message
):
    messages = [
        (LIDAR, "PointCloud2", T0_NS + 5, cloud_message(room, 0)),
        (CAM, "Image", T0_NS + 7, image_message(picture, 0)),
    ]
    recording = open_recording(write_bag(tmp_path / "bag", "ros1", messages), rig)
    (image,), (scan,) = read(recording)
    assert (image.stamp_ns, scan.stamp_ns) == (T0_NS + 7, T0_NS + 5)
    assert has_note(recording.notes, CAM, "no timestamps", "of receipt")


def test_bag_broken_messages_are_counted(
    tmp_path, rig, room, picture, write_bag, cloud_message, image_message
):
    def messages(n_bad):
        for k in range(3):
            stamp_ns = T0_NS + k * STEP_NS
            cloud, image = cloud_message(room, stamp_ns), image_message(picture, stamp_ns)
            if k < n_bad:
                cloud["data"], image["encoding"] = cloud["data"][:-1], "bgr9"
            yield LIDAR, "PointCloud2", stamp_ns, cloud
            yield CAM, "Image", stamp_ns, image

    recording = open_recording(write_bag(tmp_path / "some", "mcap", messages(1)), rig)
    images, scans = read(recording)
    assert (len(images), len(scans)) == (2, 2)
    n_bytes = len(room) * 22
    cause = f"{n_bytes - 1} of {n_bytes} bytes"
    assert has_note(recording.notes, LIDAR, "1 could not", cause)
    with pytest.raises(SourceError):
        read(open_recording(write_bag(tmp_path / "all", "mcap", messages(3)), rig))


def _only_file(bag):
    return bag if bag.is_file() else next(p for p in bag.iterdir() if p.suffix in (".db3", ".mcap"))


@pytest.mark.parametrize("name", ["killed.bag", "killed.mcap", "killed.db3"])
@pytest.mark.parametrize("is_beside_a_whole_one", [False, True])
def test_bag_unfinished_names_repair_tool(tmp_path, rig, write_bag, stream, name, is_beside_a_whole_one):
    kind = {".bag": "ros1", ".mcap": "mcap", ".db3": "sqlite3"}[name[-4:].replace("mcap", ".mcap")]
    whole = _only_file(write_bag(tmp_path / "bag", kind, stream(30)))
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / name).write_bytes(whole.read_bytes()[: whole.stat().st_size // 3])
    samples = []
    if is_beside_a_whole_one:
        shutil.copy(whole, folder / f"whole{whole.suffix}")
    with pytest.raises(SourceError) as caught:
        for sample in open_recording(folder if is_beside_a_whole_one else folder / name, rig).samples():
            samples.append(sample)
    assert len(samples) == (60 if is_beside_a_whole_one else 0)
    assert name in caught.value.what
    assert ("recover" if kind == "mcap" else "reindex") in caught.value.hint


def test_bag_damage_ends_the_samples(tmp_path, rig, write_bag, stream):
    file = write_bag(tmp_path / "bag", "ros1", stream(60))
    damaged = bytearray(file.read_bytes())
    place = damaged.index(b"op=\2", len(damaged) // 2)
    damaged[place : place + 2] = b"??"
    file.write_bytes(bytes(damaged))
    samples = []
    with pytest.raises(SourceError, match=file.name):
        for sample in open_recording(file, rig).samples():
            samples.append(sample)
    assert 30 < len(samples) < 90


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=60, deadline=None, derandomize=True)
@given(data=st.data())
def test_bag_damaged_gives_source_error(small_bags, rig, kind, data):
    """Any beginning and any flipped byte: data or a SourceError."""
    whole, path = small_bags[kind]
    path.write_bytes(data.draw(damaged(whole)))
    try:
        for sample in open_recording(path, rig).samples():
            assert isinstance(sample, Image | Scan)
    except SourceError as error:
        assert path.name in error.what


@pytest.fixture(scope="module")
def small_bags(tmp_path_factory, write_bag, room, cloud_message, image_message):
    """Content of a bag of each kind, and a path for a damaged copy."""
    pixels = np.zeros((4, 6), np.uint8)
    bags = {}
    for kind in KINDS:
        folder = tmp_path_factory.mktemp(kind)
        messages = [
            (LIDAR, "PointCloud2", T0_NS, cloud_message(room[::90], T0_NS)),
            (CAM, "Image", T0_NS + 1, image_message(pixels, T0_NS, "mono8")),
        ]
        file = _only_file(write_bag(folder / "bag", kind, messages))
        bags[kind] = file.read_bytes(), folder / f"damaged{file.suffix}"
    return bags


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3", ".pcap", ".pcapng"])
def test_open_pipes_and_devices_are_refused(tmp_path, rig, suffix):
    os.mkfifo(tmp_path / f"pipe{suffix}")
    (tmp_path / f"zero{suffix}").symlink_to("/dev/zero")
    for name in ("pipe", "zero"):
        with pytest.raises(SourceError, match=name):
            open_recording(tmp_path / f"{name}{suffix}", rig)


def test_long_bags_are_streamed(tmp_path, rig, write_bag, room, cloud_message, image_message):
    import tracemalloc

    pixels = np.zeros((400, 600, 3), np.uint8)

    def messages(n):
        for k in range(n):
            yield CAM, "Image", T0_NS + k, image_message(pixels, T0_NS + k)
        yield LIDAR, "PointCloud2", T0_NS + n, cloud_message(room, T0_NS)

    recording = open_recording(write_bag(tmp_path / "bag", "ros1", messages(60)), rig)
    tracemalloc.start()
    n = sum(1 for _ in recording.samples())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert n == 61 and peak < 12 * pixels.nbytes


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
@pytest.mark.parametrize("form", ["folder", "no_metadata", "file", "upper_case"])
def test_open_recording_compressed_bag_in_any_form(tmp_path, rig, write_bag, stream, mode, kind, form):
    folder = write_bag(tmp_path / "bag", kind, stream(3), mode)
    path = next(file for file in folder.iterdir() if file.name != "metadata.yaml")
    if form == "no_metadata":
        (folder / "metadata.yaml").unlink()
    elif form == "upper_case":
        path = path.rename(tmp_path / path.name.upper())
    images, scans = read(open_recording(path if form in ("file", "upper_case") else folder, rig))
    assert (len(images), len(scans)) == (3, 3)


@pytest.mark.parametrize("name", ["a.bag", "a.bag.active", "a.db3", "a.mcap", "a.db3.zstd", "a.mcap.zst"])
@pytest.mark.parametrize("content", [b"", b"\xb5\x00\xff" * 99, b"a: [b"])
def test_open_recording_no_bag_is_named_without_codecs(tmp_path, rig, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SourceError, match=r"content is not that of|not compressed by zstd") as caught:
        open_recording(tmp_path / name, rig)
    assert not {"codec", "YAML", "Error"} & set(str(caught.value).split())


def test_open_recording_unclosed_bag_names_reindex(tmp_path, rig, write_bag, stream):
    whole = write_bag(tmp_path / "bag", "ros1", stream(9))
    path = tmp_path / "drive.bag.active"
    path.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
    with pytest.raises(SourceError) as caught:
        open_recording(path, rig)
    assert "rosbag reindex drive.bag.active" in caught.value.hint
    path.write_bytes(whole.read_bytes())
    assert len(read(open_recording(path, rig))[0]) == 9
