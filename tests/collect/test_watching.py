"""Tracking the board in scans: rare searches while it is tracked, at once after a loss."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.collect.board_search import sight_ahead
from lce_rig.collect.board_tracker import BoardTracker, CaptureMoment
from lce_rig.collect.gates import StillnessGate, find_moments
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import transform
from lce_rig.detect.finder import BoardFinder
from lce_rig.timing.scan_pairing import Frame
from tests.collect.live.replay import placements, rig
from tests.shared import changed

T0_NS = 1_700_000_000_000_000_000


def frame_of(k, time_s):
    """Return the samples of a placement with another time."""
    capture = placements()[k]
    return Frame(T0_NS + round(time_s * 1e9), capture.images[:1], capture.scans)


def see(watcher, k, time_s):
    return watcher.sight(frame_of(k, time_s))


def nearest_m(detection, k):
    """Return the distance of the nearest candidate from the board's pose in the image."""
    (image,) = detection.images.values()
    nominal = rig().nominal("davis", "lidar")
    assert nominal is not None
    seen = [
        transform(nominal.to_matrix(), each.T_lidar_board[:3, 3][None])[0]
        for each in detection.lidars["lidar"]
    ]
    return float(min(np.linalg.norm(each - image.T_cam_board[:3, 3]) for each in seen))


def test_track_jumped_board_is_found_early():
    """The next full search is not due for 1000 s."""
    watcher = BoardTracker(rig(), rescan_interval_s=1000.0)
    for k, time_s in ((0, 0.0), (0, 0.1), (0, 0.5), (1, 0.9), (1, 1.0), (2, 1.4)):
        assert nearest_m(see(watcher, k, time_s), k) < 0.3, (k, time_s)


def test_track_lost_board_is_searched_for():
    watcher = BoardTracker(rig(), rescan_interval_s=1000.0)
    assert nearest_m(see(watcher, 0, 0.0), 0) < 0.3
    capture = placements()[0]
    blank = replace(capture.images[0], pixels=np.full_like(capture.images[0].pixels, 90))
    unseen = watcher.sight(Frame(T0_NS + 500_000_000, (blank,), capture.scans))
    assert not unseen.images and not unseen.lidars
    assert nearest_m(see(watcher, 3, 1.0), 3) < 0.3


def test_tracker_reports_lens_misfit_not_missing_board():
    watcher = BoardTracker(strict(max_reprojection_px=0.001), 1.0)
    capture = placements()[0]
    blank = replace(capture.images[0], pixels=np.full_like(capture.images[0].pixels, 90))
    for k in range(5):
        see(watcher, 0, 0.1 * k)
    assert watcher.refusals.by_code() == {"image.misfit": 5}
    for k in range(2):
        watcher.sight(Frame(T0_NS + (2 + k) * 10**9, (blank,), capture.scans))
    assert watcher.refusals.by_code() == {"image.misfit": 5, "image.none": 2}


def strict(**limits):
    """Return the rig with other limits on boards."""
    return changed(rig(), quality=changed(rig().quality, **limits))


def test_track_unfit_board_is_never_a_moment():
    watcher = BoardTracker(strict(min_square_px=1000.0))
    seen = [see(watcher, 0, 0.1 * k) for k in range(30)]
    assert all(("davis", "frames") in each.images for each in seen)
    assert not any(each.is_usable for each in seen)
    refusal = seen[-1].unfit["davis", "frames"]
    assert refusal.code == "image.small_squares" and refusal.figures["min_square_px"] == 1000
    assert list(find_moments(seen, StillnessGate(watcher.finder.board, 0.01))) == []
    assert watcher.refusals.by_code()["image.small_squares"] == 30


