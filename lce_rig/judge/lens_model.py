"""Whether corners fit a lens model as well as corners can: a fisheye lens entered as radtan does not.

The noise of corners needs no lens: in one image, a homography and a cubic polynomial of the board's
coordinates take up perspective, distortion and the board's bend.
"""

from collections.abc import Sequence
from contextlib import suppress

import cv2
import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array
from lce_rig.judge.findings import LENS_MODEL, failing
from lce_rig.lens.calibrate_lens import estimate_intrinsics
from lce_rig.lens.lens_estimate import BoardView, IntrinsicsEstimate
from lce_rig.lens.models import MODELS

# Residuals so many times the noise, in the median image, are of another lens: in 17 sound sessions, 11 of
# them recorded, they are 0.5 to 1.1 times as large, of a fisheye lens entered as radtan 6. Twice that fails.
_MISFIT, _FAIL = 2.0, 2.0
# A model that fits is at least so many times as near.
_NEARER, _ALIKE = 2.0, 1.25
_DEGREE, _LEAST_FREEDOMS = 3, 8


def model_findings(fitted: IntrinsicsEstimate, board: Board) -> list[Finding]:
    """Try other lens models where corners do not fit as well as their noise allows.

    Args:
        fitted: intrinsics of the profile's model.
        board: its specification.

    Returns:
        None where the corners fit, or where the same model fits them with values of its own; else the
        finding, with the model that fits or "".
    """
    noise_px = corner_noise(fitted.views, board)
    counts = [int(np.isfinite(view.board.corners_px[:, 0]).sum()) for view in fitted.views]
    squares = np.sum(fitted.residuals_px**2, axis=1)
    rms_px = np.sqrt([part.mean() for part in np.split(squares, np.cumsum(counts)[:-1])])
    ratios = rms_px / np.maximum(noise_px, 1e-9)
    if np.isnan(ratios).all() or np.nanmedian(ratios) < _MISFIT:
        return []
    reached = {}
    for name, model in MODELS.items():
        with suppress(NotEnoughDataError):
            start = fitted.intrinsics
            reached[name] = estimate_intrinsics(fitted.views, board, start, model, n_folds=0).rms_px
    own, least_px = fitted.model.name, min(reached.values(), default=np.inf)
    # Of models that are about as near the one with the fewest parameters.
    near = [name for name, px in reached.items() if px < _ALIKE * least_px]
    best = min(near, key=lambda name: MODELS[name].size, default="")
    if _NEARER * least_px > fitted.rms_px:
        best = ""
    elif reached.get(own, np.inf) < _NEARER * least_px:
        return []
    typical_px = float(np.nanmedian(noise_px))
    finding = LENS_MODEL(
        severity=failing(fitted.rms_px > _FAIL * _MISFIT * typical_px),
        action="" if best else "none",
        model=own,
        rms_px=fitted.rms_px,
        noise_px=typical_px,
        other=best,
        other_px=reached.get(best, typical_px),
    )
    return [finding]


def corner_noise(views: Sequence[BoardView], board: Board) -> Array:
    """Measure the rms noise (K,) of each view's corners, px; NaN where too few are seen."""
    corners = board.corners()[:, :2]
    x, y = ((corners - corners.mean(axis=0)) / np.ptp(corners, axis=0).max()).T
    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    bends = np.stack([x**i * y**j for i, j in powers], axis=1)
    noise_px = np.full(len(views), np.nan)
    for k, view in enumerate(views):
        pixels = view.board.corners_px
        is_seen = np.isfinite(pixels[:, 0])
        freedoms = int(is_seen.sum()) - len(powers)
        if freedoms < _LEAST_FREEDOMS:
            continue
        flat = np.stack([x, y, np.ones_like(x)], axis=1)[is_seen]
        H, _ = cv2.findHomography(flat[:, :2], pixels[is_seen])
        if H is None:
            continue
        seen = flat @ H.T
        left = pixels[is_seen] - seen[:, :2] / seen[:, 2:]
        left = left - bends[is_seen] @ np.linalg.lstsq(bends[is_seen], left, rcond=None)[0]
        noise_px[k] = np.sqrt(np.sum(left**2) / freedoms)
    return noise_px
