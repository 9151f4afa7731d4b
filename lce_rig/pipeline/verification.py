"""Compare extrinsics with captures: residuals, overlays, and the sensors' detections."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np

from lce_rig.core.calibration import Calibration, ResultFile, SceneOpinion, read_result
from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import SessionError
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.geometry import Array
from lce_rig.core.progress import Progress, silent
from lce_rig.detect.detection import Detections, Pair
from lce_rig.judge.board_drift import watch_boards
from lce_rig.judge.session_check import SessionCheck, check_session
from lce_rig.pipeline.detect_session import detect_boards, event_channels, event_picture, match_sensors
from lce_rig.pipeline.findings import OTHER_PROFILE
from lce_rig.pipeline.result_files import (
    OVERLAYS,
    RESULT,
    Result,
    keep_foreign,
    result_content,
    result_folder,
    stored_results,
    with_profile_of,
)
from lce_rig.pipeline.witness import hear_scene
from lce_rig.rig import Rig, load_rig
from lce_rig.session import Capture, Session
from lce_rig.session.durable import replacing
from lce_rig.session.identity import differing_keys
from lce_rig.session.session import DEBUG, PROFILE
from lce_rig.show.overlays.overlay import PAGE, draw_check, draw_cloud, is_overlay, seen_through_window


@dataclass(frozen=True, eq=False)
class Verification:
    """Extrinsics compared with the captures of a session.

    Attributes:
        session: the source of the captures.
        checks: one for each channel of a camera and LiDAR with captures in the session.
        calibrations: the extrinsics, including those of sensors without captures.
        detections: detections of the session.
        own_result: content of the session's result.json if the calibrations come from it, else None.
        name: name of that result; None for the one in calibration/.
        notes: differences between the profiles of session and result.
    """

    session: Session
    checks: tuple[SessionCheck, ...]
    calibrations: tuple[Calibration, ...]
    detections: Detections
    own_result: bytes | None
    name: str | None = None
    notes: tuple[Finding, ...] = ()

    @property
    def unchecked(self) -> tuple[Calibration, ...]:
        """Extrinsics of sensors without captures in the session."""
        checked = {(check.pair.camera, check.pair.lidar) for check in self.checks}
        return tuple(c for c in self.calibrations if (c.camera, c.lidar) not in checked)

    def write(
        self, folder: Path | str | None = None, *, progress: Progress = silent
    ) -> tuple[SessionCheck, ...]:
        """Project the point clouds into all images of the session, with a page for each pair.

        Args:
            folder: folder for the images; by default overlays/ beside the session's result.json if the result
                is its own, else the session's overlays/, replaced in one step. Several pairs get a folder
                each.
            progress: called with (done, total) for each pair in turn.

        Returns:
            The checks, with their pages.

        Raises:
            SessionError: an image cannot be written; or the session's result was replaced meanwhile, in which
                case the overlays there are unchanged.
        """
        session = self.session
        if folder is not None:
            return self._draw(Path(folder), Path(folder), progress)
        result = result_folder(session.path, self.name)
        place = (session.path if self.own_result is None else result) / OVERLAYS

        def finish(earlier: Path, draft: Path) -> None:
            if self.own_result is not None and result_content(result) != self.own_result:
                raise SessionError(
                    f"{result} was calibrated again while overlays were drawn",
                    f"Run `lce-rig verify {session.path}` again.",
                )
            keep_foreign(earlier, draft, is_overlay)

        with replacing(session.path, place, finish) as draft:
            return self._draw(draft, place, progress)

    def _draw(self, base: Path, place: Path, progress: Progress) -> tuple[SessionCheck, ...]:
        """Draw into a temporary folder, with links for its final place."""
        drawn = []
        for check in self.checks:
            pair = check.pair
            name = "" if len(self.checks) == 1 else pair.folder_name
            shown, image_of = check, partial(_image, self.session, pair.camera, pair.channel)
            if check.calibration.is_of_lidars:
                shown, T_view = seen_through_window(check)
                image_of = partial(_image, self.session, pair.camera, "", T_view=T_view)
            draw_check(
                self.session,
                self.detections,
                shown,
                base / name,
                image_of=image_of,
                scan_of=partial(_scan, self.session, pair),
                progress=progress,
            )
            drawn.append(replace(check, page=place / name / PAGE))
        return tuple(drawn)


def verify(
    session: Session,
    result: Result | ResultFile | None = None,
    detections: Detections | None = None,
    *,
    name: str | None = None,
    profile: Rig | None = None,
    progress: Progress = silent,
) -> Verification:
    """Compare extrinsics with every capture of a session.

    Args:
        session: session with the captures, not necessarily that of the extrinsics.
        result: result of `calibrate` or `read_result`; None for the session's result.json.
        name: name of the session's result to check; None for the one in calibration/.
        profile: profile that the result was made with (`profile_behind`); its intrinsics are used.
        detections: detections of this session; None to detect the board first.
        progress: called with (done, total) while the board is detected.

    Raises:
        SessionError: the result is missing or belongs to another rig, or the session has no captures of its
            sensors.
    """
    calibrations, own_result = _extrinsics(session, result, name)
    own = session if result is not None else with_profile_of(session, name)
    if own is not session:
        session, detections = own, None
    rig, notes = with_lenses_of(session.rig, profile)
    if rig is not session.rig:
        session, detections = Session(session.path, rig, None), None
    detections = detections or detect_boards(session, progress=progress)
    checks = []
    for c in calibrations:
        scene = SceneOpinion(0, 0) if c.is_of_peers else hear_scene(session, detections, c)
        for channel in sorted(c.channels) or [""]:
            pair = replace(Pair.of(c), channel=channel)
            if detections.captures(pair):
                check = check_session(session.rig, detections, c, channel, scene)
                # A result of this session has been judged by these boards.
                if not c.captures_used and not c.is_of_peers:
                    # Test all six axes jointly: a translation can compensate a rotation in the residuals.
                    key = (pair.camera, pair.channel)
                    alone = Detections(
                        {key: detections.images[key]}, {pair.lidar: detections.lidars[pair.lidar]}
                    )
                    watched = watch_boards(session.rig, c, channel, alone)
                    if watched is not None and watched.state == "changed":
                        check = replace(check, findings=(watched.findings[0], *check.findings))
                checks.append(check)
    if all(check.metrics is None for check in checks) and any(not c.is_with_board for c in calibrations):
        raise SessionError(
            f"{session.path}: the result was made without a board, and no capture shows one",
            "Check it on another drive: `lce-rig drift --result FILE RECORDING`.",
        )
    if not checks:
        wanted = ", ".join(str(Pair.of(c)) for c in calibrations)
        raise SessionError(f"{session.path} holds no captures of {wanted}", "Check the result's session.")
    return Verification(session, tuple(checks), tuple(calibrations), detections, own_result, name, notes)


def profile_behind(path: Path, result: ResultFile) -> Rig | None:
    """Read the profile with which a result was made: that of the session around result.json.

    Returns:
        None if it is missing, or is not the one that the result names.
    """
    digests = result.inputs_sha256.values()
    # As deep as results/NAME/previous/result.json lies in its session.
    for folder in path.resolve().parents[:4]:
        # Earlier profiles of a session stay in it as rig-1.yaml, rig-2.yaml, ...
        for profile in (folder / PROFILE, *sorted(folder.glob("rig-*.yaml"))):
            if profile.is_file() and sha256(profile.read_bytes()).hexdigest() in digests:
                return load_rig(profile)
    return None


def with_lenses_of(rig: Rig, profile: Rig | None) -> tuple[Rig, tuple[Finding, ...]]:
    """Apply the lenses of a result to a rig, and name relevant keys that differ.

    Another lens moves boards and edges, and would look like a sensor that moved.

    Args:
        rig: profile of the sensors that recorded the samples.
        profile: profile of the result; None if unknown.
    """
    if profile is None:
        return rig, ()
    cameras, keys = dict(rig.cameras), differing_keys(profile, rig)
    changed = [key.name for key in keys if key.path[0] == "board" or key.is_of_lens_or_model]
    if profile.nominal_extrinsics != rig.nominal_extrinsics:
        changed.append("nominal_extrinsics")
    for name in cameras.keys() & profile.cameras.keys():
        if profile.cameras[name].resolution_px == cameras[name].resolution_px:
            lens = profile.cameras[name].intrinsics
            cameras[name] = cameras[name].model_copy(update={"intrinsics": lens})
    if not changed:
        return rig, ()
    return rig.model_copy(update={"cameras": cameras}), (OTHER_PROFILE(keys=", ".join(changed)),)


def _extrinsics(
    session: Session, result: Result | ResultFile | None, name: str | None
) -> tuple[Sequence[Calibration], bytes | None]:
    """Return the extrinsics to check, and the content of the session's result.json if it holds them."""
    folder = result_folder(session.path, name)
    content = result_content(folder)
    if result is None and content is None and name is not None:
        names = ", ".join(each.name for each in stored_results(session)) or "none"
        raise SessionError(f"{session.path} has no result {name!r}", f"Its results: {names}.")
    if isinstance(result, Result):
        saved, is_own = result.file(), result.session.path.resolve() == session.path.resolve()
        is_stored = is_own and saved.text().encode() == content
    else:
        saved = result or read_result(folder / RESULT)
        is_own = is_stored = result is None
    calibrations = saved.pairs
    if saved.rig != session.rig.name or not calibrations:
        what = f"the result belongs to rig {saved.rig!r}" if calibrations else "the result holds no pair"
        raise SessionError(f"{what}; the session {session.path} belongs to rig {session.rig.name!r}")
    if not is_own:
        # Capture names differ between sessions: none of these was fitted.
        calibrations = tuple(replace(c, captures_used=(), captures_refused={}) for c in calibrations)
    return calibrations, content if is_stored else None


