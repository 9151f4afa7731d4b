"""Calibration without a board: rendered panels with exact truth, as folders and sessions."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from lce_rig.cli.main import run
from lce_rig.core.calibration import read_result
from lce_rig.core.errors import NotEnoughDataError, ProfileError, SessionError
from lce_rig.core.geometry import difference, perturb
from lce_rig.io.ros.bag_recorder import BagRecorder
from lce_rig.judge.reach import covariance_alone
from lce_rig.pipeline.scene_calibration import calibrate_scene
from lce_rig.rig import Rig, dump_rig
from lce_rig.session import Session
from tests.scene.panels import LENS, TRUTH, rendered
from tests.shared import compute_once

OFF = np.array([0.05, -0.04, 0.06, 0.01, -0.012, 0.008])


def nominal(T_cam_lidar, source="cad"):
    return {
        "camera": "cam",
        "lidar": "lidar",
        "matrix": T_cam_lidar[:3, :3].tolist(),
        "translation_m": T_cam_lidar[:3, 3].tolist(),
        "source": source,
        "tolerance_m": 0.2,
    }


def rig_of(*nominals, **quality):
    lens = {"fx_px": LENS.fx_px, "fy_px": LENS.fy_px, "cx_px": LENS.cx_px, "cy_px": LENS.cy_px}
    camera = {"resolution_px": [LENS.width_px, LENS.height_px], "intrinsics": lens | {"distortion": [0] * 5}}
    return Rig.model_validate(
        {
            "format_version": 1,
            "name": "panels",
            "board": {"inner_corners": [8, 6], "square_m": 0.07, "width_m": 0.767, "height_m": 0.626},
            "lidars": {
                "lidar": {"model": "unstructured", "beam_divergence_rad": 0.0, "beam_aperture_m": 0.0}
            },
            "cameras": {"cam": camera},
            "nominal_extrinsics": list(nominals),
            "calibration": quality,
        }
    )


RIG = rig_of(nominal(perturb(TRUTH, OFF)))


def session_of(path, views, rig=RIG):
    with Session.create(path, rig) as session:
        for image, scan in views:
            session.add_capture([image], [scan], {})
    return path


@pytest.fixture(scope="session")
def panels():
    return compute_once("panels", lambda: [rendered(seed) for seed in range(3)])


@pytest.fixture
def drive(panels, tmp_path):
    """A folder of images and point clouds, as people store them."""
    path = session_of(tmp_path / "source", panels)
    folder = tmp_path / "drive"
    for name in ("img", "pcd"):
        (folder / name).mkdir(parents=True)
    for capture in Session.open(path).captures:
        (capture.path / "cam.frames.png").rename(folder / "img" / f"{capture.name}.png")
        (capture.path / "lidar.pcd").rename(folder / "pcd" / f"{capture.name}.pcd")
    return folder


def profile(tmp_path, rig=RIG):
    (tmp_path / "mine.yaml").write_text(dump_rig(rig))
    return str(tmp_path / "mine.yaml")


def chi2(c):
    tangent = difference(c.T_cam_lidar, TRUTH)
    return tangent @ np.linalg.solve(c.cov, tangent)


def test_folder_gives_result_exports_and_overlays(drive, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(["calibrate", "--scene", str(drive), "--rig", profile(tmp_path), str(out)]) == 0
    screen = capsys.readouterr().out
    assert "3 of 3 views used" in screen and "about" in screen and "T_cam_lidar" in screen
    (c,) = read_result(out / "calibration" / "result.json").pairs
    assert c.method == "scene" and c.captures_used == ("000000", "000001", "000002")
    assert chi2(c) < 16.81 and np.linalg.norm(difference(c.T_cam_lidar, TRUTH)[:3]) < 0.03
    assert {"extrinsics.yaml", "panels.urdf"} <= {path.name for path in (out / "calibration").iterdir()}
    pictures = sorted((out / "scene").iterdir())
    assert len(pictures) == 3 and cv2.imread(str(pictures[0])) is not None


@pytest.mark.long
def test_verify_without_board_advises_drift(drive, tmp_path, capsys):
    words = [str(word) for word in ("--scene", drive, "--rig", tmp_path / "mine.yaml", tmp_path / "out")]
    (tmp_path / "mine.yaml").write_text(dump_rig(RIG))
    assert run(["calibrate", *words]) in (0, 7)
    assert run(["verify", str(tmp_path / "out")]) == 4
    assert "lce-rig drift" in capsys.readouterr().err


@pytest.mark.long
def test_folder_again_keeps_captures(drive, tmp_path):
    words = ["calibrate", "--scene", str(drive), "--rig", profile(tmp_path), str(tmp_path / "out")]
    assert run(words) == 0 and run(words) == 0
    assert len(Session.open(tmp_path / "out").captures) == 3


@pytest.mark.long
def test_session_keeps_its_own_result(panels, tmp_path, capsys, monkeypatch):
    path = session_of(tmp_path / "session", panels)
    monkeypatch.chdir(tmp_path)
    assert run(["calibrate", "--scene", "session", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["pairs"][0]["method"] == "scene"
    assert (path / "results" / "scene" / "result.json").exists() and not (path / "calibration").exists()


@pytest.mark.long
def test_bag_is_read_as_a_folder_is(panels, tmp_path):
    with BagRecorder(tmp_path / "drive.bag", RIG) as bag:
        for second, (image, scan) in enumerate(panels):
            # Images in the middle of scans.
            bag.write(replace(scan, stamp_ns=(second + 1) * 10**9))
            bag.write(replace(image, stamp_ns=(second + 1) * 10**9 + 500_000_000))
    found = calibrate_scene([tmp_path / "drive.bag"], tmp_path / "out", rig=RIG)
    (c,) = found.result.pairs
    assert len(c.captures_used) == 3 and chi2(c) < 16.81


def verdict_of(panels, tmp_path, rig):
    (c,) = calibrate_scene([session_of(tmp_path / "own", panels, rig)], "").result.pairs
    return c.verdict, {finding.code for finding in c.findings if finding.severity != "note"}


@pytest.mark.long
def test_views_of_one_place_do_not_pass(panels, tmp_path):
    rig = rig_of(nominal(perturb(TRUTH, OFF)), target_sigma_m=0.2, target_sigma_deg=2.0)
    verdict, codes = verdict_of([panels[0]] * 3, tmp_path, rig)
    assert verdict == "marginal" and codes == {"scene_calibration.one_place"}


@pytest.mark.long
def test_wide_targets_pass_with_cad(panels, tmp_path):
    rig = rig_of(nominal(perturb(TRUTH, OFF)), target_sigma_m=0.2, target_sigma_deg=2.0)
    assert verdict_of(panels, tmp_path, rig) == ("pass", set())


@pytest.mark.long
def test_typical_nominal_is_marginal(panels, tmp_path):
    rig = rig_of(nominal(perturb(TRUTH, OFF), "typical"), target_sigma_m=0.2, target_sigma_deg=2.0)
    assert verdict_of(panels, tmp_path, rig) == ("marginal", {"scene_calibration.typical"})


@pytest.mark.long
def test_sigma_beyond_target_is_marginal(panels, tmp_path):
    rig = rig_of(nominal(perturb(TRUTH, OFF)), target_sigma_m=0.001)
    assert verdict_of(panels, tmp_path, rig) == ("marginal", {"scene_calibration.uncertain"})


@pytest.mark.long
def test_far_from_cad_fails(panels, tmp_path):
    entry = nominal(perturb(TRUTH, OFF)) | {"tolerance_m": 0.01}
    rig = rig_of(entry, target_sigma_m=0.2, target_sigma_deg=2.0)
    assert verdict_of(panels, tmp_path, rig) == ("fail", {"verdict.far_from_nominal"})


def dark(image):
    noise = np.random.default_rng(0).normal(0, 2, image.pixels.shape)
    return replace(image, pixels=np.clip(0.02 * image.pixels + noise, 0, 255).astype(np.uint8))


def mirrored(image):
    return replace(image, pixels=np.ascontiguousarray(image.pixels[:, ::-1]))


def even(image):
    return replace(image, pixels=np.full_like(image.pixels, 128))


@pytest.mark.long
@pytest.mark.parametrize(("change", "code"), [(dark, "dark"), (mirrored, ""), (even, "weak")])
def test_bad_images_cannot_tell(panels, tmp_path, change, code):
    path = session_of(tmp_path / "own", [(change(image), scan) for image, scan in panels])
    found = calibrate_scene([path], "")
    assert not found.result.pairs and found.drawn
    (shortage,) = found.result.shortages
    assert shortage.code.startswith(f"scene_calibration.{code}") and "cannot tell" in shortage.text
    with pytest.raises(NotEnoughDataError):
        found.require_pairs()


@pytest.mark.long
def test_views_of_other_scans_cannot_tell(panels, tmp_path):
    images, scans = zip(*panels, strict=True)
    path = session_of(tmp_path / "own", zip(images, scans[1:] + scans[:1], strict=True))
    assert not calibrate_scene([path], "").result.pairs


@pytest.mark.long
def test_cannot_tell_exits_with_6(panels, tmp_path, capsys):
    path = session_of(tmp_path / "own", [(even(image), scan) for image, scan in panels])
    assert run(["calibrate", "--scene", str(path)]) == 6
    assert "cannot tell" in capsys.readouterr().err and not (path / "results").exists()


def test_no_nominal_names_the_key(panels, tmp_path):
    with pytest.raises(ProfileError, match="nominal_extrinsics"):
        calibrate_scene([session_of(tmp_path / "own", panels[:1], rig_of())], "")


def test_session_of_a_board_is_refused(drive, panels, tmp_path):
    path = session_of(tmp_path / "own", panels[:1])
    with pytest.raises(SessionError, match="board"):
        calibrate_scene([drive], path, rig=RIG)


def test_recording_without_profile_is_refused(drive, tmp_path):
    with pytest.raises(SessionError, match="not a session"):
        calibrate_scene([drive], tmp_path / "out")


@pytest.mark.long
def test_calibrate_scene_keeps_lens_errors(panels, tmp_path):
    path = session_of(tmp_path / "session", panels)
    (found,) = calibrate_scene([path], path).result.pairs
    alone_rad, used_rad = (np.sqrt(np.diag(cov)[3:]) for cov in (covariance_alone(found), found.cov))
    # A rotation by the profile's principal point, 0.4 % of the focal length, takes the place of its error.
    assert np.all(alone_rad[:2] > 0.7 * 0.004) and np.all(used_rad[:2] < 0.7 * alone_rad[:2])
