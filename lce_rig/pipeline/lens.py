"""Estimate the intrinsics of a session's cameras from its images of the board."""

from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image
from lce_rig.core.errors import NotEnoughDataError, ProfileError, SessionError, UsageError, refusal_of
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.results import ImageBoard
from lce_rig.detect.detection import ImageDetection
from lce_rig.detect.finder import BoardFinder
from lce_rig.detect.image.search import crop_to_intrinsics
from lce_rig.judge.intrinsics_check import IntrinsicsCheck, compare_with_given, explain, judge_lens
from lce_rig.lens.calibrate_lens import MIN_CAPTURES, Choice, choose_model, estimate_intrinsics
from lce_rig.lens.difference import LensCertainty, LensDifference, certainty_of
from lce_rig.lens.lens_coverage import find_weaknesses
from lce_rig.lens.lens_estimate import BoardView, IntrinsicsEstimate
from lce_rig.lens.models import MODELS, model_of
from lce_rig.pipeline.detect_session import Progress, detect, silent
from lce_rig.rig import Rig
from lce_rig.session import Capture, Session
from lce_rig.words import describe

AUTO = "auto"
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
        given: the profile's intrinsics, scaled to the images if their resolution differs.
        estimate: the intrinsics from the boards.
        choice: the chosen model and why, if models were compared.
        check: the profile's intrinsics compared with the estimate; None if they are for another resolution.
        difference: per pixel; None likewise.
        certainty: of the estimate, per pixel.
        judgement: whether the captures determine the intrinsics better than the profile, as `judge_lens`.
        misfit: how the profile's do not fit; None if they do, or are for another resolution.
        weaknesses: what the captures do not determine, and what to do.
        refused: name of an image -> why the estimate does not use it.
    """

    camera: str
    channels: tuple[str, ...]
    given: Intrinsics
    estimate: IntrinsicsEstimate
    choice: Choice | None
    check: IntrinsicsCheck | None
    difference: LensDifference | None
    certainty: LensCertainty
    judgement: Finding
    misfit: Finding | None
    weaknesses: tuple[str, ...]
    refused: Mapping[str, Refusal]


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
        model: name of a lens model, or "auto" to compare all; the profile's if None.
        progress: called with (done, total).

    Raises:
        UsageError: no such channel or model.
        NotEnoughDataError: too few images show the board, or the focal length is undetermined.
    """
    rig = session.rig
    if model not in (None, AUTO, *MODELS):
        raise UsageError(f"there is no lens model {model!r}; there is {', '.join(MODELS)} and {AUTO}")
    chosen = _channels(rig, camera, channels)
    given = rig.cameras[camera].to_intrinsics()
    samples = _Samples(session, camera, chosen)
    start = samples.lens_at_their_size(given)
    found = samples.look(start, progress=progress)
    if _n_captures(found) < MIN_CAPTURES:
        start = _usual_lens(start)
        found = samples.look(start, progress=progress)
    _require_boards(camera, found)
    estimate, choice = _fit(found, rig, start, model)
    limit_px = rig.quality.max_reprojection_px
    doubtful = {key for key, board in found.items() if _is_doubtful(board, limit_px)}
    if doubtful:
        start = estimate.intrinsics
        found |= samples.look(start, limit_px, only=doubtful, progress=progress)
        _require_boards(camera, found)
        estimate, choice = _fit(found, rig, start, model)
    return _measured(camera, chosen, given, estimate, choice, found, rig)


def _channels(rig: Rig, camera: str, wanted: Sequence[str]) -> tuple[str, ...]:
    have = rig.cameras[camera].channels
    unknown = sorted(set(wanted) - set(have))
    if unknown:
        raise UsageError(f"camera {camera} has no channel {unknown[0]!r}; it has {', '.join(have)}")
    frames = tuple(name for name, settings in have.items() if settings.kind == "frames")
    return tuple(dict.fromkeys(wanted)) or frames or tuple(have)


class _Samples:
    """The images of one camera's channels in a session."""

    def __init__(self, session: Session, camera: str, channels: Sequence[str]) -> None:
        self._session = session
        self._camera = camera
        settings = session.rig.cameras[camera].channels
        self._is_events = {name: settings[name].kind == "events" for name in channels}
        self._jobs = list(_pictures(session.captures, camera, channels))

    def lens_at_their_size(self, given: Intrinsics) -> Intrinsics:
        """Scale intrinsics to the size of the first readable image, if it differs."""
        for capture, channel in self._jobs:
            try:
                image = capture.image(self._camera, channel)
                crop_to_intrinsics(image, given)
            except SessionError:
                continue
            except ProfileError:
                return _scaled(given, image)
            break
        return given

    def look(
        self,
        lens: Intrinsics,
        max_reprojection_px: float = _ANY_REPROJECTION_PX,
        *,
        only: Container[Key] | None = None,
        progress: Progress = silent,
    ) -> dict[Key, ImageDetection]:
        """Find the board in every image, or in some of them only.

        For a channel without images, the session's detections in its events are used.
        """
        jobs = [
            (capture, channel)
            for capture, channel in self._jobs
            if only is None or (capture.name, channel) in only
        ]
        finder = BoardFinder(self._session.rig)

        def find(job: tuple[Capture, str]) -> ImageDetection:
            capture, channel = job
            try:
                image = capture.image(self._camera, channel)
                return finder.corners(image, lens, max_reprojection_px=max_reprojection_px)
            except SessionError as error:
                return refusal_of("read", error)
            except ProfileError as error:
                return refusal_of("image", error)

        found: dict[Key, ImageDetection] = {}
        with ThreadPoolExecutor(2) as pool:
            seen = pool.map(find, jobs)
            for done, ((capture, channel), detection) in enumerate(zip(jobs, seen, strict=True), 1):
                found[capture.name, channel] = detection
                progress(done, len(jobs))
        return found if only is not None else found | self._seen_in_events()

    def _seen_in_events(self) -> dict[Key, ImageDetection]:
        pictured = {channel for _, channel in self._jobs}
        channels = [name for name, is_events in self._is_events.items() if is_events and name not in pictured]
        images = detect(self._session).images if channels else {}
        return {
            (capture, channel): detection
            for channel in channels
            for capture, detection in images.get((self._camera, channel), {}).items()
        }


