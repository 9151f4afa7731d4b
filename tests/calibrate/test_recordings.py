"""Recordings by others: the extrinsics compared with their reference, which the algorithm does not use."""

import json
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest

from lce_rig.calibrate import CalibrateOptions, EstimateSettings, error_to_reference, fit_extrinsic
from lce_rig.calibrate.options import Tolerances
from lce_rig.core.calibration import Method
from lce_rig.core.data import Image, Scan
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import difference, exp_so3, invert, pose
from lce_rig.core.pcd import decode_pcd
from lce_rig.core.results import Observation
from lce_rig.detect.finder import BoardFinder
from lce_rig.detect.image.search import find_image_board
from lce_rig.detect.lidar.search import find_lidar_boards
from lce_rig.io.cloud import rings_from_elevation, to_scan
from lce_rig.judge.validate import validate
from lce_rig.rig import load_rig

pytestmark = pytest.mark.dataset
AVIA = Path(__file__).parents[1] / "rigs" / "livox_avia.yaml"


def read_scan(path):
    cloud = decode_pcd(path.read_bytes())
    points = np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=1).astype(np.float32)
    kept = np.isfinite(points).all(axis=1) & (np.linalg.norm(points, axis=1) > 0.1)
    ring = rings_from_elevation(points[kept])
    return Scan("lidar", None, points[kept], np.zeros(kept.sum(), dtype=np.float32), ring)


def detect(folder, rig):
    (camera,) = rig.cameras.values()
    board, intrinsics = rig.board.to_board(), camera.to_intrinsics()
    pictures, clouds = ({f.stem: f for f in (folder / name).iterdir()} for name in ("img", "pcd"))
    shared = sorted(pictures.keys() & clouds.keys())
    names = [(k, k) for k in shared] or list(zip(sorted(pictures), sorted(clouds), strict=True))
    found = []
    for picture, cloud in names:
        image = Image("cam", "frames", None, cv2.imread(str(pictures[picture])))
        seen = find_image_board(image, board, intrinsics)
        places = find_lidar_boards(read_scan(clouds[cloud]), board)
        if not isinstance(seen, Refusal) and not isinstance(places, Refusal):
            found.append(Observation.of(picture, seen, places))
    return found


@pytest.mark.long
@pytest.mark.parametrize(
    ("recording", "profile", "n_captures", "max_deg", "max_m"),
    [
        ("rlfs01", "rlfs", 18, 0.25, 0.012),
        ("sss_noise15mm", "sss", 20, 0.10, 0.003),
        ("rles01_lf", "rles", 19, 0.9, 0.035),
        ("rles01_le", "rles", 33, 1.0, 0.040),
    ],
)
def test_recording_extrinsics_are_near_reference(recordings, recording, profile, n_captures, max_deg, max_m):
    rig = load_rig(profile)
    estimate = fit_extrinsic(detect(recordings / recording, rig), rig.board.to_board())
    reference = np.array(json.loads((recordings / recording / "reference.json").read_text())["T_cam_lidar"])
    angle_deg, distance_m = error_to_reference(estimate.T_cam_lidar, reference)
    assert angle_deg <= max_deg
    assert distance_m <= max_m
    assert len(estimate.used) >= n_captures
    assert estimate.certificate.is_optimal


@pytest.mark.long
@pytest.mark.parametrize("method", get_args(Method))
def test_recording_sss_matches_driver_labels(recordings, method):
    """The simulator labels its clouds half an azimuth step of 360 / 1874 deg beside its rays."""
    rig, folder = load_rig("sss"), recordings / "sss_noise15mm"
    (camera,), (lidar,) = rig.cameras.values(), rig.lidars.values()
    settings = EstimateSettings.of(CalibrateOptions(method), lidar, Tolerances.of(camera, rig.board))
    estimate = fit_extrinsic(detect(folder, rig), rig.board.to_board(), settings)
    cov = validate(estimate, rig, lidar, camera.to_intrinsics()).cov
    of_rays = np.array(json.loads((folder / "reference.json").read_text())["T_cam_lidar"])
    half_step = pose(exp_so3(np.array([0, 0, np.pi / 1874])), np.zeros(3))
    error = difference(estimate.T_cam_lidar, of_rays @ invert(half_step))
    assert error @ np.linalg.solve(cov, error) < 16.8  # 99 % of the chi-squared distribution


@pytest.mark.long
def test_random_halves_of_a_recording_agree(recordings):
    rig = load_rig("rlfs")
    captures, board = detect(recordings / "rlfs01", rig), rig.board.to_board()
    rng = np.random.default_rng(0)
    differences = []
    for _ in range(20):
        order = rng.permutation(len(captures))
        halves = [[captures[k] for k in half] for half in np.array_split(order, 2)]
        T = [fit_extrinsic(half, board, EstimateSettings()).T_cam_lidar for half in halves]
        differences.append(error_to_reference(*T))
    angle_deg, distance_m = np.sqrt(np.mean(np.square(differences), axis=0))
    assert angle_deg <= 0.25
    assert distance_m <= 0.008


@pytest.mark.long
def test_recording_avia_halves_agree(recordings):
    rig = load_rig(str(AVIA))
    finder, lidar, seen = BoardFinder(rig), rig.lidars["lidar"], []
    for path in sorted((recordings / "livox_avia" / "img").glob("*.jpg")):
        image = finder.image(Image("cam", "frames", None, cv2.imread(str(path))))
        cloud = decode_pcd((recordings / "livox_avia" / "pcd" / f"{path.stem}.pcd").read_bytes())
        places = finder.scan(to_scan(cloud, "lidar", lidar, path.stem))
        if not isinstance(image, Refusal) and not isinstance(places, Refusal):
            seen.append(Observation.of(path.stem, image, places))
    assert len(seen) >= 18
    settings = EstimateSettings(method="ml", range_offset_sigma_m=0.01, has_rings=False)
    rng, differences, chi2 = np.random.default_rng(3), [], []
    for _ in range(8):
        order = rng.permutation(len(seen))
        halves = ([seen[k] for k in sorted(half)] for half in (order[::2], order[1::2]))
        first, second = (fit_extrinsic(half, rig.board.to_board(), settings) for half in halves)
        differences.append(error_to_reference(first.T_cam_lidar, second.T_cam_lidar))
        apart = difference(first.T_cam_lidar, second.T_cam_lidar)
        chi2.append(apart @ np.linalg.solve(first.cov + second.cov, apart))
    angle_deg, distance_m = np.sqrt(np.mean(np.square(differences), axis=0))
    assert angle_deg < 0.2 and distance_m < 0.035
    assert np.mean(chi2) < 9.0  # of 6 freedoms
