"""Cameras are read as drivers, calibration tools and other programs write them."""

import cv2
import numpy as np
import pytest
import yaml

from lce_rig.core.errors import ProfileError, UsageError
from lce_rig.io.camera_description import CameraDescription, is_rectified, read_cameras

K = np.array([[897.5, 0, 635.4], [0, 896.8, 375.3], [0, 0, 1]])
D = (-0.44, 0.233, -0.001, 0.0002, -0.073)
P = np.array([[650.0, 0, 632, 0], [0, 829, 377, 0], [0, 0, 1, 0]])
SIZE = (1280, 720)


def described(**more):
    values = {"K": K, "distortion": D, "model": "plumb_bob", "size_px": SIZE, "P": P}
    return CameraDescription(**{**values, **more})


def info_file(model="plumb_bob", coefficients=D):
    return {
        "image_width": 1280, "image_height": 720, "camera_name": "front", "distortion_model": model,
        "camera_matrix": {"rows": 3, "cols": 3, "data": K.ravel().tolist()},
        "distortion_coefficients": {"rows": 1, "cols": len(coefficients), "data": list(coefficients)},
        "projection_matrix": {"rows": 3, "cols": 4, "data": P.ravel().tolist()},
    }  # fmt: skip


def write(tmp_path, text, name="camera.yaml"):
    path = tmp_path / name
    path.write_text(text if isinstance(text, str) else yaml.safe_dump(text), encoding="utf-8")
    return path


