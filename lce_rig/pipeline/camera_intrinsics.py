"""A camera's intrinsics from the images of the board in sessions, as camera_info and as a new profile."""

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.calibration import MADE_BY
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import (
    NotEnoughDataError,
    ProfileError,
    ResultRefusedError,
    SessionError,
    UsageError,
    refusal_of,
)
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.progress import Progress, silent
from lce_rig.core.results import ImageBoard
from lce_rig.detect.detection import ImageDetection
from lce_rig.detect.finder import BoardFinder
from lce_rig.export.ros_files import camera_info_text
from lce_rig.judge.findings import verdict_of
from lce_rig.judge.intrinsics_check import (
    IntrinsicsCheck,
    compare_with_given,
    judge_lens,
    lens_findings,
    model_findings,
)
from lce_rig.lens.calibrate_lens import estimate_intrinsics
from lce_rig.lens.difference import LensCertainty, certainty_of, profile_errors
from lce_rig.lens.lens_estimate import BoardView, IntrinsicsEstimate, find_weaknesses
from lce_rig.lens.models import MODELS, LensPrior, model_of
from lce_rig.pipeline.comparison import (
    name_sessions,
    require_independent,
    require_one_board,
    require_same,
)
from lce_rig.pipeline.detect_session import detect_boards
from lce_rig.pipeline.result_files import keep_foreign
from lce_rig.rig import Rig, lens_settings, parse_rig, set_value
from lce_rig.rig.sensors import lens_block
from lce_rig.session import Capture, Session
from lce_rig.session.durable import replacing, write_atomically
from lce_rig.session.session import INTRINSICS

Key = tuple[str, str]
"""Capture and channel of an image; of several sessions, the capture's name follows its session's."""
# A typical field of view, 64 deg, if the profile's intrinsics are unusable.
_GUESSED_FOCAL = 0.8


@dataclass(frozen=True, eq=False)
class MeasuredIntrinsics:
    """A camera's intrinsics from the boards of sessions, compared with the profile's.

    Attributes:
        camera: the camera's name.
        channels: the channels whose images were used.
        given: the profile's intrinsics.
        estimate: the intrinsics from the boards.
        check: the profile's intrinsics compared with the estimate; None if they are for another resolution.
        certainty: uncertainty of the estimate, per pixel.
        judgement: whether the captures determine the intrinsics better than the profile, see `judge_lens`; or
            another lens model that fits them.
        misfit: misfit of the profile's intrinsics; None if they fit, or are for another resolution.
        weaknesses: directions that the captures do not determine, with advice.
        refused: name of an image -> why the estimate does not use it.
    """

    camera: str
    channels: tuple[str, ...]
    given: Intrinsics
    estimate: IntrinsicsEstimate
    check: IntrinsicsCheck | None
    certainty: LensCertainty
    judgement: Finding
    misfit: Finding | None
    weaknesses: tuple[str, ...]
    refused: Mapping[str, Refusal]

    @property
    def intrinsics(self) -> Intrinsics:
        """The estimate, rounded as in the written files."""
        lens = self.estimate.intrinsics
        pixels = {key: round(getattr(lens, key), 4) for key in ("fx_px", "fy_px", "cx_px", "cy_px")}
        return replace(lens, **pixels, distortion=tuple(round(value, 8) for value in lens.distortion))

    def deviations(self) -> dict[str, float]:
        """Compute the standard deviations of the profile's block `intrinsics`, px, by key."""
        estimate, lens = self.estimate, self.estimate.intrinsics
        cov = profile_errors(lens, estimate.corners_px, estimate.cov, estimate.model)
        focal, x, y, corner_px = np.sqrt(np.diag(cov)).tolist()
        return {
            "focal_sigma_px": float(f"{focal * lens.fx_px:.2g}"),
            "principal_point_sigma_px": float(f"{np.sqrt((x**2 + y**2) / 2):.2g}"),
            "distortion_sigma_px": float(f"{corner_px:.2g}"),
        }


