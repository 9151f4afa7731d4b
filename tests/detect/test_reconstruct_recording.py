"""A real DAVIS346 in front of an AprilTag board: tags read and lines straight in reconstructed pictures.

The network was trained on simulated events alone; no part of this recording was ever trained on.
"""

import cv2
import numpy as np
import pytest

from lce_rig.core.data import Image, join_events
from lce_rig.detect.events.reconstructor import Reconstructor
from lce_rig.io.events import open_events

N_COLS, N_TAGS = 4, 12
WINDOW_EVENTS = 18_000
# Tag 0 is at the lower left of the board, ids grow to the right and upwards; the first corner that OpenCV
# gives of these tags is the lower right one. In units of a tag's side, y up.
TAG = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
GAP = 0.294  # between tags, in sides of a tag; fitted to these pictures


@pytest.fixture(scope="module")
def recording(recordings):
    path = recordings / "events" / "davis346_apriltag_libcaer_cmp.mcap"
    if not path.exists():
        pytest.skip(f"no {path.name}")
    return open_events(path, sensor="davis")


def tags(grey):
    """Read the tags: corners (4, 2) by id."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, ids, _ = cv2.aruco.ArucoDetector(family).detectMarkers(grey)
    return (
        {} if ids is None else {int(i): c[0] for i, c in zip(ids.ravel(), corners, strict=True) if i < N_TAGS}
    )


def homography_residual_px(found):
    """Fit the board's plane to all corners; rms distance. The lens's distortion is in it."""
    ids = sorted(found)
    board = np.concatenate([TAG + (1 + GAP) * np.array([i % N_COLS, i // N_COLS]) for i in ids])
    seen = np.concatenate([found[i] for i in ids]).astype(np.float64)
    matrix, _ = cv2.findHomography(board, seen, 0)
    projected = cv2.perspectiveTransform(board[:, None], matrix)[:, 0]
    return np.sqrt(np.square(projected - seen).sum(1).mean())


def whole(recording):
    """Read the recording in one piece."""
    return join_events(list(recording))


def judged(events):
    """Judge the last half of the pictures of 18,000 events each: tags a picture, residuals."""
    stamps = [int(events.t_ns[k - 1]) + 1 for k in range(WINDOW_EVENTS, len(events) + 1, WINDOW_EVENTS)]
    reconstructor = Reconstructor()
    pictures = list(reconstructor.reconstruct([events], stamps))
    found = [tags(picture.grey) for picture in pictures[len(pictures) // 2 :]]
    residuals = [homography_residual_px(one) for one in found if len(one) >= 4]
    return np.mean([len(one) for one in found]), residuals


def test_reconstruct_tags_are_planar(recording):
    n_tags, residuals = judged(whole(recording))
    assert n_tags >= 11.9
    assert np.mean(residuals) <= 1.32


def test_tags_are_read_at_lidar_timestamps(recording):
    last_ns = recording.span_ns[1]
    stamps = range(last_ns - 200_000_000, last_ns + 1, 50_000_000)
    pictures = list(Reconstructor().reconstruct(recording, list(stamps)))
    assert all(isinstance(picture, Image) for picture in pictures)
    assert np.mean([len(tags(picture.grey)) for picture in pictures]) >= 11
