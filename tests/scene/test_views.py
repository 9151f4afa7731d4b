"""Edges of moving objects in front of a standing rig are removed."""

from dataclasses import replace

import numpy as np

from lce_rig.scene.views import without_movers


def test_movers_board_and_stand_are_left_out(seen):
    standing = without_movers(seen.views)
    shares = []
    for capture, before, after in zip(seen.captures, seen.views, standing, strict=True):
        middle = capture.T_lidar_board["lidar"][:3, 3]
        n_near, n_left = (
            np.count_nonzero(np.hypot(*(view.outlines.points - middle)[:, :2].T) < 0.6)
            for view in (before, after)
        )
        assert n_near > 15 and n_left < 0.2 * n_near
        shares.append((len(after.outlines) - n_left) / (len(before.outlines) - n_near))
    assert min(shares) > 0.8


def test_movers_of_moving_rig_keep_all(seen):
    moving = [
        replace(view, outlines=replace(view.outlines, points=view.outlines.points + [0.4 * k, 0, 0]))
        for k, view in enumerate(seen.views)
    ]
    for views in (moving, moving[:1], []):
        assert [len(each.outlines) for each in without_movers(views)] == [
            len(each.outlines) for each in views
        ]