def measure_intrinsics(
    sessions: Sequence[Session],
    camera: str,
    *,
    channels: Sequence[str] = (),
    model: str | None = None,
    progress: Progress = silent,
) -> MeasuredIntrinsics:
    """Fit a camera's intrinsics to the boards in its images.

    The profile's intrinsics only serve to find misplaced corners. If they prove wrong, corners are detected
    again with the fitted ones.

    Args:
        sessions: at least one, open for reading, of one rig and board.
        camera: the camera's name.
        channels: the channels whose images to use, as they share the lens; by default those of kind frames,
            or else of events.
        model: name of a lens model; the profile's if None.
        progress: called with (done, total).

    Raises:
        UsageError: no such channel or model, or a session given twice.
        SessionError: sessions of different rigs, intrinsics or boards, or with the same captures.
        NotEnoughDataError: too few images show the board, or the focal length is undetermined.
    """
    rig = sessions[0].rig
    named = name_sessions(sessions)
    require_same(named)
    require_one_board(named)
    require_independent(named)
    if model not in (None, *MODELS):
        raise UsageError(f"unknown lens model {model!r}; choose one of: {', '.join(MODELS)}")
    have = rig.cameras[camera].channels
    unknown = sorted(set(channels) - set(have))
    if unknown:
        raise UsageError(f"camera {camera} has no channel {unknown[0]!r}; it has {', '.join(have)}")
    frames = tuple(name for name, settings in have.items() if settings.kind == "frames")
    chosen = tuple(dict.fromkeys(channels)) or frames or tuple(have)
    given = rig.cameras[camera].to_intrinsics()
    jobs, seen_in_events = _images_of(sessions, camera, chosen)
    start = given
    found = _look(rig, camera, jobs, start, np.inf, progress) | seen_in_events
    if _n_captures(found) < rig.quality.min_captures:
        width, height = given.width_px, given.height_px
        for (_, channel), capture in jobs.items():
            with suppress(SessionError):
                height, width = capture.image(camera, channel).pixels.shape[:2]
                break
        focal, straight = _GUESSED_FOCAL * width, (0.0,) * len(given.distortion)
        middle = (width - 1) / 2, (height - 1) / 2
        start = Intrinsics(focal, focal, *middle, width, height, given.model, straight)
        found = _look(rig, camera, jobs, start, np.inf, progress) | seen_in_events
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
        again = {key: capture for key, capture in jobs.items() if key in doubtful}
        found |= _look(rig, camera, again, estimate.intrinsics, limit_px, progress)
        estimate = _fit(camera, found, rig, estimate.intrinsics, model)
    lens, target_deg = estimate.intrinsics, rig.calibration.target_sigma_deg
    certainty = certainty_of(lens, estimate.corners_px, estimate.cov, estimate.model)
    check = None
    if (given.width_px, given.height_px) == (lens.width_px, lens.height_px):
        check = compare_with_given(estimate, given, rig.board.to_board())
    judgement = judge_lens(certainty.covered, certainty.image_sigma_px, check, target_deg)
    judgement = next(iter(model_findings(estimate, rig.board.to_board())), judgement)
    refused = {f"{name}.{channel}": why for (name, channel), why in found.items() if isinstance(why, Refusal)}
    return MeasuredIntrinsics(
        camera=camera,
        channels=chosen,
        given=given,
        estimate=estimate,
        check=check,
        certainty=certainty,
        judgement=judgement,
        misfit=next(iter(lens_findings(check, target_deg)), None),
        weaknesses=find_weaknesses(estimate, certainty),
        refused=dict(sorted({**refused, **estimate.refused}.items())),
    )


