"""The board in recordings by others: found in every scan, where camera and reference extrinsic expect it.

The references are good to about 1 cm, hand-held boards move between picture and scan: the place is checked
to a few decimetres, which tells the board from everything else in the room.
"""

import json

import cv2
import numpy as np
import pytest

from lce_rig.core.board import Board
from lce_rig.core.data import Scan
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import invert, pose
from lce_rig.core.pcd import decode_pcd
from lce_rig.detect.lidar.search import find_lidar_boards, look_for_board
from lce_rig.io.cloud import rings_from_elevation

pytestmark = pytest.mark.dataset
SETS = ["rlfs01", "sss_noise15mm", "rles01_lf", "rles01_le", "rles02_lf", "rles02_le", "acfr_vlp16"]


def board_of(folder):
    spec = json.loads((folder / "params.json").read_text())["board"]
    return Board(*spec["inner_corners"], spec["square_m"], spec["width_m"], spec["height_m"])


def scans_of(folder):
    scans = {}
    for path in sorted((folder / "pcd").glob("*.pcd")):
        cloud = decode_pcd(path.read_bytes())
        points = np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=1).astype(np.float32)
        ring = cloud["ring"].astype(np.int16) if "ring" in cloud.dtype.names else rings_from_elevation(points)
        scans[path.stem] = Scan("lidar", None, points, cloud["intensity"].astype(np.float32), ring)
    return scans


def expected_centre(image, folder, board):
    """Find the board's centre in the LiDAR frame by the picture and the reference; None without corners."""
    spec = json.loads((folder / "params.json").read_text())
    K, D = np.array(spec["K"], dtype=float), np.array(spec["D"], dtype=float)
    grey = cv2.imread(str(image), cv2.IMREAD_GRAYSCALE)
    for scale in (1, 2) if grey.shape[1] < 800 else (1,):
        larger = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        found, corners = cv2.findChessboardCornersSB(
            larger, (board.cols, board.rows), flags=cv2.CALIB_CB_ACCURACY
        )
        if found:
            pixels = ((corners.reshape(-1, 1, 2) + 0.5) / scale - 0.5).astype(np.float64)
            _, rvec, tvec = cv2.solvePnP(board.corners() * [1, -1, 1], pixels, K, D, flags=cv2.SOLVEPNP_IPPE)
            T_cam_board = pose(cv2.Rodrigues(rvec)[0], tvec[:, 0])
            T_cam_lidar = np.array(json.loads((folder / "reference.json").read_text())["T_cam_lidar"])
            return (invert(T_cam_lidar) @ T_cam_board)[:3, 3]
    return None


@pytest.mark.parametrize("name", SETS)
def test_recording_board_is_found_in_every_scan(recordings, name):
    folder = recordings / name
    board = board_of(folder)
    refused, ratios = {}, []
    for key, scan in scans_of(folder).items():
        found = find_lidar_boards(scan, board)
        if isinstance(found, Refusal):
            refused[key] = found
        else:
            q = found[0].quality
            ratios.append(np.sqrt(q.width_m * q.height_m / (board.width_m * board.height_m)))
    assert not refused
    # The simulated set has no light spot, so that its board seems smaller by one.
    assert np.median(ratios) == pytest.approx(1.0, abs=0.03)


@pytest.mark.long
@pytest.mark.parametrize("name", ["rlfs01", "sss_noise15mm", "rles01_lf", "rles02_lf"])
def test_first_candidate_matches_image(recordings, name):
    folder = recordings / name
    board, scans = board_of(folder), scans_of(folder)
    images = sorted((folder / "img").iterdir())
    in_order = json.loads((folder / "params.json").read_text())["pairing"] == "sorted order"
    pairs = (
        zip(images, sorted(scans), strict=True)
        if in_order
        else [(i, i.stem) for i in images if i.stem in scans]
    )
    n_seen = 0
    for image, key in pairs:
        centre = expected_centre(image, folder, board)
        if centre is not None:
            n_seen += 1
            found = find_lidar_boards(scans[key], board)[0]
            assert np.linalg.norm(found.T_lidar_board[:3, 3] - centre) < 0.35, key
    assert n_seen >= 0.8 * len(scans)


def test_the_board_is_tracked_through_a_hand_held_recording(recordings):
    folder = recordings / "rles02_lf"
    board, scans = board_of(folder), scans_of(folder)
    for key, scan in scans.items():
        found = find_lidar_boards(scan, board)[0]
        tracked = look_for_board(scan, board, found.T_lidar_board)
        assert not isinstance(tracked, Refusal), (key, tracked)
        # The crop's own noise estimate moves the borderline returns, by no more than this.
        assert np.linalg.norm(tracked.T_lidar_board[:3, 3] - found.T_lidar_board[:3, 3]) < 0.03, key