def _pictures(
    captures: Iterable[Capture], camera: str, channels: Sequence[str]
) -> Iterable[tuple[Capture, str]]:
    """List the images of the channels; every channel reports a capture with a damaged manifest."""
    for capture in captures:
        try:
            held = capture.image_keys
        except SessionError:
            held = [(camera, channel) for channel in channels]
        yield from ((capture, channel) for channel in channels if (camera, channel) in held)


def _is_doubtful(board: ImageDetection, limit_px: float) -> bool:
    """Return whether wrong intrinsics may have caused a detection to fail: board, pose or single corners."""
    if isinstance(board, Refusal):
        return True
    return board.reprojection_px > limit_px or (
        board.quality is not None and board.quality.n_corners < len(board.corners_px)
    )


def _scaled(given: Intrinsics, image: Image) -> Intrinsics:
    height, width = image.pixels.shape[:2]
    scale = width / given.width_px
    return replace(
        given,
        fx_px=given.fx_px * scale,
        fy_px=given.fy_px * scale,
        cx_px=(width - 1) / 2,
        cy_px=(height - 1) / 2,
        width_px=width,
        height_px=height,
    )


def _usual_lens(lens: Intrinsics) -> Intrinsics:
    width, height = lens.width_px, lens.height_px
    focal = _GUESSED_FOCAL * width
    return Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height, lens.model)


def _n_captures(found: Mapping[Key, ImageDetection]) -> int:
    return len({name for (name, _), board in found.items() if isinstance(board, ImageBoard)})


def _require_boards(camera: str, found: Mapping[Key, ImageDetection]) -> None:
    n, total = _n_captures(found), len({name for name, _ in found})
    if n >= MIN_CAPTURES:
        return
    causes = Counter(describe(why) for why in found.values() if isinstance(why, Refusal))
    hint = "\n".join(f"{count} x {cause}" for cause, count in causes.most_common(3))
    raise NotEnoughDataError(
        f"camera {camera}: the board is in {n} of {total} captures, intrinsics need {MIN_CAPTURES} at least "
        "and 15 for a good result",
        hint or "collect captures with images of the board first",
    )


def _fit(
    found: Mapping[Key, ImageDetection], rig: Rig, start: Intrinsics, model: str | None
) -> tuple[IntrinsicsEstimate, Choice | None]:
    views = [
        BoardView(capture, channel, board)
        for (capture, channel), board in sorted(found.items())
        if isinstance(board, ImageBoard)
    ]
    board = rig.board.to_board()
    if model == AUTO:
        return choose_model(views, board, start)
    lens_model = model_of(start) if model is None else MODELS[model]
    return estimate_intrinsics(views, board, start, lens_model), None


def _measured(
    camera: str,
    channels: tuple[str, ...],
    given: Intrinsics,
    estimate: IntrinsicsEstimate,
    choice: Choice | None,
    found: Mapping[Key, ImageDetection],
    rig: Rig,
) -> MeasuredIntrinsics:
    lens = estimate.intrinsics
    certainty = certainty_of(lens, estimate.corners_px.reshape(-1, 2), estimate.cov, estimate.model)
    check, difference = None, None
    if (given.width_px, given.height_px) == (lens.width_px, lens.height_px):
        check, difference = compare_with_given(estimate, given, rig.board.to_board())
    target_deg = rig.calibration.target_sigma_deg
    fits = check is None or check.verdict(target_deg) == "pass"
    refused = {f"{name}.{channel}": why for (name, channel), why in found.items() if isinstance(why, Refusal)}
    return MeasuredIntrinsics(
        camera=camera,
        channels=channels,
        given=given,
        estimate=estimate,
        choice=choice,
        check=check,
        difference=difference,
        certainty=certainty,
        judgement=judge_lens(certainty.covered, certainty.image_sigma_px, check, target_deg),
        misfit=None if check is None or fits else explain(check, target_deg),
        weaknesses=find_weaknesses(estimate, certainty),
        refused=dict(sorted({**refused, **estimate.refused}.items())),
    )
