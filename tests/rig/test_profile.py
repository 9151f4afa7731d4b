"""The schema: valid profiles, and mistakes that it rejects."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lce_rig.core.errors import ProfileError
from lce_rig.core.geometry import exp_so3
from lce_rig.rig import (
    CalibrationSettings,
    QualitySettings,
    dump_rig,
    find_profile,
    load_rig,
    parse_rig,
    set_value,
)
from lce_rig.rig.loading import Document, all_keys, rig_from_document
from lce_rig.rig.sensors import LidarSettings

RLFS = find_profile("rlfs").read_text(encoding="utf-8")
RLES = find_profile("rles").read_text(encoding="utf-8")


def refusal(*edits):
    """Edit rlfs.yaml and return the error or warnings."""
    text = RLFS
    for old, new in edits:
        assert old in text
        text = text.replace(old, new, 1)
    with pytest.raises(ProfileError) as caught:
        parse_rig(text, "mine.yaml")
    assert caught.value.exit_code == 3
    return str(caught.value)


def test_shipped_profiles_carry_the_published_numbers():
    rlfs, rles, sss = load_rig("rlfs"), load_rig("rles"), load_rig("sss")
    assert rlfs.cameras["cam"].to_intrinsics().fx_px == 897.4566
    assert rlfs.cameras["cam"].to_intrinsics().distortion == (-0.4398, 0.2329, -0.0011, 0.00020984, -0.0730)
    assert (rlfs.board.to_board().width_m, rlfs.board.to_board().height_m) == (0.767, 0.626)
    assert rles.board.inner_corners == (9, 6)
    assert [channel.kind for channel in rles.cameras["davis"].channels.values()] == ["frames", "events"]
    assert sss.cameras["cam"].to_intrinsics().distortion == ()
    assert sss.nominal("cam", "lidar") is None


def test_nominal_pose_forward_is_camera_axis():
    entry = load_rig("rles").nominal("davis", "lidar")
    np.testing.assert_allclose(entry.to_matrix()[:3, :3], [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(entry.to_matrix()[:3, 3], [0.126, -0.065, -0.080])


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("square_m: 0.070", "square_m: 70", "board.square_m"),
        ("square_m: 0.070", "square_m: 7", "board.square_m"),
        ("width_m: 0.767", "width_m: 767", "board.width_m"),
        ("square_m: 0.070", "square_m: -0.07", "board.square_m"),
        ("square_m: 0.070", "square_m: .nan", "board.square_m"),
        ("square_m: 0.070", "square_m: yes", "board.square_m"),
        ("[8, 6]           #", "[8]   #", "board.inner_corners"),
        ("fx_px: 897.4566", "fx: 897.4566", "cameras.cam.intrinsics.fx"),
        ("cx_px: 635.4040", "cx_pix: 635", "cameras.cam.intrinsics.cx_pix"),
        ("fx_px: 897.4566", "fx_px: 0.897", "cameras.cam.intrinsics.fx_px"),
        ("cx_px: 635.4040", "cx_px: 1300", "cameras.cam.intrinsics.cx_px"),
        ("-0.0730]", "-0.0730, 1.0]", "cameras.cam.intrinsics.distortion"),
        ("[0.664, 0.664,", "[0.664, 0.864,", "nominal_extrinsics.0.quaternion_wxyz"),
        ("camera: cam", "camera: kam", "nominal_extrinsics.0.camera"),
        ("frame: velodyne ", "frame: camera_link ", "cameras.cam.frame"),
        ("clock: utc", "clock: gps", "lidars.lidar.timestamps.clock"),
        ("reference: first_firing", "reference: start", "lidars.lidar.timestamps.reference"),
        ("controls: {}", "controls: {gain: [1]}", "cameras.cam.driver.controls.gain"),
        ("format_version: 1", "format_version: 2", "format_version"),
    ],
)
def test_each_profile_error_names_line_and_key(old, new, key):
    position, _, message = refusal((old, new)).partition(": ")
    assert message.startswith(f"{key}: ")
    source, _, line = position.partition(":")
    assert source == "mine.yaml"
    assert RLFS.replace(old, new, 1).splitlines()[int(line) - 1].strip().split(":")[0].strip("- ") in key


@pytest.mark.parametrize(
    ("edits", "facts"),
    [
        ([("fx_px: 897.4566", "fx: 897.4566")], ["fx_px"]),
        ([("cx_px: 635.4040", "cx_pix: 635")], ["cx_px"]),
        ([("board:", "target_sigma_m: 0.02\nboard:")], ["calibration"]),
        ([("width_m: 0.767", "width_m: 76.7")], ["5 m; 76.7 given", "write metres"]),
        # A pattern larger than the plate; sides swapped; squares counted for inner corners.
        ([("width_m: 0.767", "width_m: 0.3")], ["9x7", "70 mm", "0.63 x 0.49 m", "0.3 x 0.626 m"]),
        (
            [("width_m: 0.767", "width_m: 0.626"), ("height_m: 0.626", "height_m: 0.767")],
            ["swap width_m and height_m"],
        ),
        (
            [("[8, 6]", "[9, 7]"), ("width_m: 0.767", "width_m: 0.64"), ("height_m: 0.626", "height_m: 0.5")],
            ["count inner corners"],
        ),
    ],
)
def test_mistake_names_figure_or_key(edits, facts):
    text = refusal(*edits)
    assert all(fact in text for fact in facts)


def test_board_with_possibly_swapped_sides_gives_a_warning():
    turned = find_profile("sss").read_text(encoding="utf-8").replace("[8, 6]", "[6, 8]")
    assert [warning.code for warning in parse_rig(turned).warnings()] == ["profile.swapped_sides"]
    assert not list(load_rig("sss").warnings())


@pytest.mark.parametrize("size", ["[640, 360]", "[960, 540]", "[1920, 1080]", "[2560, 1440]"])
def test_intrinsics_of_another_resolution_are_noticed(size):
    assert "(about 1271x751 px)" in refusal(("[1280, 720]", size))


def test_all_problems_are_listed_at_once_in_the_files_order():
    text = refusal(
        ("square_m: 0.070", "square_m: 70"), ("fx_px: 897.4566", "fx: 897"), ("rate_hz: 10", "rate_hz: 0")
    )
    lines = text.splitlines()
    assert lines[0].split(": ") == ["mine.yaml", "3 problems"]
    assert [key in line for key, line in zip(("square_m", "rate_hz", "fx:"), lines[1:], strict=True)] == [
        True
    ] * 3


def rows(R):
    return str([[float(value) for value in row] for row in R])


@settings(max_examples=10)
@given(st.tuples(*[st.floats(-3, 3)] * 3))
def test_nominal_rotation_notations_agree(phi):
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec(phi)
    wxyz = [float(value) for value in np.roll(rotation.as_quat(), 1)]
    head, tail = RLFS.split("quaternion_wxyz: [0.664, 0.664, -0.242, 0.242]")
    for text in (f"quaternion_wxyz: {wxyz}", f"matrix: {rows(rotation.as_matrix())}"):
        entry = parse_rig(head + text + tail).nominal("cam", "lidar")
        np.testing.assert_allclose(entry.to_matrix()[:3, :3], exp_so3(np.array(phi)), atol=1e-9)


@pytest.mark.parametrize(
    "rotation",
    [
        "matrix: [[1, 0, 0], [0, 1, 0], [0, 0, 1.1]]",
        "matrix: [[1, 0, 0], [0, 1, 0], [0, 0, -1]]",
        "rpy_deg: [0, 0, 0]\n    matrix: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]",
        "tolerance_deg: 5.0",
    ],
)
def test_invalid_rotation_is_refused(rotation):
    text = RLFS.replace("    tolerance_deg: 5.0\n", "")
    text = text.replace("quaternion_wxyz: [0.664, 0.664, -0.242, 0.242]", rotation)
    with pytest.raises(ProfileError):
        parse_rig(text)


DOCUMENT = Path(__file__).parents[2] / "docs" / "rig-profiles.md"


def test_every_setting_is_documented():
    text = DOCUMENT.read_text(encoding="utf-8")
    assert [key for _, key in all_keys() if f"`{key}`" not in text] == []


def test_documented_defaults_are_those_of_the_code():
    documented = {}
    for line in DOCUMENT.read_text(encoding="utf-8").splitlines():
        keys, _, rest = line.removeprefix("| ").partition(" | ")
        values = rest.partition(" | ")[0].split(", ")
        # A key of the same name in a later block has another default.
        documented = dict(zip(re.findall(r"`(\w+)`", keys), values, strict=False)) | documented
    for model in (QualitySettings, CalibrationSettings, LidarSettings):
        for key, field in model.model_fields.items():
            if isinstance(field.default, int | float):
                assert float(documented[key]) == field.default, key


def test_unknown_driver_or_model_is_named():
    (unknown,) = parse_rig(RLFS.replace("model: VLP-16", "model: XY-64")).warnings()
    assert (unknown.code, unknown.subject) == ("profile.unknown_model", "lidars.lidar.model")
    assert "cameras.cam.driver.type" in refusal(("type: v4l2", "type: webcam"))


KIND = "        kind: events\n"
SYNC = """
sync:
  device: /dev/ttyACM0
  triggers:
    cam: {channel: 0, rate_hz: 20}
