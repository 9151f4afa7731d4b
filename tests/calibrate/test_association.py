"""Mirrored and wrongly paired captures are named as such, before any geometry."""

from dataclasses import replace

import pytest

from lce_rig.calibrate import CalibrateOptions
from lce_rig.calibrate.association import find_association_error
from lce_rig.calibrate.consensus import find_consensus
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.planar_pose import solve_planar_pose
from lce_rig.detect.detection import Detections, Pair
from lce_rig.detect.image.search import board_from_pose
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.pipeline.detect_session import association_errors
from lce_rig.rig import load_rig
from tests.calibrate.boards import BOARD, CAMERA, Scenario, simulate
from tests.calibrate.test_consensus import somewhere_else

N = 12
ACROSS, UPSIDE = (0, CAMERA.width_px), (1, CAMERA.height_px)


def mirrored(item, side=ACROSS):
    """Detect the board in the mirrored image: its corners are counted from the other side."""
    axis, size_px = side
    corners = item.image.corners_px.reshape(BOARD.rows, BOARD.cols, 2)[:, ::-1].reshape(-1, 2).copy()
    corners[:, axis] = size_px - 1 - corners[:, axis]
    solved = solve_planar_pose(corners, BOARD.corners(), CAMERA)
    return replace(item, pose=board_from_pose(corners, solved))


def dealt(captures, sources):
    """Assign to every capture the image of another."""
    images = [captures[k].image for k in sources]
    return [replace(item, pose=image) for item, image in zip(captures, images, strict=True)]


def error_in(captures):
    try:
        consensus = find_consensus(captures, BOARD)
    except NotEnoughDataError:
        consensus = None
    return find_association_error(captures, BOARD, consensus)


@pytest.fixture(scope="module")
def captures():
    return simulate(N, seed=5)


@pytest.mark.parametrize("side", [ACROSS, UPSIDE])
def test_association_of_mirrored_images_is_mirrored(captures, side):
    error = error_in([mirrored(item, side) for item in captures])
    assert (error.code, error.severity) == ("association.mirrored", "error")
    assert error.figures["n_explained"] >= N - 1
    assert error.figures["n_agreeing"] < N / 2
    assert "images or scans are mirrored" in error.text


@pytest.mark.parametrize("side", [ACROSS, UPSIDE])
def test_association_of_some_mirrored_lists_captures(captures, side):
    some = [mirrored(item, side) if k % 3 == 0 else item for k, item in enumerate(captures)]
    error = error_in(some)
    assert (error.code, error.severity) == ("association.mirrored", "warning")
    assert set(error.figures["captures"]) <= {captures[k].capture for k in range(0, N, 3)}
    assert error.figures["n_explained"] >= 3


@pytest.mark.parametrize(
    ("order", "sources"),
    [
        ("late", [N - 1, *range(N - 1)]),
        ("early", [*range(1, N), 0]),
        ("reversed", list(range(N))[::-1]),
    ],
)
def test_association_of_reordered_captures_names_order(captures, order, sources):
    error = error_in(dealt(captures, sources))
    assert (error.code, error.figures["order"]) == ("association.other_order", order)
    assert error.figures["n_explained"] >= N - 2


def test_association_of_two_exchanged_images_is_a_note(captures):
    error = error_in(dealt(captures, [0, 7, 2, 3, 4, 5, 6, 1, *range(8, N)]))
    assert (error.code, error.severity) == ("association.exchanged_images", "note")
    assert error.figures["captures"] == (captures[1].capture, captures[7].capture)


@pytest.mark.parametrize("seed", range(4))
def test_association_of_matching_captures_is_none(seed):
    narrow = Scenario(tilt_deg=(0.0, 10.0), distance_m=(2.0, 2.5))
    assert error_in(simulate(N, seed=seed)) is None
    assert error_in(simulate(N, seed=seed, scenario=narrow)) is None


@pytest.mark.parametrize("n_wrong", [2, 5, 9, N])
def test_association_of_other_plates_is_none(captures, n_wrong):
    wrong = [replace(item, surface=somewhere_else(k)) for k, item in enumerate(captures[:n_wrong])]
    assert error_in([*wrong, *captures[n_wrong:]]) is None


def detections_of(items):
    images = {item.capture: item.image for item in items}
    scans = {item.capture: [item.lidar] for item in items}
    return Detections({("cam", "frames"): images}, {"lidar": scans})


def test_calibrate_of_mirrored_images_names_it_alone(captures):
    rig, found = load_rig("rlfs"), detections_of([mirrored(item) for item in captures])
    with pytest.raises(NotEnoughDataError, match="mirrored") as caught:
        calibrate_detections(rig, found)
    assert caught.value.finding.code == "association.mirrored"
    assert [each.code for each in association_errors(rig, found, Pair("cam", "frames", "lidar"))] == [
        "association.mirrored"
    ]


@pytest.mark.long
def test_calibrate_of_some_mirrored_names_it_first(captures):
    some = [mirrored(item) if k % 2 else item for k, item in enumerate(captures)]
    (calibration,), _ = calibrate_detections(load_rig("rlfs"), detections_of(some), CalibrateOptions())
    assert [f.code for f in calibration.findings if f.severity != "note" and not f.follows] == [
        "association.mirrored"
    ]


def test_calibrate_few_consistent_captures_reports_disagreement(captures):
    alike = [replace(captures[0], capture=f"a{k}") for k in range(4)]
    wrong = [replace(item, surface=somewhere_else(k)) for k, item in enumerate(captures[:7])]
    with pytest.raises(NotEnoughDataError) as caught:
        calibrate_detections(load_rig("rlfs"), detections_of([*alike, *wrong]))
    assert caught.value.finding.code == "shortage.few_agree"