def _images_of(
    sessions: Sequence[Session], camera: str, channels: Sequence[str]
) -> tuple[dict[Key, Capture], dict[Key, ImageDetection]]:
    """List a camera's images in sessions, and the boards found in those reconstructed from raw events."""
    jobs: dict[Key, Capture] = {}
    seen_in_events: dict[Key, ImageDetection] = {}
    for session in sessions:
        prefix = "" if len(sessions) == 1 else f"{session.path}/"
        pictured = set()
        for capture in session.captures:
            # Every channel reports a capture with a damaged manifest.
            held = [(camera, channel) for channel in channels]
            with suppress(SessionError):
                held = capture.image_keys
            own = [channel for channel in channels if (camera, channel) in held]
            jobs |= {(prefix + capture.name, channel): capture for channel in own}
            pictured.update(own)
        have = session.rig.cameras[camera].channels
        of_events = [name for name in channels if have[name].kind == "events" and name not in pictured]
        in_events = detect_boards(session).images if of_events else {}
        seen_in_events |= {
            (prefix + capture, channel): detection
            for channel in of_events
            for capture, detection in in_events.get((camera, channel), {}).items()
        }
    return jobs, seen_in_events


def _look(
    rig: Rig,
    camera: str,
    jobs: Mapping[Key, Capture],
    lens: Intrinsics,
    max_reprojection_px: float,
    progress: Progress,
) -> dict[Key, ImageDetection]:
    """Find the board in images."""
    finder = BoardFinder(rig)

    def find(key: Key) -> ImageDetection:
        try:
            image = jobs[key].image(camera, key[1])
            return finder.corners(image, lens, max_reprojection_px=max_reprojection_px)
        except SessionError as error:
            return refusal_of("read", error)
        except ProfileError as error:
            return refusal_of("image", error)

    found: dict[Key, ImageDetection] = {}
    with ThreadPoolExecutor(2) as pool:
        for key, detection in zip(jobs, pool.map(find, jobs), strict=True):
            found[key] = detection
            progress(len(found), len(jobs))
    return found


def _n_captures(found: Mapping[Key, ImageDetection]) -> int:
    return len({name for (name, _), board in found.items() if isinstance(board, ImageBoard)})