def test_moments_single_shots_are_taken():
    """Samples that pass within a moving sequence are not."""
    watcher = BoardTracker(rig())
    times_s = (0.0, 4.0, 8.0, 8.1, 12.0)
    seen = [see(watcher, k % len(placements()), time_s) for k, time_s in enumerate(times_s)]
    assert all(each.is_usable for each in seen)
    gate = StillnessGate(watcher.finder.board, 0.01, takes_singles=True)
    taken = [round((moment.detection.frame.time_ns - T0_NS) * 1e-9, 1) for moment in find_moments(seen, gate)]
    assert len(taken) == 3 and {8.0, 8.1}.isdisjoint(taken)
    assert not list(find_moments(seen, StillnessGate(watcher.finder.board, 0.01)))


def test_live_and_offline_take_the_same_boards():
    for limits in ({"max_distance_m": 3.0}, {"max_tilt_deg": 20.0, "min_rings": 8}):
        profile = strict(**limits)
        finder, watcher = BoardFinder(profile), BoardTracker(profile)
        for k, capture in enumerate(placements()):
            detection = see(watcher, k, float(k))
            image, scan = finder.image(capture.images[0]), finder.scan(capture.scans[0])
            key = ("davis", "frames")
            assert (key in detection.images.keys() - detection.unfit.keys()) != isinstance(image, Refusal)
            if detection.images:
                assert ("lidar" in detection.lidars) != isinstance(scan, Refusal)


def test_confirm_moment_searches_thoroughly():
    watcher = BoardTracker(rig())
    for time_s in (0.0, 0.1, 0.2):
        detection = see(watcher, 0, time_s)
    confirmed = watcher.confirm(CaptureMoment(detection, {"motion_m": 0.001}))
    assert isinstance(confirmed, CaptureMoment) and confirmed.figures == {"motion_m": 0.001}
    whole = watcher.finder.image(placements()[0].images[0])
    assert not isinstance(whole, Refusal)
    assert np.array_equal(confirmed.detection.images["davis", "frames"].corners_px, whole.corners_px)
    blank = replace(detection.frame.images[0], pixels=np.full_like(detection.frame.images[0].pixels, 90))
    gone = replace(detection, frame=replace(detection.frame, images=(blank,)))
    refused = watcher.confirm(CaptureMoment(gone, {"motion_m": 0.001}))
    assert isinstance(refused, Refusal) and refused.stage == "image"


def test_confirm_other_plate_is_refused():
    """The nominal extrinsics fitted before."""
    watcher = BoardTracker(rig())
    whole = see(watcher, 0, 0.0)
    (scan,) = whole.frame.scans
    # As if the LiDAR had missed the board, and seen another plate of its size.
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=np.float32)
    elsewhere = replace(whole, frame=replace(whole.frame, scans=(replace(scan, points=scan.points @ turn),)))
    assert isinstance(watcher.confirm(CaptureMoment(elsewhere, {"motion_m": 0.001})), CaptureMoment)
    assert isinstance(watcher.confirm(CaptureMoment(whole, {"motion_m": 0.001})), CaptureMoment)
    refused = watcher.confirm(CaptureMoment(elsewhere, {"motion_m": 0.001}))
    assert isinstance(refused, Refusal) and refused.code == "lidar.elsewhere"
    assert float(refused.figures["distance_m"]) > 1


@pytest.mark.long
def test_images_searched_ahead_give_the_same_detections():
    order = (0, 0, 0, 1, 1, 2, 3, 3, 0, 0, 1, 2)
    frames = [frame_of(k, 0.1 * i) for i, k in enumerate(order)]
    one, two = BoardTracker(rig()), BoardTracker(rig())
    for alone, ahead in zip(map(one.sight, frames), sight_ahead(two, frames), strict=True):
        assert ahead.frame is alone.frame
        assert ahead.images.keys() == alone.images.keys() and ahead.lidars.keys() == alone.lidars.keys()
        for key, board in alone.images.items():
            assert np.array_equal(board.corners_px, ahead.images[key].corners_px)
    assert one.refusals.by_code() == two.refusals.by_code()
