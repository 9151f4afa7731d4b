"""Check whether the profile's intrinsics still fit the camera, with the boards of a calibration.

Residuals alone are insufficient: a focal length error of 2 % moves the boards 2 % away and increases corner
residuals by a tenth of their noise. The check therefore fits intrinsics to the boards and compares them with
the profile's in units of their uncertainty.

A fisheye lens entered as radtan does not fit as well as corners can. Their noise needs no lens: in one image,
a homography and a cubic polynomial of the board's coordinates take up perspective, distortion and the board's
bend.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

import cv2
import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array
from lce_rig.judge.findings import (
    INTRINSICS,
    INTRINSICS_BETTER,
    INTRINSICS_FIT,
    INTRINSICS_UNDETERMINED,
    LENS_MODEL,
    READOUT,
    failing,
)
from lce_rig.lens.calibrate_lens import distances_under, estimate_intrinsics
from lce_rig.lens.difference import certainty_of, compare_lenses
from lce_rig.lens.fit import fit_readout
from lce_rig.lens.lens_estimate import BoardView, IntrinsicsEstimate
from lce_rig.lens.models import MODELS, model_of

# A difference is significant below this probability.
_CHANCE = 0.002
# Limits of bent images and of a camera rotated by its principal point, in units of the target rotation.
_BENT, _TURNED = 0.5, 1.5
_N_FOLDS = 2
# Intrinsics for a profile determine pixels to the image's border. The standard deviation there may be as
# large as the profile's error where boards were seen, within these limits.
_KNOWN_PX = (1.0, 5.0)
# Squared distance from the profile's intrinsics, in their standard deviations, of another lens.
_OTHER_LENS = 36.0
# Limit of residuals in the median image, in units of the noise, beyond which the lens is another one: 0.5 to
# 1.1 in 17 sound sessions, 11 of them recorded; 6 for a fisheye lens entered as radtan. Twice that fails.
_MISFIT, _FAIL = 2.0, 2.0
# Variance of shears along the image's rows in the median image, in units of the corners' noise: in ten sound
# recordings 0.1 to 2.0, in three of them with rows read out over 20 ms while boards move at 0.15 m/s 0.3
# (corner noise 0.2 px), 8 and 11. Shears are printed per 100 rows.
_READOUT, _ROWS = 4.0, 100.0
# Least ratio of the residuals of the profile's model and of one that fits; largest of models that fit alike.
_NEARER, _ALIKE = 2.0, 1.25
_DEGREE, _LEAST_FREEDOMS = 3, 8


@dataclass(frozen=True)
class IntrinsicsCheck:
    """Given intrinsics compared with those fitted to the boards.

    Attributes:
        n_captures: number of captures used.
        rms_px: rms distance of a corner from its prediction by the given intrinsics.
        possible_px: the same for fitted intrinsics on held-out captures.
        displacement_px: rms displacement of pixels between both where boards were seen, after the rotation of
            the camera that minimises it.
        displacement_sigma_px: standard deviation of that.
        displacement_deg: the same as an angle.
        turn_deg: that rotation, which is an error of extrinsics under the given intrinsics.
        turn_sigma_deg: standard deviation of that.
        covered: share of the image in which boards were seen.
        image_sigma_px: standard deviation of the fitted intrinsics, as `LensCertainty.image_sigma_px`.
        surprise, is_contradicted: of the fitted intrinsics, as in `IntrinsicsEstimate`.
    """

    n_captures: int
    rms_px: float
    possible_px: float
    displacement_px: float
    displacement_sigma_px: float
    displacement_deg: float
    turn_deg: float
    turn_sigma_deg: float
    covered: float
    image_sigma_px: float
    surprise: float | None = None
    is_contradicted: bool = False

    def fits(self, target_deg: float = 0.2) -> bool:
        """Check whether the given intrinsics are not significantly different from the fitted ones.

        Args:
            target_deg: target standard deviation of the extrinsics' rotation.
        """
        # Noise alone displaces pixels; only the excess counts.
        noise = min(self.displacement_sigma_px / max(self.displacement_px, 1e-12), 1.0)
        bent = self.displacement_deg * float(np.sqrt(1 - noise**2)) if self.is_displaced else 0.0
        turned = self.turn_deg if self.is_turned else 0.0
        return not (self.is_contradicted or bent > _BENT * target_deg or turned > _TURNED * target_deg)

    @property
    def is_displaced(self) -> bool:
        """Whether pixels are significantly displaced."""
        return self.displacement_px > self._sure * self.displacement_sigma_px

    @property
    def is_turned(self) -> bool:
        """Whether the camera is significantly rotated."""
        return self.turn_deg > self._sure * self.turn_sigma_deg

    @property
    def _sure(self) -> float:
        """Significance threshold in standard deviations, larger with few captures."""
        from scipy.special import stdtrit  # scipy.stats takes a second to import

        return float(stdtrit(self.n_captures - 1, 1 - _CHANCE / 2))


def check_intrinsics(
    image_boards: Sequence[BoardView], intrinsics: Intrinsics, board: Board
) -> IntrinsicsCheck | None:
    """Compare intrinsics with the corners of detected boards.

    Args:
        image_boards: image boards of one camera, by capture and channel.
        intrinsics: the intrinsics to check.
        board: the board.

    Returns:
        None if there are too few boards, or too little tilt, to fit intrinsics.
    """
    # If grossly wrong intrinsics do not converge, they may do so without their distortion.
    plain = replace(intrinsics, distortion=(0.0,) * 4)
    for start in (intrinsics, plain):
        with suppress(NotEnoughDataError):
            fitted = estimate_intrinsics(image_boards, board, start, model_of(intrinsics), n_folds=_N_FOLDS)
            return compare_with_given(fitted, intrinsics, board)
    return None


def compare_with_given(fitted: IntrinsicsEstimate, intrinsics: Intrinsics, board: Board) -> IntrinsicsCheck:
    """Compare intrinsics with fitted ones.

    Args:
        fitted: the fitted intrinsics, of any model.
        intrinsics: the intrinsics to check, at the same resolution.
        board: the board.
    """
    given_px = distances_under(intrinsics, fitted.views, board)
    corners_px = fitted.corners_px
    difference = compare_lenses(intrinsics, fitted.intrinsics, corners_px, fitted.cov, fitted.model)
    turn = difference.turn_rad
    angle = float(np.linalg.norm(turn))
    along = turn / max(angle, 1e-12)
    given_focal = np.sqrt(intrinsics.fx_px * intrinsics.fy_px)
    certainty = certainty_of(fitted.intrinsics, corners_px, fitted.cov, fitted.model)
    return IntrinsicsCheck(
        n_captures=len({view.capture for view in fitted.views}),
        rms_px=float(np.sqrt(np.mean(given_px**2))),
        possible_px=fitted.rms_px if np.isnan(fitted.held_out_rms_px) else fitted.held_out_rms_px,
        displacement_px=difference.rms_px,
        displacement_sigma_px=difference.sigma_px,
        displacement_deg=float(np.degrees(difference.rms_px / given_focal)),
        turn_deg=float(np.degrees(angle)),
        turn_sigma_deg=float(np.degrees(np.sqrt(along @ difference.cov_turn @ along))),
        covered=certainty.covered,
        image_sigma_px=certainty.image_sigma_px,
        surprise=fitted.surprise,
        is_contradicted=fitted.is_contradicted,
    )


def judge_lens(
    covered: float, image_sigma_px: float, check: IntrinsicsCheck | None, target_deg: float = 0.2
) -> Finding:
    """Judge whether the boards of a session determine the intrinsics better than the profile.

    Intrinsics from boards and profile are always at least as good as the profile's alone. Those of boards
    alone are better where the profile's do not fit and a pixel's standard deviation near the image's border
    is smaller than the profile's error where boards were seen. All verbs judge by this.

    Args:
        covered: share of the image in which boards were seen.
        image_sigma_px: uncertainty of the intrinsics from the boards, as `LensCertainty.image_sigma_px`.
        check: the profile's intrinsics compared with them; None if they are for another resolution.
        target_deg: target standard deviation of the extrinsics' rotation.

    Returns:
        "intrinsics.fit" if the profile's fit, else "intrinsics.undetermined" or "intrinsics.better".
    """
    error_px = np.inf if check is None else check.displacement_px
    limit_px = float(np.clip(error_px, *_KNOWN_PX))
    figures: dict[str, Any] = {"covered": covered, "image_sigma_px": image_sigma_px, "limit_px": limit_px}
    if check is not None and check.fits(target_deg):
        return INTRINSICS_FIT(**figures)
    has_prior = check is not None and check.surprise is not None
    is_known = np.isfinite(image_sigma_px) and (has_prior or image_sigma_px <= limit_px)
    return (INTRINSICS_BETTER if is_known else INTRINSICS_UNDETERMINED)(**figures)


def lens_findings(check: IntrinsicsCheck | None, target_deg: float = 0.2) -> list[Finding]:
    """Return the finding of given intrinsics that do not fit, with their difference; else none.

    Args:
        check: result for the intrinsics.
        target_deg: target standard deviation of the extrinsics' rotation.
    """
    if check is None or check.fits(target_deg):
        return []
    judgement = judge_lens(check.covered, check.image_sigma_px, check, target_deg)
    figures: dict[str, Any] = {
        **asdict(check),
        **judgement.figures,
        "is_displaced": check.is_displaced,
        "is_turned": check.is_turned,
    }
    if check.surprise is not None and check.surprise <= _OTHER_LENS:
        # The result uses the fitted intrinsics; only a lens that hardly resembles the profile's is a reason.
        return [INTRINSICS(severity="note", action="weighed", **figures)]
    is_open = check.surprise is None and judgement.code == "intrinsics.undetermined"
    return [INTRINSICS(severity="warning", action="collect" if is_open else "", **figures)]


def model_findings(fitted: IntrinsicsEstimate, board: Board) -> list[Finding]:
    """Test for moving rows, and for other lens models if corners fit worse than their noise allows.

    Args:
        fitted: intrinsics of the profile's model.
        board: the board's specification.

    Returns:
        None where the corners fit, or where the same model fits them with values of its own; else the
        finding, with the model that fits or "".
    """
    noise_px = corner_noise(fitted.views, board)
    counts = [int(np.isfinite(view.board.corners_px[:, 0]).sum()) for view in fitted.views]
    squares = np.sum(fitted.residuals_px**2, axis=1)
    rms_px = np.sqrt([part.mean() for part in np.split(squares, np.cumsum(counts)[:-1])])
    ratios = rms_px / np.maximum(noise_px, 1e-9)
    if np.isnan(ratios).all():
        return []
    if np.nanmedian(ratios) < _MISFIT:
        return _readout(fitted, noise_px)
    reached = {}
    for name, model in MODELS.items():
        with suppress(NotEnoughDataError):
            start = fitted.intrinsics
            reached[name] = estimate_intrinsics(fitted.views, board, start, model, n_folds=0).rms_px
    own, least_px = fitted.model.name, min(reached.values(), default=np.inf)
    # Among models that fit about equally well, choose the one with the fewest parameters.
    near = [name for name, px in reached.items() if px < _ALIKE * least_px]
    best = min(near, key=lambda name: MODELS[name].size, default="")
    if _NEARER * least_px > fitted.rms_px:
        if sheared := _readout(fitted, noise_px):
            return sheared
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


def _readout(fitted: IntrinsicsEstimate, noise_px: Array) -> list[Finding]:
    """Find views (K,) whose corners of known noise are sheared along the image's rows."""
    speed, falls = fit_readout(fitted)
    if np.nanmedian(falls / 2 / np.maximum(noise_px, 1e-9) ** 2) < _READOUT:
        return []
    return [READOUT(shear_px=_ROWS * float(np.sqrt(np.mean(speed**2))))]


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