def _fit(
    camera: str, found: Mapping[Key, ImageDetection], rig: Rig, start: Intrinsics, model: str | None
) -> IntrinsicsEstimate:
    """Fit intrinsics to the boards.

    Raises:
        NotEnoughDataError: too few captures show a board; the most frequent causes are named.
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
    # Same weights as in `calibrate`; the profile is not used for another model or resolution.
    prior = LensPrior.read(rig.cameras[camera], rig.board)
    sizes = [(lens.width_px, lens.height_px) for lens in (start, prior.lens)]
    is_comparable = sizes[0] == sizes[1] and lens_model == model_of(prior.lens)
    return estimate_intrinsics(views, board, start, lens_model, prior=prior if is_comparable else None)


def write_intrinsics(session: Session, measured: Sequence[MeasuredIntrinsics]) -> list[Path]:
    """Write the session's intrinsics/ in one step: one camera_info file per camera.

    Other files stay, such as those of cameras from an earlier run.

    Returns:
        The files of this run.

    Raises:
        SessionError: see `replacing`; earlier files are unchanged.
    """
    place = session.path / INTRINSICS
    names = {f"camera_info_{one.camera}.yaml": one for one in measured}

    def finish(earlier: Path, draft: Path) -> None:
        keep_foreign(earlier, draft, lambda _path: False)

    with replacing(session.path, place, finish) as draft:
        for name, one in names.items():
            text = camera_info_text(one.camera, one.intrinsics, _head(session.rig, one))
            write_atomically(draft / name, text)
    return [place / name for name in names]


def save_profile(
    session: Session, measured: Sequence[MeasuredIntrinsics], path: Path, *, is_forced: bool = False
) -> tuple[str, ...]:
    """Write a copy of the session's profile with the improved intrinsics; comments are kept.

    Args:
        session: the session with the original profile.
        measured: intrinsics estimated from its boards.
        path: the file to write.
        is_forced: whether to write all intrinsics, not only the significantly better ones.

    Returns:
        The cameras whose intrinsics were replaced.

    Raises:
        UsageError: the file exists already.
        ResultRefusedError: no intrinsics are better than the profile's; nothing is written.
        ProfileError: the profile with these intrinsics is not valid.
    """
    refused = [one for one in measured if one.judgement.code != "intrinsics.better" and not is_forced]
    measured = [one for one in measured if one not in refused]
    if not measured:
        raise ResultRefusedError(
            f"{path} is not written: the boards determine no intrinsics better than the profile",
            "To write them nevertheless, add --force.",
        )
    text = session.profile_text()
    for one in measured:
        for key, value in lens_settings(one.camera, one.intrinsics, **one.deviations()):
            text = set_value(text, key, value)
    head = "".join(f"# {line}\n" for one in measured for line in _head(session.rig, one))
    write_profile(head + text, path)
    return tuple(one.camera for one in measured)


def write_profile(text: str, path: Path) -> None:
    """Write the text of a valid profile to a new file.

    Raises:
        UsageError: the file exists already.
        ProfileError: the profile is not valid.
    """
    if path.exists():
        raise UsageError(f"{path} exists already", "Choose another file; existing files are kept.")
    parse_rig(text, str(path))
    write_atomically(path, text)


def _head(rig: Rig, measured: MeasuredIntrinsics) -> list[str]:
    estimate = measured.estimate
    n = len({view.capture for view in estimate.views})
    return [
        f"intrinsics of camera {measured.camera} of rig {rig.name}, measured by {MADE_BY} from {n} captures",
        f"reprojection error {estimate.rms_px:.3f} px rms, {estimate.held_out_rms_px:.3f} px on held-out "
        "captures",
        *(f"weak: {text}" for text in measured.weaknesses),
    ]


def document(rig: Rig, measured: Sequence[MeasuredIntrinsics]) -> dict[str, Any]:
    """List the figures as plain types; unknown ones are null."""
    return {
        "rig": rig.name,
        "made_by": MADE_BY,
        "cameras": [*map(_camera, measured)],
    }


def _camera(measured: MeasuredIntrinsics) -> dict[str, Any]:
    """List one camera's intrinsics; its profile's are null if they are for another resolution."""
    estimate, lens = measured.estimate, measured.intrinsics
    check, profile = measured.check, None
    if check is not None:
        # A figure may not be finite, as when the profile's intrinsics project nothing.
        figures = asdict(check).items()
        profile = {
            "intrinsics": lens_block(measured.given),
            **{name: v if v is not None and np.isfinite(v) else None for name, v in figures},
            "verdict": verdict_of([] if measured.misfit is None else [measured.misfit]),
        }
    return {
        "camera": measured.camera,
        "channels": list(measured.channels),
        "model": estimate.model.name,
        "resolution_px": [lens.width_px, lens.height_px],
        "intrinsics": lens_block(lens),
        "parameters": list(estimate.model.parameters),
        "sigma": estimate.sigma.tolist(),
        "cov": estimate.cov.tolist(),
        "inflation": estimate.inflation,
        "rms_px": estimate.rms_px,
        "held_out_px": estimate.held_out_rms_px,
        "board": {
            "bow_m": estimate.pattern_shape[0][:2].tolist(),
            "aspect": float(estimate.pattern_shape[0][2]),
            "sigma": estimate.pattern_shape[1].tolist(),
            "print_rms_m": estimate.print_rms_m,
        },
        "covered": measured.certainty.covered,
        "judgement": measured.judgement.as_json(),
        "weaknesses": list(measured.weaknesses),
        "views_used": [view.name for view in estimate.views],
        "views_refused": {name: why.as_json() for name, why in measured.refused.items()},
        "profile": profile,
    }
