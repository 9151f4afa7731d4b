"""The board followed in scans: seldom searched for while nothing is lost, at once where something is."""

from dataclasses import replace

import numpy as np

from lce_rig.collect.pairing import Frame
from lce_rig.collect.watching import BoardWatcher, Sighting
from lce_rig.core.geometry import transform
from tests.collect.live.replay import placements, rig

T0_NS = 1_700_000_000_000_000_000


def see(watcher: BoardWatcher, k: int, time_s: float) -> Sighting:
    capture = placements()[k]
    return watcher.sight(Frame(T0_NS + round(time_s * 1e9), capture.images[:1], capture.scans))


def nearest_m(sighting: Sighting, k: int) -> float:
    """Tell how far the nearest candidate lies from where the picture has the board."""
    (image,) = sighting.images.values()
    nominal = rig().nominal("davis", "lidar")
    assert nominal is not None
    seen = [
        transform(nominal.to_matrix(), each.T_lidar_board[:3, 3][None])[0]
        for each in sighting.lidars["lidar"]
    ]
    return float(min(np.linalg.norm(each - image.T_cam_board[:3, 3]) for each in seen))


def test_a_board_that_jumps_is_found_in_the_scan_long_before_the_next_search_is_due() -> None:
    watcher = BoardWatcher(rig(), 0.3, thorough_interval_s=0.0, rescan_interval_s=1000.0)
    for k, time_s in ((0, 0.0), (0, 0.1), (0, 0.5), (1, 0.9), (1, 1.0), (2, 1.4)):
        assert nearest_m(see(watcher, k, time_s), k) < 0.3, (k, time_s)


def test_a_board_that_was_out_of_sight_is_searched_for_at_once() -> None:
    watcher = BoardWatcher(rig(), 0.3, thorough_interval_s=0.0, rescan_interval_s=1000.0)
    assert nearest_m(see(watcher, 0, 0.0), 0) < 0.3
    capture = placements()[0]
    blank = replace(capture.images[0], pixels=np.full_like(capture.images[0].pixels, 90))
    unseen = watcher.sight(Frame(T0_NS + 500_000_000, (blank,), capture.scans))
    assert not unseen.images and not unseen.lidars
    assert nearest_m(see(watcher, 3, 1.0), 3) < 0.3
