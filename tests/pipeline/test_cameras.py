"""Cameras of one session: estimated together where they share boards, else compared."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lce_rig.calibrate import CalibrateOptions
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import difference, invert
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import load_rig
from tests.calibrate.boards import in_use
from tests.calibrate.two_cameras import LEFT, RIGHT, T_RIGHT_LEFT, TRUTH, simulate_two

RIG = load_rig(str(Path(__file__).parents[1] / "rigs" / "two_cameras.yaml"))
ML, PAPER = CalibrateOptions(method="ml"), CalibrateOptions("paper")
TURNED = np.array([0, 0, 0, 0, np.radians(0.6), 0])


def detections(session, **kept):
    """Build simulated detections; `kept` lists, by camera, the captures with a detected board."""
    unseen = Refusal("image.too_dark", figures={"grey_99": 20.0})
    images = {
        (name, "frames"): {
            c.capture: c.image if k in kept.get(name, range(len(captures))) else unseen
            for k, c in enumerate(captures)
        }
        for name, captures in session.items()
    }
    return Detections(images, {"lidar": {c.capture: list(c.places) for c in next(iter(session.values()))}})


def calibrated(seen, options, rig=RIG):
    pairs, shortages = calibrate_detections(rig, seen, options)
    assert not shortages
    return {calibration.camera: calibration for calibration in pairs}


@pytest.fixture(scope="module")
def session():
    return simulate_two(12, 0)


@pytest.fixture(scope="module")
def together(session):
    return calibrated(detections(session), ML)


@pytest.fixture(scope="module")
def by_paper(session):
    return calibrated(detections(session), PAPER)


def test_cameras_with_shared_boards_are_estimated_jointly(together):
    for name, other in ((LEFT, RIGHT), (RIGHT, LEFT)):
        own = together[name]
        assert own.verdict == "pass"
        assert own.method == "ml"
        assert own.estimated_with == (other,)
        error = difference(in_use(own.T_cam_lidar, own.intrinsics), TRUTH[name])
        assert error @ np.linalg.solve(own.cov, error) < 25  # 0.9997 of chi square with 6 degrees
        assert own.estimated_with == (other,)


def test_other_camera_is_given_on_both_sides(together):
    (to_left,), (to_right,) = (together[name].other_cameras for name in (RIGHT, LEFT))
    assert (to_left.camera, to_left.n_captures) == (LEFT, 12)
    assert (to_right.camera, to_right.n_captures) == (RIGHT, 12)
    T_right, T_left = (in_use(c.T_cam_lidar, c.intrinsics) for c in (together[RIGHT], together[LEFT]))
    T_right_left = T_right @ invert(T_left)
    for other, T, truth in (
        (to_left, T_right_left, T_RIGHT_LEFT),
        (to_right, invert(T_right_left), invert(T_RIGHT_LEFT)),
    ):
        error = difference(T, truth)
        assert error @ np.linalg.solve(other.cov, error) < 25
        assert np.linalg.norm(error[:3]) < 0.001
        assert other.apart_rotation_deg < 0.1
        assert other.board_rms_m < 0.003
    assert np.allclose(to_left.T_cam_other, invert(to_right.T_cam_other))


@pytest.mark.long
def test_other_methods_only_compare_cameras(session, by_paper):
    for name in (LEFT, RIGHT):
        alone = detections({name: session[name]})
        (own,) = calibrated(alone, PAPER, only(name)).values()
        assert np.array_equal(own.T_cam_lidar, by_paper[name].T_cam_lidar)
        assert by_paper[name].estimated_with == ()
        (other,) = by_paper[name].other_cameras
        assert other.cov is None
        assert other.apart_rotation_deg < 0.2


def only(camera):
    data = RIG.model_dump()
    data["cameras"] = {camera: data["cameras"][camera]}
    data["nominal_extrinsics"] = [e for e in data["nominal_extrinsics"] if e["camera"] == camera]
    return type(RIG).model_validate(data)


def test_cameras_without_a_common_board_share_the_lidar(session):
    found = calibrated(detections(session, left=range(6), right=range(6, 12)), ML)
    for name, own in found.items():
        assert own.estimated_with == tuple({LEFT, RIGHT} - {name})
        assert own.other_cameras == ()


@pytest.mark.long
def test_failed_cameras_each_have_a_reason(session):
    with pytest.raises(NotEnoughDataError) as caught:
        calibrate_detections(RIG, detections(session, left=range(3), right=range(4)), PAPER)
    assert "left.frames" in caught.value.what and "3 of 12" in caught.value.what
    (other,) = (line for line in caught.value.hint.splitlines() if "right.frames" in line)
    assert "4 of 12" in other


@pytest.mark.parametrize(
    "options", [pytest.param(ML, id="ml"), pytest.param(PAPER, id="paper", marks=pytest.mark.long)]
)
def test_nudged_camera_is_named_and_the_other_kept(options):
    found = calibrated(detections(simulate_two(12, 1, nudge=TURNED, nudged_from=6)), options)
    assert [own.estimated_with for own in found.values()] == [(), ()]
    assert found[RIGHT].verdict in ("marginal", "fail") and found[LEFT].verdict != "fail"
    assert not any(f.code == "verdict.moved" for f in found[LEFT].findings)
    (moved,) = [f for f in found[RIGHT].findings if f.code == "verdict.moved"]
    assert not moved.subject and moved.figures["sensor"] == RIGHT
    assert moved.figures["captures"] == tuple(f"{k:06d}" for k in range(6, 12))
    # The left camera, which did not move, has the same result without the other.
    error = difference(in_use(found[LEFT].T_cam_lidar, found[LEFT].intrinsics), TRUTH[LEFT])
    assert error @ np.linalg.solve(found[LEFT].cov, error) < 25


def test_boards_that_moved_keep_cameras_apart(session):
    """Images around each scan show moving boards: each camera has separate board poses."""
    stamp_ns, track_s = 10**18, np.array([-0.1, -0.05, 0.05, 0.1])

    def moved(captures):
        found = []
        for k, c in enumerate(captures):
            rate = np.array([0.2 * np.sin(k), 0.2 * np.cos(k), 0.1 * np.sin(3 * k), 0, 0, 0])
            poses = np.array([c.image.T_cam_board] * 4)
            poses[:, :3, 3] += track_s[:, None] * rate[:3]
            image = replace(
                c.image,
                stamp_ns=stamp_ns,
                track_ns=(stamp_ns + 1e9 * track_s).astype(np.int64),
                track_T_cam_board=poses,
                track_cov=np.array([c.image.cov] * 4),
            )
            found.append(replace(c, pose=image, surface=replace(c.lidar, stamp_ns=stamp_ns)))
        return found

    found = calibrated(detections({name: moved(captures) for name, captures in session.items()}), PAPER)
    for own in found.values():
        assert own.channel_results[0].time_offset_s is not None
        assert own.estimated_with == own.other_cameras == ()
