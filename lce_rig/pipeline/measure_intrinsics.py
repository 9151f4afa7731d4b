"""Estimate the intrinsics of a session's cameras from its images of the board."""

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import NotEnoughDataError, ProfileError, SessionError, UsageError, refusal_of
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.progress import Progress, silent
from lce_rig.core.results import ImageBoard
from lce_rig.detect.detection import ImageDetection
from lce_rig.detect.finder import BoardFinder
from lce_rig.judge.intrinsics_check import IntrinsicsCheck, compare_with_given, judge_lens, lens_findings
from lce_rig.judge.lens_model import find_other_model, model_findings
from lce_rig.lens.calibrate_lens import estimate_intrinsics
from lce_rig.lens.difference import LensCertainty, LensDifference, certainty_of, lens_errors
from lce_rig.lens.lens_estimate import BoardView, IntrinsicsEstimate, find_weaknesses
from lce_rig.lens.models import MODELS, LensPrior, model_of
from lce_rig.pipeline.detect_session import detect
from lce_rig.rig import Rig
from lce_rig.session import Capture, Session

Key = tuple[str, str]
"""Capture and channel of an image."""
# A typical field of view, 64 deg, if the profile's intrinsics are unusable.
_GUESSED_FOCAL = 0.8
_ANY_REPROJECTION_PX = 1e9


@dataclass(frozen=True, eq=False)
class MeasuredIntrinsics:
    """A camera's intrinsics from the boards of a session, compared with the profile's.

    Attributes:
        camera: its name.
        channels: the channels whose images were used.
        given: the profile's intrinsics.
        estimate: the intrinsics from the boards.
        check: the profile's intrinsics compared with the estimate; None if they are for another resolution.
        difference: per pixel; None likewise.
        certainty: of the estimate, per pixel.
        judgement: whether the captures determine the intrinsics better than the profile, as `judge_lens`, or
            another lens model that fits them.
        misfit: how the profile's do not fit; None if they do, or are for another resolution.
        weaknesses: what the captures do not determine, and what to do.
        refused: name of an image -> why the estimate does not use it.
    """

    camera: str
    channels: tuple[str, ...]
    given: Intrinsics
    estimate: IntrinsicsEstimate
    check: IntrinsicsCheck | None
    difference: LensDifference | None
    certainty: LensCertainty
    judgement: Finding
    misfit: Finding | None
    weaknesses: tuple[str, ...]
    refused: Mapping[str, Refusal]

    @property
    def intrinsics(self) -> Intrinsics:
        """The estimate, rounded as in every file."""
        lens = self.estimate.intrinsics
        pixels = {key: round(getattr(lens, key), 4) for key in ("fx_px", "fy_px", "cx_px", "cy_px")}
        return replace(lens, **pixels, distortion=tuple(round(value, 8) for value in lens.distortion))

    def deviations(self) -> dict[str, float]:
        """Compute the standard deviations of the profile's block `intrinsics`, px, by key.

        Its parameters are correlated: focal length, principal point and distortion share what their
        covariance lets pixels move where boards were seen.
        """
        estimate, lens = self.estimate, self.estimate.intrinsics
        corners_px = estimate.corners_px
        _, cov = lens_errors(lens, lens, corners_px, estimate.cov, estimate.model)
        focal, x, y, corner_px = np.sqrt(np.diag(cov)).tolist()
        return {
            "focal_sigma_px": float(f"{focal * lens.fx_px:.2g}"),
            "principal_point_sigma_px": float(f"{np.sqrt((x**2 + y**2) / 2):.2g}"),
            "distortion_sigma_px": float(f"{corner_px:.2g}"),
        }


