"""Compare the deployed extrinsics of a camera and a LiDAR with a scene and the boards in view."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from lce_rig.core.calibration import Calibration, State
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import SURPRISING_CHI2, PoseDifference
from lce_rig.core.results import ImageBoard
from lce_rig.detect.detection import Detections, LidarDetection
from lce_rig.detect.finder import BoardFinder
from lce_rig.judge.board_drift import BoardDrift, watch_boards
from lce_rig.judge.scene_drift import SceneDrift, watch_scene
from lce_rig.pipeline.scene_samples import at_image, channel_of, moving, picture_of
from lce_rig.rig import Rig
from lce_rig.scene.findings import (
    CLOCKS_APART,
    CLOCKS_INSTEAD,
    CONTRADICTION,
    EVENTS_OF_STANDING_RIG,
    NO_FIRING_TIMES,
    NO_SAMPLES,
)
from lce_rig.scene.outline_score import OutlineView
from lce_rig.scene.rig_motion import MovingView, RigMotion, clocks_apart_s
from lce_rig.scene.views import build_view, evenly, without_board, without_movers
from lce_rig.show.overlays.canvas import write_picture
from lce_rig.show.overlays.overlay import draw_edges

_ORDER: tuple[State, ...] = ("changed", "unchanged", "unknown")
_MIN_MOVING = 3
_MAX_BOARDS = 20


class Seen(NamedTuple):
    """One capture of one camera and LiDAR.

    Attributes:
        name: name of the capture, or its time.
        image: image of the camera; without one, 20 ms of events.
        scan: scan of the LiDAR.
        previous: the scan before, in a continuous recording.
    """

    name: str
    image: Image | Events
    scan: Scan
    previous: Scan | None


@dataclass(frozen=True, eq=False)
class PairDrift:
    """One camera and LiDAR compared with a scene.

    Attributes:
        calibration: the deployed extrinsics.
        drift: the scene's opinion; where images show the board, without its edges.
        board: the board's opinion; None with fewer than three placements that both sensors see.
        example: the capture drawn by `write`; None without any.
    """

    calibration: Calibration
    drift: SceneDrift
    board: BoardDrift | None
    example: tuple[str, Image, OutlineView] | None

    @property
    def state(self) -> State:
        """The verdict: a change found by one test and not refuted by the other.

        It holds if either opinion covers it, and is unknown if they contradict each other.
        """
        states: list[State] = [self.drift.state, *([] if self.board is None else [self.board.state])]
        if self.contradictions:
            return "unknown"
        return next((state for state in _ORDER if state in states), "unknown")

    @property
    def contradictions(self) -> list[Finding]:
        """The finding that the boards exclude the scene's change, if they do."""
        if self.board is None or (self.drift.state, self.board.state) != ("changed", "unchanged"):
            return []
        scene, board = self.drift.change, self.board
        apart = PoseDifference(scene.tangent - board.tangent, scene.cov + board.cov)
        return [CONTRADICTION(**apart.sizes)] if apart.chi2 > SURPRISING_CHI2 else []

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Contradictions, then the result of the scene, then that of the board."""
        board = () if self.board is None else self.board.findings
        return (*self.contradictions, *self.drift.findings, *board)

    @property
    def advice(self) -> str:
        """The action of the first finding that decides the verdict; of notes, where nothing else has one."""
        if self.state == "unchanged":
            return ""
        ranked = sorted(self.findings, key=lambda each: each.severity == "note")
        return next((each.advice for each in ranked if each.advice), "")

    def document(self) -> dict[str, Any]:
        """Return all figures as plain types for JSON."""
        is_changed = self.drift.state == "changed"
        return {
            "camera": self.calibration.camera,
            "lidar": self.calibration.lidar,
            "state": self.state,
            "T_cam_lidar": self.drift.T_cam_lidar.tolist(),
            "T_changed": self.drift.T_changed.tolist() if is_changed else None,
            "scene": self.drift.document(),
            "board": None if self.board is None else self.board.document(),
            "findings": [finding.as_json() for finding in self.findings],
        }


@dataclass(frozen=True, eq=False)
class DriftReport:
    """The extrinsics of a result compared with a scene.

    Attributes:
        rig: the profile.
        pairs: one for each camera and LiDAR of the result.
        notes: choices, assumptions and unreadable files, in words.
    """

    rig: Rig
    pairs: tuple[PairDrift, ...]
    notes: tuple[str, ...] = ()

    def write(self, folder: Path | str) -> list[Path]:
        """Draw for each pair the edges of one capture under the deployed extrinsics and those that changed.

        Raises:
            SessionError: a file cannot be written.
        """
        files = []
        for pair in self.pairs:
            if pair.example is None:
                continue
            name, image, view = pair.example
            c, poses = pair.calibration, {"deployed": pair.drift.T_cam_lidar}
            if pair.drift.state == "changed":
                poses["changed"] = pair.drift.T_changed
            title = f"{c.camera}, {c.lidar}  {name}"
            picture = draw_edges(image, view.outlines, self.rig.lens_of(c), poses, title)
            files.append(write_picture(Path(folder) / f"drift_{c.camera}_{c.lidar}.png", picture))
        return files


class PairJudge:
    """Judges cameras and LiDARs in turn; the motion of a LiDAR is estimated once for all cameras."""

    def __init__(self, rig: Rig) -> None:
        self._rig, self._finder = rig, BoardFinder(rig)
        self._motions: dict[int, RigMotion | None] = {}

    def pair(self, c: Calibration, kept: Sequence[Seen]) -> PairDrift:
        """Judge deployed extrinsics by captures of a scene."""
        lens = self._rig.lens_of(c)
        views: list[OutlineView] = []
        whole: list[OutlineView] = []
        boards: list[tuple[Seen, ImageBoard]] = []
        in_motion: list[MovingView] = []
        n_untimed = 0
        for seen in kept:
            view = build_view(self._rig, c, seen.name, seen.image, seen.scan)
            motion = self._motion(seen)
            if motion is not None:
                late_ns = own_offset_ns(c, channel_of(seen.image, self._rig))
                moved = at_image(view, motion, seen.scan, seen.image, self._rig, late_ns)
                if moved is None:
                    n_untimed += 1
                    continue
                view = moved
                in_motion.append(MovingView(view, motion))
            whole.append(view)
            if isinstance(seen.image, Image):
                board = self._finder.image(seen.image)
                view = without_board(view, board, self._rig, c)
                if motion is None and isinstance(board, ImageBoard):
                    boards.append((seen, board))
            views.append(view)
        if boards:
            # The person moves with the board.
            views = without_movers(views)
        judged = watch_scene(views, lens, c)
        others: list[Finding] = []
        if len(in_motion) >= _MIN_MOVING and judged.estimate.state != "few_edges":
            others += _clocks(judged, in_motion, lens, c.camera)
        if not kept:
            others.append(NO_SAMPLES(c.camera, lidar=c.lidar))
        elif n_untimed:
            others.append(NO_FIRING_TIMES(c.lidar, n_captures=n_untimed))
        if (
            judged.state == "unknown"
            and not in_motion
            and any(isinstance(each.image, Events) for each in kept)
        ):
            others.append(EVENTS_OF_STANDING_RIG(c.camera))
        judged = replace(judged, others=tuple(others))
        example = None
        if whole:
            # Draw the capture with most edges.
            view = max(whole, key=lambda each: len(each.outlines))
            image = next(seen.image for seen in kept if seen.name == view.capture)
            example = view.capture, picture_of(image), view
        return PairDrift(c, judged, self._boards(c, boards), example)

    def _boards(self, c: Calibration, boards: Sequence[tuple[Seen, ImageBoard]]) -> BoardDrift | None:
        """Compare the extrinsics with the boards of at most 20 captures."""
        kept = evenly(boards, _MAX_BOARDS)
        if not kept:
            return None
        images = {seen.name: board for seen, board in kept}
        scans: dict[str, LidarDetection] = {seen.name: self._finder.scan(seen.scan) for seen, _ in kept}
        channel = boards[0][0].image.channel if isinstance(boards[0][0].image, Image) else ""
        return watch_boards(
            self._rig, c, channel, Detections({(c.camera, channel): images}, {c.lidar: scans})
        )

    def _motion(self, seen: Seen) -> RigMotion | None:
        """Estimate the rig's motion at a capture; None if it stands still or cannot be estimated."""
        key = id(seen.scan)
        if key not in self._motions:
            self._motions[key] = moving(seen.previous, seen.scan)
        return self._motions[key]


def _clocks(judged: SceneDrift, views: Sequence[MovingView], lens: Intrinsics, camera: str) -> list[Finding]:
    """Check whether the images of a moving rig fit scans of another time as well as a change."""
    is_changed = judged.state == "changed"
    apart_s = clocks_apart_s(views, lens, judged.T_cam_lidar, judged.T_changed if is_changed else None)
    if apart_s is None:
        return []
    return [(CLOCKS_INSTEAD if is_changed else CLOCKS_APART)(camera, apart_s=apart_s)]


def own_offset_ns(c: Calibration, channel: str) -> int:
    """Return a channel's calibrated time offset minus the profile's expected one."""
    found = [each.time_offset_s for each in c.channel_results if each.channel == channel]
    return round(1e9 * found[0]) if found and found[0] is not None else 0
