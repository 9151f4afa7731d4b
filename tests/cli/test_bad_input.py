"""Wrong specifications and hostile recordings: each is named, and no wrong result is returned."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml

from lce_rig.cli.main import run
from lce_rig.core.geometry import exp_so3, pose, rotation_angle
from lce_rig.rig import load_rig
from lce_rig.session import Session
from lce_rig.simulate import SimulationOptions, rig_truth, simulate_captures
from lce_rig.simulate.room import LIDAR_HEIGHT_M
from lce_rig.simulate.surfaces import rectangle


def edit_profile(session, **changes):
    """Change keys of the session's profile, as after a wrong measurement of the rig."""
    path = session / "rig.yaml"
    document = yaml.safe_load(path.read_text())
    for key, value in changes.items():
        *parents, last = key.split("__")
        place = document
        for parent in parents:
            place = place[parent]
        place[last] = value
    path.write_text(yaml.safe_dump(document))


def keep(session, n_captures):
    """Keep only the first captures, if the findings about one are those about all."""
    for capture in Session.open(session).captures[n_captures:]:
        shutil.rmtree(capture.path)


@pytest.mark.long
def test_wrong_corner_count_names_both(lce_rig, session):
    keep(session, 3)
    edit_profile(session, board__inner_corners=[8, 5])
    outcome = lce_rig("calibrate", session)
    assert outcome.code == 6
    assert "8x5" in outcome.err and "9x6" in outcome.err


@pytest.mark.long
@pytest.mark.parametrize(("square_m", "measured_m"), [(0.064, 0.068), (0.072, 0.068)])
def test_calibrate_squares_of_other_size_are_named(lce_rig, session, square_m, measured_m):
    edit_profile(session, board__square_m=square_m)
    outcome = lce_rig("calibrate", session)
    assert outcome.code in (0, 6, 7)
    if outcome.code != 6:
        (pair,) = json.loads((session / "calibration" / "result.json").read_text())["pairs"]
        assert pair["verdict"] != "pass" and pair["findings"][0]["code"] == "verdict.scale"
        scale = pair["findings"][0]["figures"]
        assert scale["profile_square_m"] == square_m
        assert scale["square_m"] == pytest.approx(measured_m, abs=0.001)


def test_swapped_width_height_is_refused(lce_rig, session):
    edit_profile(session, board__width_m=0.6, board__height_m=0.8)
    outcome = lce_rig("calibrate", session)
    assert outcome.code == 4
    assert "0.6 x 0.8 m" in outcome.err


def test_other_resolution_names_both_sizes(lce_rig, session):
    keep(session, 3)
    camera = "cameras__davis__"
    edit_profile(
        session,
        **{
            camera + "resolution_px": [692, 520],
            camera + "intrinsics__cx_px": 345.0,
            camera + "intrinsics__cy_px": 253.0,
        },
    )
    outcome = lce_rig("calibrate", session)
    assert outcome.code == 6
    assert "346x260" in outcome.err
    assert "692x520" in outcome.err


def test_images_without_board_are_reported(lce_rig, session, tmp_path):
    keep(session, 3)
    source = Session.open(session)
    with Session.create(tmp_path / "empty", source.rig) as writer:
        for capture in source.captures:
            image = capture.image("davis", "frames")
            grey = replace(image, pixels=np.full_like(image.pixels, 90))
            writer.add_capture([grey], [capture.scan("lidar")], {"source": capture.name})
    outcome = lce_rig("calibrate", tmp_path / "empty")
    assert outcome.code == 6
    assert "0 of 3" in outcome.err
    outcome = lce_rig("check", tmp_path / "empty")
    assert outcome.code == 6
    assert "0 of 3 captures" in outcome.out


def test_all_captures_damaged_is_refused(lce_rig, session):
    for capture in (session / "captures").iterdir():
        (capture / "meta.json").write_text("{}")
    outcome = lce_rig("check", session)
    assert outcome.code == 4
    assert "000000" in outcome.err


def static_plate():
    """A blank plate of the board's size at the rig's side, facing it."""
    board, centre = load_rig("rles").board.to_board(), np.array([1.1, 1.8, LIDAR_HEIGHT_M])
    facing, up = np.append(-centre[:2], 0.0) / np.linalg.norm(centre[:2]), np.array([0.0, 0.0, 1.0])
    diamond = exp_so3(np.array([0.0, 0.0, np.pi / 4]))
    T = pose(np.stack([np.cross(up, facing), up, facing], axis=1) @ diamond, centre)
    return "plate", rectangle(board.width_m, board.height_m).moved(T), "plate", T


@pytest.mark.long
def test_static_plate_is_not_the_board(tmp_path):
    """The decoy is in every scan; only the board moves with what the camera sees."""
    session, rig = tmp_path / "session", load_rig("rles")
    options = replace(SimulationOptions.for_rig("rles"), decoys=[static_plate()])
    with Session.create(session, rig) as writer:
        for capture in simulate_captures(rig, n_captures=10, seed=5, options=options):
            writer.add_capture(capture.images, capture.scans, {})
    assert run(["calibrate", str(session)]) == 0
    pair = json.loads((session / "calibration" / "result.json").read_text())["pairs"][0]
    truth = np.array(rig_truth(rig, 5, options)["T_cam_lidar"])
    assert len(pair["captures_used"]) >= 8
    assert np.degrees(rotation_angle(np.array(pair["T_cam_lidar"])[:3, :3], truth[:3, :3])) < 0.5


@pytest.mark.parametrize(
    "changes", [{"file": True}, {"file": "../../../secret.png"}, {"camera": "other"}, {"channel": "none"}]
)
def test_bad_manifest_refuses_only_its_capture(lce_rig, session, changes):
    keep(session, 3)
    manifest = session / "captures" / "000002" / "meta.json"
    document = json.loads(manifest.read_text())
    entry = next(entry for entry in document["files"] if entry["kind"] == "image")
    entry.update(changes)
    manifest.write_text(json.dumps(document))
    outcome = lce_rig("check", session)
    assert outcome.code == 0
    assert "2 of 3 captures" in outcome.out and "000002 read:" in outcome.out


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        '{"T_cam_lidar": [[1, 2], [3, 4]]}',
        '{"T_cam_lidar": [[' + "9" * 401 + "]]}",
        '{"T_cam_lidar": [[1e999]]}',
        "\ufeff{}",
    ],
)
def test_unreadable_reference_is_session_error(lce_rig, session, tmp_path, text):
    (tmp_path / "ref.json").write_text(text, encoding="utf-8")
    outcome = lce_rig("calibrate", session, "--reference", tmp_path / "ref.json")
    assert outcome.code == 4 and "ref.json" in outcome.err