"""


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("cam: {", "kam: {", "sync.triggers.kam"),
        ("rate_hz: 20", "rate_hz: 20, pulse_us: 50000", "sync.triggers.cam.pulse_us"),
        ("rate_hz: 20", "rate_hz: 20, phase_us: 50000", "sync.triggers.cam.phase_us"),
        ("rate_hz: 20", "rate: 20", "sync.triggers.cam.rate"),
        ("channel: 0", "channel: 16", "sync.triggers.cam.channel"),
        ("rate_hz: 20}", "rate_hz: 20}\n    two: {channel: 0, rate_hz: 20}", "sync.triggers.two.channel"),
        ("  device: /dev/ttyACM0\n", "", "sync.device"),
        ("device:", "type: nmea\n  device:", "sync.type"),
    ],
)
def test_invalid_sync_board_names_its_key(old, new, key):
    with pytest.raises(ProfileError) as caught:
        parse_rig(RLFS + SYNC.replace(old, new))
    assert f"{key}: " in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"type": "charuco"}, "board.squares"),
        ({"type": "charuco", "squares": (9, 7), "marker_m": 0.05}, "board.dictionary"),
        (
            {"type": "charuco", "squares": (9, 7), "marker_m": 0.05, "dictionary": "5X5_99"},
            "board.dictionary",
        ),
        (
            {"type": "charuco", "squares": (9, 7), "marker_m": 0.07, "dictionary": "5X5_50"},
            "board.inner_corners",
        ),
        ({"tag_spacing": 0.3}, "board.tag_spacing"),
        ({"type": "aprilgrid", "tags": (6, 6), "tag_spacing": 0.3}, "board.inner_corners"),
        ({"first_id": 3}, "board.first_id"),
        ({"type": "circles"}, "board.type"),
    ],
)
def test_keys_of_another_type_of_board_are_named(changes, key):
    document = load_rig("rlfs").model_dump(mode="json", exclude_none=True)
    document["board"] |= changes
    with pytest.raises(ProfileError) as caught:
        rig_from_document(Document("mine.yaml", document, None))
    assert key in caught.value.what + caught.value.hint


@pytest.mark.parametrize(
    ("key", "size", "is_accepted"),
    [
        ("squares", (3, 3), False),
        ("squares", (2, 9), False),
        ("squares", (5, 3), True),
        ("tags", (1, 1), False),
        ("tags", (2, 1), True),
    ],
)
def test_boards_with_few_corners_are_refused(key, size, is_accepted):
    board = {
        "squares": {"type": "charuco", "marker_m": 0.05, "dictionary": "5X5_50"},
        "tags": {"type": "aprilgrid", "tag_spacing": 0.3},
    }[key]
    document = load_rig("rlfs").model_dump(mode="json", exclude_none=True)
    document["board"] = board | {key: size, "square_m": 0.07, "width_m": 0.8, "height_m": 0.8}
    if is_accepted:
        assert rig_from_document(Document("mine.yaml", document, None)).board.to_board().has_markers
        return
    with pytest.raises(ProfileError) as caught:
        rig_from_document(Document("mine.yaml", document, None))
    assert f"board.{key}" in caught.value.what + caught.value.hint


def test_marked_board_profile_reads_back():
    """Profiles without a type have a checkerboard."""
    document = load_rig("rlfs").model_dump(mode="json", exclude_none=True)
    assert load_rig("rlfs").board.type == "checkerboard"
    document["board"] = {
        "type": "charuco", "squares": (7, 5), "square_m": 0.1, "marker_m": 0.075, "dictionary": "DICT_4X4_50",
        "first_id": 20, "width_m": 0.8, "height_m": 0.6,
    }  # fmt: skip
    rig = rig_from_document(Document("mine.yaml", document, None))
    board = rig.board.to_board()
    assert (board.cols, board.rows, board.dictionary, board.first_id) == (6, 4, "4X4_50", 20)
    assert board.marker_share == pytest.approx(0.75)
    assert parse_rig(dump_rig(rig)) == rig


@pytest.mark.parametrize("exports", ["urdf", "[[urdf]]", "[{urdf: 1}]", "[urdf, nonsense]"])
def test_exports_must_be_a_list_of_formats(exports):
    with pytest.raises(ProfileError, match="exports"):
        parse_rig(set_value(RLFS, "exports", exports))
