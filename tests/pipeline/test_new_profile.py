"""A new rig's profile, from numbers or a bag, holds only the given values."""

import numpy as np
import pytest

from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import ProfileError, UsageError
from lce_rig.export.ros_files import camera_info_text
from lce_rig.pipeline.new_profile import new_profile, parse_board, parse_intrinsics
from lce_rig.rig import parse_rig

BOARD = "5x7,0.095,0.61x0.85,0.002,0"
LENS = "equidistant,1920x1208,959.554,960.194,940.789,670.737,-0.097824,0.141429,-0.148385,0.055918"


def test_numbers_alone_make_a_profile():
    text, _ = new_profile(
        "os1", parse_board(BOARD), lidar_model="OS1-64", intrinsics=[parse_intrinsics(LENS)]
    )
    rig = parse_rig(text)
    assert (rig.lidars["lidar"].model, rig.board.inner_corners) == ("OS1-64", (5, 7))
    lens = rig.cameras["cam"].to_intrinsics()
    assert lens == parse_intrinsics(LENS)
    assert lens.distortion == (-0.097824, 0.141429, -0.148385, 0.055918)
    assert (rig.board.square_m, rig.board.width_m, rig.board.pattern_offset_m) == (0.095, 0.61, (0.002, 0.0))
    assert not rig.nominal_extrinsics and rig.lidars["lidar"].driver.type is None


@pytest.mark.parametrize(
    "board", ["charuco:9x7,0.07,0.0525,5X5_50,0.767x0.626", "aprilgrid:4x3,0.13,0.3,0.767x0.626,0.01,0"]
)
def test_board_with_markers_is_written_as_given(board):
    text, _ = new_profile("a", parse_board(board), intrinsics=[parse_intrinsics(LENS)])
    assert parse_rig(text).board.to_board() == parse_board(board)


def test_camera_info_file_of_any_tool_is_accepted(tmp_path):
    lens = Intrinsics(897.5, 896.8, 635.4, 375.3, 1280, 720, "radtan", (-0.44, 0.233, -0.001, 0.0002, -0.073))
    path = tmp_path / "camera_info.yaml"
    # A calibrated camera's projection matrix is of the rectified image.
    head, _ = camera_info_text("cam", lens, []).split("projection_matrix:")
    path.write_text(
        head + "projection_matrix: {rows: 3, cols: 4, data: [8, 0, 6, 0, 0, 8, 3, 0, 0, 0, 1, 0]}"
    )
    assert parse_intrinsics(str(path)).intrinsics()[0] == lens
    rig = parse_rig(new_profile("a", parse_board(BOARD), cameras=["front"], intrinsics=[lens])[0])
    assert rig.cameras["front"].to_intrinsics() == lens


@pytest.mark.parametrize("text", ["", "8x6", "8x6,0.07", "8x6,0.07,0.7", "8x6,a,0.7x0.6", "8,6,0.07,0.7x0.6"])
def test_malformed_board_is_usage_error(text):
    with pytest.raises(UsageError):
        parse_board(text)


@pytest.mark.parametrize("text", ["radtan,640x480,1,2", "radtan,640,1,2,3,4", "pinhole,640x480,1,2,3,4"])
def test_intrinsics_written_otherwise_are_a_usage_error(text):
    with pytest.raises(UsageError):
        parse_intrinsics(text)


@pytest.mark.parametrize("content", ["", "[1, 2]", "a: 1", "camera_matrix: {data: [1]}", "\x00", "a: [b"])
def test_file_without_camera_info_is_named(tmp_path, content):
    path = tmp_path / "info.yaml"
    path.write_text(content)
    with pytest.raises(ProfileError, match=r"info\.yaml"):
        parse_intrinsics(str(path))


def write_cloud(path, elevations_deg, columns):
    """A room seen by lasers 10 mm above the origin at most, in firing order."""
    rng = np.random.default_rng(3)
    azimuth = -2 * np.pi * np.arange(columns) / columns
    azimuth, elevation = (
        each.ravel() for each in np.meshgrid(azimuth, np.radians(elevations_deg), indexing="ij")
    )
    height_m = 0.01 * np.sin(5 * elevation)
    rho = 3.0 + 1.5 * np.sin(3 * azimuth) + 0.01 * rng.standard_normal(len(azimuth))
    z = rho * np.tan(elevation) + height_m
    ring = np.tile(np.arange(len(elevations_deg)), columns)
    rows = np.stack([rho * np.cos(azimuth), rho * np.sin(azimuth), z, ring], axis=1)
    head = (
        "VERSION 0.7\nFIELDS x y z ring\nSIZE 4 4 4 2\nTYPE F F F U\nCOUNT 1 1 1 1\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nPOINTS {len(rows)}\nDATA ascii\n"
    )
    path.parent.mkdir(parents=True)
    path.write_text(head + "\n".join(f"{x:.5f} {y:.5f} {z:.5f} {int(k)}" for x, y, z, k in rows))


def test_new_profile_measures_unknown_beams(tmp_path):
    elevations_deg = np.sort(np.r_[np.linspace(-20, -6, 8), np.linspace(-5, 5, 16), [8, 14]])
    write_cloud(tmp_path / "pcd" / "0.pcd", elevations_deg, 900)
    lens = parse_intrinsics("radtan,1280x720,897.5,896.8,635.4,375.3,-0.44,0.23,0,0")
    text, found = new_profile(
        "mine", parse_board(BOARD), recording=tmp_path, lidar_model="other", intrinsics=[lens]
    )
    settings = parse_rig(text).lidars["lidar"]
    assert np.array(settings.elevations_deg) == pytest.approx(elevations_deg, abs=0.05)
    assert settings.columns == 900
    assert settings.data_sheet() is not None and "26 rings" in found[0]
    # Of a known model, its data sheet counts.
    text, _ = new_profile("a", parse_board(BOARD), recording=tmp_path, lidar_model="XT32", intrinsics=[lens])
    assert parse_rig(text).lidars["lidar"].elevations_deg is None