def measure_intrinsics(
    session: Session,
    camera: str,
    *,
    channels: Sequence[str] = (),
    model: str | None = None,
    progress: Progress = silent,
) -> MeasuredIntrinsics:
    """Fit a camera's intrinsics to the boards in its images.

    The profile's intrinsics only decide which corners look misplaced. If they turn out to be wrong, corners
    are detected again with the fitted ones.

    Args:
        session: open for reading is enough.
        camera: its name.
        channels: the channels whose images to use, as they share the lens; by default those of kind frames,
            or of events if there are no frames.
        model: name of a lens model; the profile's if None.
        progress: called with (done, total).

    Raises:
        UsageError: no such channel or model.
        NotEnoughDataError: too few images show the board, or the focal length is undetermined.
    """
    rig = session.rig
    if model not in (None, *MODELS):
        raise UsageError(f"there is no lens model {model!r}; there is {', '.join(MODELS)}")
    have = rig.cameras[camera].channels
    unknown = sorted(set(channels) - set(have))
    if unknown:
        raise UsageError(f"camera {camera} has no channel {unknown[0]!r}; it has {', '.join(have)}")
    frames = tuple(name for name, settings in have.items() if settings.kind == "frames")
    chosen = tuple(dict.fromkeys(channels)) or frames or tuple(have)
    given = rig.cameras[camera].to_intrinsics()
    jobs = []
    for capture in session.captures:
        # Every channel reports a capture with a damaged manifest.
        held = [(camera, channel) for channel in chosen]
        with suppress(SessionError):
            held = capture.image_keys
        jobs += [(capture, channel) for channel in chosen if (camera, channel) in held]
    pictured = {channel for _, channel in jobs}
    of_events = [name for name in chosen if have[name].kind == "events" and name not in pictured]
    in_events = detect(session).images if of_events else {}
    seen_in_events: dict[Key, ImageDetection] = {
        (capture, channel): detection
        for channel in of_events
        for capture, detection in in_events.get((camera, channel), {}).items()
    }
    start = given
    found = _look(rig, camera, jobs, start, _ANY_REPROJECTION_PX, progress) | seen_in_events
    if _n_captures(found) < rig.quality.min_captures:
        width, height = _size_px(camera, jobs) or (given.width_px, given.height_px)
        focal, straight = _GUESSED_FOCAL * width, (0.0,) * len(given.distortion)
        middle = (width - 1) / 2, (height - 1) / 2
        start = Intrinsics(focal, focal, *middle, width, height, given.model, straight)
        found = _look(rig, camera, jobs, start, _ANY_REPROJECTION_PX, progress) | seen_in_events
    estimate = _fit(camera, found, rig, start, model)
    # Wrong intrinsics may have caused a detection to fail: board, pose or single corners.
    limit_px = rig.quality.max_reprojection_px
    doubtful = {
        key
        for key, board in found.items()
        if isinstance(board, Refusal)
        or board.reprojection_px > limit_px
        or (board.quality is not None and board.quality.n_corners < np.isfinite(board.corners_px[:, 0]).sum())
    }
    if doubtful:
        again = [(capture, channel) for capture, channel in jobs if (capture.name, channel) in doubtful]
        found |= _look(rig, camera, again, estimate.intrinsics, limit_px, progress)
        estimate = _fit(camera, found, rig, estimate.intrinsics, model)
    lens, target_deg = estimate.intrinsics, rig.calibration.target_sigma_deg
    certainty = certainty_of(lens, estimate.corners_px, estimate.cov, estimate.model)
    check, difference = None, None
    if (given.width_px, given.height_px) == (lens.width_px, lens.height_px):
        check, difference = compare_with_given(estimate, given, rig.board.to_board())
    judgement = judge_lens(certainty.covered, certainty.image_sigma_px, check, target_deg)
    judgement = next(iter(model_findings(find_other_model(estimate, rig.board.to_board()))), judgement)
    refused = {f"{name}.{channel}": why for (name, channel), why in found.items() if isinstance(why, Refusal)}
    return MeasuredIntrinsics(
        camera=camera,
        channels=chosen,
        given=given,
        estimate=estimate,
        check=check,
        difference=difference,
        certainty=certainty,
        judgement=judgement,
        misfit=next(iter(lens_findings(check, target_deg)), None),
        weaknesses=find_weaknesses(estimate, certainty),
        refused=dict(sorted({**refused, **estimate.refused}.items())),
    )


def _size_px(camera: str, jobs: Sequence[tuple[Capture, str]]) -> tuple[int, int] | None:
    """Measure the first readable image; None without any."""
    for capture, channel in jobs:
        with suppress(SessionError):
            height, width = capture.image(camera, channel).pixels.shape[:2]
            return width, height
    return None


def _look(
    rig: Rig,
    camera: str,
    jobs: Sequence[tuple[Capture, str]],
    lens: Intrinsics,
    max_reprojection_px: float,
    progress: Progress,
) -> dict[Key, ImageDetection]:
    """Find the board in images."""
    finder = BoardFinder(rig)

    def find(job: tuple[Capture, str]) -> ImageDetection:
        capture, channel = job
        try:
            image = capture.image(camera, channel)
            return finder.corners(image, lens, max_reprojection_px=max_reprojection_px)
        except SessionError as error:
            return refusal_of("read", error)
        except ProfileError as error:
            return refusal_of("image", error)

    found: dict[Key, ImageDetection] = {}
    with ThreadPoolExecutor(2) as pool:
        for (capture, channel), detection in zip(jobs, pool.map(find, jobs), strict=True):
            found[capture.name, channel] = detection
            progress(len(found), len(jobs))
    return found


def _n_captures(found: Mapping[Key, ImageDetection]) -> int:
    return len({name for (name, _), board in found.items() if isinstance(board, ImageBoard)})


def _fit(
    camera: str, found: Mapping[Key, ImageDetection], rig: Rig, start: Intrinsics, model: str | None
) -> IntrinsicsEstimate:
    """Fit intrinsics to the boards.

    Raises:
        NotEnoughDataError: too few captures show one; the most frequent causes are named.
    """
    n_needed = rig.quality.min_captures
    if _n_captures(found) < n_needed:
        causes = Counter(why.text for why in found.values() if isinstance(why, Refusal))
        hint = "\n".join(f"{count} x {cause}" for cause, count in causes.most_common(3))
        n, total = _n_captures(found), len({name for name, _ in found})
        raise NotEnoughDataError(
            f"camera {camera}: the board is in {n} of {total} captures (minimum {n_needed})",
            hint or "collect captures with images of the board first",
        )
    views = [
        BoardView(capture, channel, board)
        for (capture, channel), board in sorted(found.items())
        if isinstance(board, ImageBoard)
    ]
    board = rig.board.to_board()
    lens_model = model_of(start) if model is None else MODELS[model]
    # As `calibrate` weighs them; the profile's have no part in another model or resolution.
    prior = LensPrior.read(rig.cameras[camera], rig.board)
    sizes = [(lens.width_px, lens.height_px) for lens in (start, prior.lens)]
    is_comparable = sizes[0] == sizes[1] and lens_model == model_of(prior.lens)
    return estimate_intrinsics(views, board, start, lens_model, prior=prior if is_comparable else None)