def write_debug_images(
    session: Session,
    detections: Detections,
    *,
    progress: Progress = silent,
) -> Path:
    """Draw for every capture each sensor's detection of the board, or the refusal.

    Args:
        session: the source of the captures.
        detections: detections of the session.
        progress: called with (done, total).

    Returns:
        The folder of the images, debug/ of the session.
    """
    from lce_rig.show.overlays.canvas import write_picture
    from lce_rig.show.overlays.debug_image import draw_debug

    base = session.path / DEBUG
    jobs = [(pair, name) for pair in detections.pairs for name in detections.captures(pair)]
    matches = {pair: match_sensors(session.rig, detections, pair) for pair in detections.pairs}
    for done, (pair, name) in enumerate(jobs, start=1):
        refused, chosen = matches[pair]
        mismatch = refused.get(name)
        capture, (image, lidar) = session.capture(name), detections.of(pair, name)
        seen, scan, events = _image(session, pair.camera, pair.channel, capture), None, None
        with suppress(SessionError):  # The detection reports damaged captures.
            scan = session.scan(capture, pair.lidar)
            if (pair.camera, pair.channel) in event_channels(session.rig, capture):
                events = capture.events(pair.camera)
        candidates = lidar if isinstance(lidar, list) else []
        index = next((k for k, each in enumerate(candidates) if each is chosen.get(name)), 0)
        picture = draw_debug(
            seen,
            scan,
            image,
            lidar,
            board=session.rig.board.to_board(),
            intrinsics=session.rig.cameras[pair.camera].to_intrinsics(),
            title=f"{pair}  {name}",
            chosen=index,
            mismatch=mismatch if mismatch is not None and mismatch.stage == "pair" else None,
            events=events,
        )
        place = base if len(detections.pairs) == 1 else base / pair.folder_name
        write_picture(place / f"{name}.png", picture)
        progress(done, len(jobs))
    return base


def _scan(session: Session, pair: Pair, capture: Capture) -> Scan:
    """Return a LiDAR's point cloud; for two cameras an empty one, as the second one's corners are drawn."""
    if not pair.lidar_channel:
        return session.scan(capture, pair.lidar)
    none = np.zeros(0)
    return Scan(
        pair.lidar, None, np.zeros((0, 3), np.float32), none.astype(np.float32), none.astype(np.int16)
    )


def _image(
    session: Session, camera: str, channel: str, capture: Capture, *, T_view: Array | None = None
) -> Image | None:
    """Return a camera's image, or a LiDAR's point cloud as one; None if damaged or not reconstructed."""
    with suppress(SessionError):
        if T_view is not None:
            return draw_cloud(session.scan(capture, camera), T_view)
        if (camera, channel) not in event_channels(session.rig, capture):
            return capture.image(camera, channel)
        picture = event_picture(session, capture, camera, channel)
        return None if isinstance(picture, Refusal) else picture
    return None
