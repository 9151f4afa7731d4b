"""Pictures and clouds from files, whole and damaged."""

import io

import cv2
import laspy
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.errors import SourceError
from lce_rig.core.pcd import encode_pcd
from lce_rig.io.decoding import decode_ply, read_cloud, read_image, to_8_bit
from tests.damage import damaged

POINTS = np.array(
    [(1.5, -2, 3, 7), (4, 5, 6, 9)], dtype=[("x", "f4"), ("y", "f4"), ("z", "f8"), ("ring", "u2")]
)
HEADER = (
    "ply\nformat {} 1.0\ncomment made by hand\nelement vertex 2\nproperty float x\nproperty float32 y\n"
    "property double z\nproperty ushort ring\nelement face 1\nproperty list uchar int corners\nend_header\n"
)


@pytest.fixture
def smooth():
    noise = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 3)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".ppm", ".PNG"])
def test_lossless_images_are_read_exactly(tmp_path, smooth, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(cv2.imencode(suffix.lower(), smooth)[1].tobytes())
    assert np.array_equal(read_image(path), smooth)


@pytest.mark.parametrize("suffix", [".png", ".pgm", ".bmp", ".tiff"])
def test_grey_images_stay_grey(tmp_path, smooth, suffix):
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), smooth[..., 0])
    assert np.array_equal(read_image(path), smooth[..., 0])


def test_jpeg_and_transparency_are_read(tmp_path, smooth):
    cv2.imwrite(str(tmp_path / "a.jpg"), smooth)
    assert np.abs(read_image(tmp_path / "a.jpg").astype(int) - smooth).mean() < 5
    cv2.imwrite(str(tmp_path / "a.png"), np.dstack([smooth, np.full((40, 60), 9, np.uint8)]))
    assert np.array_equal(read_image(tmp_path / "a.png"), smooth)


def test_deep_pictures_keep_their_contrast(tmp_path, smooth):
    twelve_bit = smooth[..., 0].astype(np.uint16) * 16
    cv2.imwrite(str(tmp_path / "a.png"), twelve_bit)
    read = read_image(tmp_path / "a.png")
    assert read.dtype == np.uint8 and np.ptp(read) == 255
    assert np.corrcoef(read.ravel(), smooth[..., 0].ravel())[0, 1] > 0.99
    with pytest.raises(ValueError, match="complex128"):
        to_8_bit(np.zeros((2, 2), complex))


@pytest.mark.parametrize("name", ["gone.png", "text.png", "gone.pcd", "folder.ply"])
def test_missing_and_unreadable_files_are_named(tmp_path, name):
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(SourceError, match=name):
        (read_image if name.endswith("png") else read_cloud)(tmp_path / name)


@pytest.mark.parametrize(("form", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_binary_ply_is_read(tmp_path, form, order):
    data = (
        HEADER.format(form).encode() + POINTS.astype(POINTS.dtype.newbyteorder(order)).tobytes() + bytes(13)
    )
    (tmp_path / "a.ply").write_bytes(data)
    read = read_cloud(tmp_path / "a.ply")
    assert all(np.array_equal(read[name], POINTS[name]) for name in POINTS.dtype.names)


def test_ply_text_skips_leading_elements():
    header = HEADER.format("ascii").replace(
        "element vertex", "element device 1\nproperty int id\nelement vertex"
    )
    read = decode_ply((header + "5\n1.5 -2 3 7\n4 5 6 9\n3 0 1 1\n").encode())
    assert all(np.array_equal(read[name], POINTS[name]) for name in POINTS.dtype.names)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"ply\n" * 20,
        HEADER.format("binary_middle_endian").encode(),
        HEADER.format("ascii").encode() + b"1 2 3 4\n",
        HEADER.format("ascii").encode() + b"1 2 3 4\n1 2 x 4\n",
        HEADER.format("binary_little_endian").encode() + bytes(20),
        HEADER.format("ascii").replace("vertex 2", "point 2").encode(),
        HEADER.format("ascii").replace("float x", "half x").encode(),
        HEADER.format("ascii").replace("property float x", "property list uchar int x").encode(),
    ],
)
def test_ply_without_all_its_vertices_is_refused(tmp_path, data):
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(SourceError, match=r"a\.ply: "):
        read_cloud(tmp_path / "a.ply")


def las():
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = np.full(3, 0.0005)
    header.add_extra_dim(laspy.ExtraBytesParams("Ring", np.uint8))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z, cloud.Ring = (POINTS[name] for name in ("x", "y", "z", "ring"))
    cloud.intensity = [30, 40]
    file = io.BytesIO()
    cloud.write(file)
    return file.getvalue()


@pytest.mark.parametrize("suffix", [".las", ".LAS"])
def test_las_is_read_in_metres_with_its_own_dimensions(tmp_path, suffix):
    (tmp_path / f"a{suffix}").write_bytes(las())
    read = read_cloud(tmp_path / f"a{suffix}")
    for name in POINTS.dtype.names:
        np.testing.assert_allclose(read[name], POINTS[name], atol=1e-9)
    assert list(read["intensity"]) == [30, 40]


@pytest.mark.parametrize("name", ["ascii.ply", "binary.ply", "a.pcd", "a.las", "a.png", "a.jpg"])
@given(data=st.data())
def test_damaged_files_are_read_or_refused_in_one_line(tmp_path_factory, name, data):
    small = np.arange(192, dtype=np.uint8).reshape(8, 8, 3)
    whole = {
        "ascii.ply": HEADER.format("ascii").encode() + b"1 2 3 4\n4 5 6 9\n3 0 1 1\n",
        "binary.ply": HEADER.format("binary_little_endian").encode() + POINTS.tobytes() + bytes(13),
        "a.pcd": encode_pcd(POINTS),
        "a.las": las(),
        "a.png": cv2.imencode(".png", small)[1].tobytes(),
        "a.jpg": cv2.imencode(".jpg", small)[1].tobytes(),
    }[name]
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes(data.draw(damaged(whole)))
    try:
        read_image(path) if name in ("a.png", "a.jpg") else read_cloud(path)
    except SourceError as error:
        assert name in error.what and "\n" not in error.what


def test_to_8_bit_infinite_pixels_are_zero():
    pixels = np.linspace(-3e38, 3e38, 64, dtype=np.float32).reshape(8, 8)
    pixels[0, 0] = np.nan
    assert to_8_bit(pixels)[0, 0] == 0 and to_8_bit(pixels).max() == 255
    with pytest.raises(ValueError):
        to_8_bit(np.full((4, 4), np.nan, np.float32))