def echo(**more):
    fields = {
        "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "cam"}, "height": 720, "width": 1280,
        "distortion_model": "plumb_bob", "d": list(D), "k": K.ravel().tolist(), "p": P.ravel().tolist(),
        "binning_x": 0, "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }  # fmt: skip
    return yaml.safe_dump({**fields, **more}) + "---\n"


def ost(distortion="-0.44 0.233 -0.001 0.0002 -0.073"):
    matrix = "\n".join(" ".join(f"{value:f}" for value in row) for row in K)
    projection = "\n".join(" ".join(f"{value:f}" for value in row) for row in P)
    return (
        "# oST version 5.0 parameters\n\n\n[image]\n\nwidth\n1280\n\nheight\n720\n\n[front]\n\n"
        f"camera matrix\n{matrix}\n\ndistortion\n{distortion}\n\n"
        f"rectification\n1 0 0\n0 1 0\n0 0 1\n\nprojection\n{projection}\n"
    )


def livo2(**more):
    sizes = {"cam_model": "Pinhole", "cam_width": 1280, "cam_height": 720, "scale": 0.5}
    focal = {"cam_fx": 897.5, "cam_fy": 896.8, "cam_cx": 635.4, "cam_cy": 375.3}
    return {**sizes, **focal, **{f"cam_d{k}": value for k, value in enumerate(D[:4])}, **more}


def chain(*topics, **more):
    return {
        f"cam{k}": {
            "camera_model": "pinhole", "distortion_model": "radtan", "distortion_coeffs": list(D[:4]),
            "intrinsics": [897.5 + k, 896.8, 635.4, 375.3], "resolution": [1280, 720],
            "rostopic": topic, **more,
        }
        for k, topic in enumerate(topics)
    }  # fmt: skip


@pytest.mark.parametrize(
    ("content", "n"),
    [
        (info_file(), 5),
        (info_file("rational_polynomial", (*D, *[0.0] * 9)), 5),
        (echo(), 5),
        (echo() + echo(width=1), 5),
        (ost(), 5),
        (chain("/cam/image_raw"), 4),
        (livo2(), 4),
        ({"/**": {"ros__parameters": livo2()}}, 4),
        (info_file() | {"camera_matrix": K.tolist(), "D": list(D)}, 5),
    ],
)
def test_camera_file_each_form_gives_the_lens(tmp_path, content, n):
    lens, notes = read_cameras(write(tmp_path, content)).intrinsics()
    assert (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px) == (897.5, 896.8, 635.4, 375.3)
    assert (lens.width_px, lens.height_px, lens.model, lens.distortion) == (1280, 720, "radtan", D[:n])
    assert not notes


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
@pytest.mark.parametrize(
    ("matrix", "coefficients"),
    [("camera_matrix", "distortion_coefficients"), ("cameraMatrix", "distCoeffs"), ("K", "D"), ("M1", "D1")],
)
@pytest.mark.parametrize("has_size_list", [False, True])
def test_filestorage_its_namings_are_read(tmp_path, suffix, matrix, coefficients, has_size_list):
    path = tmp_path / f"lens{suffix}"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write(matrix, K)
    file.write(coefficients, np.array([D]))
    if has_size_list:
        file.write("image_size", np.array(SIZE))
    else:
        file.write("image_Width", 1280)
        file.write("image_Height", 720)
    file.release()
    lens, _ = read_cameras(path).intrinsics()
    assert np.array_equal(lens.matrix, K) and lens.distortion == D
    assert (lens.width_px, lens.height_px) == SIZE


def test_filestorage_fisheye_is_read_where_stated(tmp_path):
    path = tmp_path / "lens.xml"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in (("camera_matrix", K), ("dist_coeffs", np.array([D[:4]])), ("fisheye_model", 1)):
        file.write(key, value)
    file.release()
    camera = read_cameras(path)
    assert camera.intrinsics(image_px=SIZE)[0].model == "equidistant"
    with pytest.raises(ProfileError, match="no image size"):
        camera.intrinsics()


def test_camchain_camera_is_chosen_by_topic_or_name(tmp_path):
    cameras = read_cameras(write(tmp_path, chain("/left/image_raw", "/right/image_raw")))
    assert cameras.intrinsics("cam", ["/right/image_raw/compressed"])[0].fx_px == 898.5
    assert cameras.intrinsics("cam0")[0].fx_px == 897.5
    with pytest.raises(UsageError, match="2 cameras") as caught:
        cameras.intrinsics("front")
    assert "--camera cam0" in caught.value.hint


@pytest.mark.parametrize(
    ("content", "cause"),
    [
        (ost("0.1 0.01 0 0"), "4 coefficients"),
        (chain("/a", camera_model="omni", intrinsics=[1.0, 2, 3, 4, 5]), "'omni'"),
        (livo2(cam_model="ATAN"), "'ATAN'"),
        (info_file("rational_polynomial", (*D, 0, 0, 0, 0.01, 0, 0, 0, 0, 0)), "14 coefficients"),
        ({"camera_matrix": K.tolist()}, "no distortion_coefficients"),
        ({**info_file(), "camera_matrix": {"data": [0.0] * 9}}, "K is all zero"),
        ({"a": {"b": 1}}, "describes no camera"),
        ("%YAML:1.0\n---\nK: [1\n", "camera.yaml"),
        ("<opencv_storage><K", "camera.yaml"),
    ],
)
def test_camera_file_unusable_names_the_cause(tmp_path, content, cause):
    with pytest.raises(ProfileError, match=cause):
        read_cameras(write(tmp_path, content)).intrinsics()


def test_rectified_takes_the_projection_matrix(tmp_path):
    lens, notes = described(distortion=D).intrinsics(SIZE, is_rectified=True)
    assert (lens.fx_px, lens.cy_px, lens.distortion) == (650, 377, ()) and "P" in notes[0]
    with pytest.raises(ValueError, match="rectified"):
        described(P=np.zeros((3, 4))).intrinsics(SIZE, is_rectified=True)
    from_file, _ = read_cameras(write(tmp_path, ost())).intrinsics("cam", ["/cam/image_rect"], SIZE)
    assert from_file == lens


def test_rectified_by_a_turn_names_the_frame(tmp_path):
    R, _ = cv2.Rodrigues(np.radians([0.0, 0.8, 0.0]))
    path = write(tmp_path, echo(r=R.ravel().tolist()))
    _, notes = read_cameras(path).intrinsics("cam", ["/cam/image_rect"], SIZE)
    assert "0.8 deg away" in notes[1]


@pytest.mark.parametrize(
    ("topic", "expected"),
    [
        ("/camera/image_rect", True), ("/camera/image_rect_color/compressed", True),
        ("/zed/left/color/rect/image", True), ("/camera/image_raw", False),
        ("/direct/image", False), ("/camera/image_unrectified", False),
    ],
)  # fmt: skip
def test_is_rectified_by_the_words_of_a_topic(topic, expected):
    assert is_rectified(topic) == expected


def test_binning_and_roi_keep_the_rays_of_pixels():
    camera = described(binning=(2, 4), roi_px=(40, 100, 1200, 600))
    lens, notes = camera.intrinsics((600, 150))
    full, _ = described().intrinsics(SIZE)
    assert (lens.width_px, lens.height_px) == (600, 150) and "binning 2x4" in notes[0] and "roi" in notes[1]
    # Pixel (0, 0) is made of the columns 40 and 41 and the rows 100 to 103.
    assert lens.unproject(np.array([0.0, 0.0])) == pytest.approx(full.unproject(np.array([40.5, 101.5])))
    middle = lens.unproject(np.array([300.0, 75.0]))
    assert middle == pytest.approx(full.unproject(np.array([640.5, 401.5])))


@pytest.mark.parametrize(
    ("more", "image_px"),
    [
        ({"binning": (2, 2)}, SIZE),
        ({"roi_px": (0, 100, 1280, 620)}, SIZE),
        ({}, (1279, 719)),
        ({}, (1280, 710)),
    ],
)
def test_images_of_the_full_size_keep_the_lens(more, image_px):
    lens, _ = described(**more).intrinsics(image_px)
    assert (lens.cx_px, lens.cy_px, lens.width_px, lens.height_px) == (635.4, 375.3, *SIZE)


@pytest.mark.parametrize(
    ("more", "image_px", "cause"),
    [
        ({}, (640, 360), "If they were scaled: --intrinsics radtan,640x360,448.75,448.4,317.45,187.4"),
        ({"binning": (2, 2)}, (320, 240), "640x360 px, the images have 320x240 px"),
        ({"roi_px": (0, 100, 1280, 720)}, (1280, 720), "reaches beyond"),
        ({"size_px": (0, 0)}, None, "no image size"),
    ],
)
def test_images_of_another_size_are_refused(more, image_px, cause):
    with pytest.raises(ValueError, match=cause):
        described(**more).intrinsics(image_px)


def test_size_zero_is_that_of_the_images():
    lens, notes = described(size_px=(0, 0), binning=(2, 2)).intrinsics((640, 360))
    assert (lens.fx_px, lens.width_px, lens.height_px) == (448.75, 640, 360) and "0x0" in notes[0]


@pytest.mark.parametrize(
    ("model", "given", "used"),
    [
        ("plumb_bob", (*D, 0, 0, 0), D),
        ("plumb_bob", (*D, 0.1, 0, 0), (*D, 0.1, 0, 0)),
        ("rational_polynomial", (*D, 0.1, 0.2, 0.3, 0, 0, 0, 0, 0, 0), (*D, 0.1, 0.2, 0.3)),
        ("rational_polynomial", (*D, 0.1, 0.2, 0.3, 0, 0, 0, 0), (*D, 0.1, 0.2, 0.3)),
        ("equidistant", (0.1, 0.2, 0, 0, 0), (0.1, 0.2, 0, 0)),
        ("", (0, 0, 0, 0, 0), ()),
    ],
)
def test_trailing_zero_coefficients_select_shorter_model(model, given, used):
    assert described(model=model, distortion=given).intrinsics(SIZE)[0].distortion == used


@pytest.mark.parametrize(
    ("model", "given"),
    [("equidistant", (0.1, 0.2, 0, 0, 0.1)), ("rational_polynomial", (*D, 0, 0, 0, 0.1, 0, 0, 0)),
     ("plumb_bob", (0.1,)), ("equidistant", ()), ("thin_prism", D), ("", D)],
)  # fmt: skip
def test_coefficients_beyond_the_models_are_refused(model, given):
    with pytest.raises(ValueError, match=f"'{model}' with {len(given)} coefficients"):
        described(model=model, distortion=given).intrinsics(SIZE)
