"""Two cameras and two LiDARs estimated as one: truth, closed loops, and which sensor is named."""

import numpy as np
import pytest

from lce_rig.core.geometry import exp_so3, perturb
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.calibration import calibrate_detections
from tests.calibrate.four_sensors import ON_FRONT, error, make_rig, measure_errors, simulate

N = 30
RIG = make_rig()


def calibrate(detections):
    return {(c.camera, c.lidar): c for c in calibrate_detections(RIG, detections)[0]}


def causes(results):
    """Texts of the causes by pair."""
    return {
        pair: [f.text for f in c.findings if f.severity != "note" and not f.follows]
        for pair, c in results.items()
    }


@pytest.fixture(scope="module")
def sound():
    return calibrate(simulate(N, 0))


@pytest.mark.long
def test_four_sensors_errors_fit_covariance(sound):
    assert len(sound) == 5
    for result in sound.values():
        assert result.verdict == "pass", result.findings
        off = error(result)
        assert off @ np.linalg.solve(result.cov, off) < 25
        assert np.degrees(np.linalg.norm(off[3:])) < 0.12 and np.linalg.norm(off[:3]) < 0.01
        assert len(result.estimated_with) == 2


@pytest.mark.long
def test_four_sensors_loops_close(sound):
    T = {pair: c.T_cam_lidar for pair, c in sound.items()}
    for camera in ("left", "right"):
        closed = T[camera, "front"] @ T["front", "rear"]
        assert np.allclose(closed, T[camera, "rear"], atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("name", ["right", "rear"])
def test_sensor_that_moved_is_named_and_others_pass(name):
    after = perturb(ON_FRONT[name], np.r_[0.01, 0.0, 0.01, np.radians([0.6, 0.0, 0.8])])
    moves = {name: lambda k: ON_FRONT[name] if k < N // 2 else after}
    results = calibrate(simulate(N, 2, moves=moves))
    for pair, texts in causes(results).items():
        if name in pair:
            assert results[pair].verdict == "fail"
            assert len(texts) == 1 and f"{name} moved" in texts[0]
        else:
            assert results[pair].verdict == "pass"


@pytest.mark.long
def test_exchanged_lidars_are_named_in_all_pairs():
    found = simulate(N, 1)
    front, rear = found.lidars["front"], found.lidars["rear"]
    results = calibrate(Detections(found.images, {"front": rear, "rear": front}))
    for texts in causes(results).values():
        assert len(texts) == 1 and "front and rear are exchanged" in texts[0]


@pytest.mark.long
def test_moved_sensor_is_named_from_few_captures():
    """The cameras have one and two captures before the motion, and one result does not use its own."""
    after = perturb(ON_FRONT["rear"], np.r_[0.012, -0.004, 0.016, np.radians([0.5, 0.6, -0.6])])
    results = calibrate(simulate(N, 6, moves={"rear": lambda k: ON_FRONT["rear"] if k < 8 else after}))
    verdicts = {"rear": [], "others": []}
    for pair, result in results.items():
        verdicts["rear" if "rear" in pair else "others"].append(result.verdict)
        if "rear" in pair:
            assert "rear moved before 000009" in result.findings[0].text
    assert verdicts == {"rear": ["pass", "fail", "fail"], "others": ["pass", "pass"]}


@pytest.mark.long
def test_sensor_on_another_clock_is_named_once():
    """Scans of `rear` are those of the next capture."""
    found = simulate(N, 3)
    names = sorted(found.lidars["rear"])
    late = {
        name: found.lidars["rear"][other] for name, other in zip(names, names[1:] + names[:1], strict=True)
    }
    results, shortages = calibrate_detections(RIG, Detections(found.images, {**found.lidars, "rear": late}))
    assert {c.camera: c.verdict for c in results} == {"left": "pass", "right": "pass"}
    (shortage,) = shortages
    assert shortage.text == "captures of rear agree with no other sensor's (front, left, right)"


@pytest.mark.slow
def test_four_sensors_covariances_fit_many_sessions():
    """50 sessions of 30 placements, each seen by two or three of four sensors; profiles err as they state."""
    results = [
        c for seed in range(50) for c in calibrate_detections(make_rig(seed=seed), simulate(N, seed))[0]
    ]
    rms_deg, rms_mm, covered = measure_errors(results)
    assert rms_deg < 0.06 and rms_mm < 5.0
    assert 0.9 < covered < 0.98


def wrong_sessions(seed):
    """List sessions in which one sensor is wrong.

    Each is (kind, sensors, words of the cause, profile, detections, poses after a motion).
    """
    rng = np.random.default_rng(seed)
    for name in ON_FRONT:
        turn = exp_so3(rng.normal(size=3))[:, 0]
        after = perturb(ON_FRONT[name], np.r_[0.01 * rng.normal(size=3), np.radians(1.0) * turn])
        cut = int(rng.integers(N // 4, 3 * N // 4))
        moves = {name: lambda k, name=name, cut=cut, after=after: ON_FRONT[name] if k < cut else after}
        poses = {**ON_FRONT, name: after}
        yield f"{name} moved", {name}, f"{name} moved", RIG, simulate(N, seed, moves=moves), poses
    found = simulate(N, seed)
    front, rear = found.lidars["front"], found.lidars["rear"]
    exchanged = Detections(found.images, {"front": rear, "rear": front})
    yield "LiDARs exchanged", {"front", "rear"}, "exchanged", RIG, exchanged, ON_FRONT
    left, right = (found.images[name, "frames"] for name in ("left", "right"))
    exchanged = Detections({("left", "frames"): right, ("right", "frames"): left}, found.lidars)
    yield "cameras exchanged", {"left", "right"}, "exchanged", RIG, exchanged, ON_FRONT
    lens = RIG.cameras["right"].intrinsics
    longer = lens.model_copy(update={"fx_px": 1.02 * lens.fx_px, "fy_px": 1.02 * lens.fy_px})
    camera = RIG.cameras["right"].model_copy(update={"intrinsics": longer})
    rig = RIG.model_copy(update={"cameras": {**RIG.cameras, "right": camera}})
    yield "focal length of right 2 % too long", {"right"}, "intrinsics", rig, found, ON_FRONT


@pytest.mark.slow
def test_wrong_sensor_is_named_first_in_many_sessions():
    """30 sessions of each kind: the cause of all pairs of the sensor, none of others, and no wrong pass.

    A result that passes is within its claim, and a note names the sensor: boards correct a wrong lens, and
    captures from after a motion are not affected.
    """
    right: dict[str, list[bool]] = {}
    wrong_passes = 0
    for seed in range(30):
        for kind, sensors, text, rig, found, poses in wrong_sessions(seed):
            results, _ = calibrate_detections(rig, found)
            is_right = []
            for c in results:
                if {c.camera, c.lidar} & sensors:
                    named = [f for f in c.findings if not f.follows]
                    is_right.append(bool(named) and text in named[0].text)
                    off = error(c, poses)
                    wrong_passes += c.verdict == "pass" and bool(off @ np.linalg.solve(c.cov, off) > 30)
                else:
                    is_right.append(c.verdict == "pass")
            right.setdefault(kind, []).append(all(is_right))
    for kind, found in right.items():
        print(f"{kind}: named in all its pairs and in no other in {sum(found)} of {len(found)} sessions")
    print(f"pairs that pass beyond 95 % five times over: {wrong_passes}")
    assert np.mean([each for found in right.values() for each in found]) > 0.95
    # In one session a single placement follows the motion: its capture is an outlier of two pairs.
    assert wrong_passes <= 2
