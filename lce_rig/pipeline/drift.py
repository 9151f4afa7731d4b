"""Check deployed extrinsics on recordings without a board: the edges of the scene decide."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from lce_rig.collect.live.frame_feed import FrameFeed, SyncTimes
from lce_rig.core.data import Events, Image, Sample, Scan
from lce_rig.core.errors import SessionError, SourceError
from lce_rig.core.findings import Finding
from lce_rig.core.losses import Losses
from lce_rig.core.results import Calibration
from lce_rig.detect.finder import BoardFinder
from lce_rig.devices.opening import edge_cameras
from lce_rig.devices.reading import AttachedSensors, LiveSource
from lce_rig.export.result import SavedResult, read_result
from lce_rig.pipeline.detect_session import Progress, silent
from lce_rig.pipeline.result_files import RESULT, result_parts
from lce_rig.recordings import open_recordings
from lce_rig.recordings.joining import join_recordings, require_sensors
from lce_rig.recordings.protocol import ContinuousRecording, PairedRecording
from lce_rig.rig import Rig
from lce_rig.scene.alignment import SceneView
from lce_rig.scene.drift import AxisDrift, Drift, watch
from lce_rig.scene.views import build_view, without_board, without_movers
from lce_rig.session import Capture, Session
from lce_rig.timing.event_buffer import EventCut
from lce_rig.timing.rig_clock import RigClock
from lce_rig.timing.scan_pairing import Frame, pair_by_time
from lce_rig.verify.drift_picture import draw_drift
from lce_rig.verify.overlay_files import write_picture
from lce_rig.words import as_json, describe

MAX_CAPTURES = 60
"""More captures add time and memory but, of one place, no information: they are thinned out evenly."""
_LIVE_WAIT_S = 0.2


@dataclass(frozen=True, eq=False)
class PairDrift:
    """What a scene says about one camera and LiDAR.

    Attributes:
        calibration: the deployed extrinsics.
        drift: the verdict.
        example: the capture drawn by `write`; None without any.
    """

    calibration: Calibration
    drift: Drift
    example: tuple[str, Image, SceneView] | None

    def document(self) -> dict[str, Any]:
        """List everything as plain types for JSON."""
        return {
            "camera": self.calibration.camera,
            "lidar": self.calibration.lidar,
            "state": self.drift.state,
            "n_captures": self.drift.n_captures,
            "n_edges": self.drift.n_edges,
            "axes": [_axis(axis) for axis in self.drift.axes],
            "T_cam_lidar": self.drift.T_cam_lidar.tolist(),
            "T_cam_lidar_best": self.drift.T_best.tolist(),
            "covariance_best": None if self.drift.cov_best is None else self.drift.cov_best.tolist(),
            "findings": [as_json(finding) for finding in self.drift.findings],
        }


def _axis(axis: AxisDrift) -> dict[str, Any]:
    unit = "deg" if axis.is_rotation else "m"
    figures = {"change": axis.change, "sigma": axis.sigma, "smallest": axis.smallest}
    finite = {f"{name}_{unit}": value if np.isfinite(value) else None for name, value in figures.items()}
    return {"axis": axis.axis, "state": axis.state, **finite, "instead": list(axis.instead)}


@dataclass(frozen=True, eq=False)
class DriftReport:
    """What a scene says about the extrinsics of a result.

    Attributes:
        rig: the profile.
        pairs: one for each camera and LiDAR of the result.
        notes: what was chosen, assumed or could not be read, in words.
    """

    rig: Rig
    pairs: tuple[PairDrift, ...]
    notes: tuple[str, ...] = ()

    def write(self, folder: Path | str) -> list[Path]:
        """Draw each pair: edges under the deployed and the best extrinsics, and the score along each axis.

        Raises:
            SessionError: a file cannot be written.
        """
        files = []
        for pair in self.pairs:
            if pair.example is None:
                continue
            name, image, view = pair.example
            c = pair.calibration
            lens = self.rig.cameras[c.camera].to_intrinsics()
            picture = draw_drift(pair.drift, image, view.edges, lens, f"{c.camera}, {c.lidar}  {name}")
            files.append(write_picture(Path(folder) / f"drift_{c.camera}_{c.lidar}.png", picture))
        return files


def drift(
    source: Path | str | Sequence[Path | str],
    result: SavedResult | None = None,
    *,
    rig: Rig | None = None,
    ignore_board: bool = False,
    progress: Progress = silent,
) -> DriftReport:
    """Compare the extrinsics of a result with the scene of a session or of recordings.

    Memory does not grow with the length of a recording: of each camera and LiDAR, 60 captures are kept.

    Args:
        source: a session; or with `rig` a folder of images and point clouds, a bag, or several recordings of
            the same time, such as a pcap and the images' folder.
        result: the deployed extrinsics; None for the session's own result.
        rig: the profile of a recording; a session has its own.
        ignore_board: leave out the edges at the board, where an image shows one, and what moves before a
            standing rig.
        progress: called with (done, total) captures, or images and scans.

    Raises:
        SessionError: there is no result, it belongs to another rig, or the session cannot be read.
        SourceError: a recording cannot be read, or holds nothing of any camera and LiDAR of the result.
    """
    paths = [Path(each) for each in ([source] if isinstance(source, str | Path) else source)]
    if rig is not None:
        place = " and ".join(map(str, paths))
        if result is None:
            raise SessionError(f"{place}: a recording has no result", "Name one with --result FILE.")
        watcher = _Watcher(rig, result, place, ignore_board)
        watcher.take_recordings(paths, progress)
    elif len(paths) != 1:
        raise SessionError("several recordings need the profile of their rig", "Name one with --rig.")
    else:
        session = Session.open(paths[0])
        result = result or read_result(session.path.joinpath(*result_parts(None), RESULT))
        watcher = _Watcher(session.rig, result, str(session.path), ignore_board)
        watcher.take_session(session, progress)
    return watcher.finish()


def drift_live(
    rig: Rig,
    result: SavedResult,
    sources: Sequence[LiveSource],
    *,
    ignore_board: bool = False,
    is_over: Callable[[int], bool],
) -> DriftReport:
    """Compare the extrinsics of a result with what attached sensors see.

    Args:
        rig: the profile.
        result: the deployed extrinsics.
        sources: of every sensor and of the sync board; not open yet.
        ignore_board: as for `drift`.
        is_over: asked several times a second with the number of scans so far; True ends it.

    Raises:
        SessionError: the result belongs to another rig.
        SourceError: a sensor cannot be opened, or nothing came of any camera and LiDAR of the result.
    """
    watcher = _Watcher(rig, result, f"the sensors of rig {rig.name}", ignore_board)
    watcher.take_live(sources, is_over)
    return watcher.finish()


@dataclass(frozen=True, eq=False)
class _Seen:
    """One capture of one camera and LiDAR: an image, or else events about the scan."""

    name: str
    image: Image | None
    events: EventCut | None
    scan: Scan


_Item = TypeVar("_Item")


class _Thinned(list[_Item]):
    """The items of a stream, every one at first, every second once there are too many, and so on."""

    def __init__(self) -> None:
        super().__init__()
        self._n_taken, self._stride = 0, 1

    def take(self, item: _Item) -> None:
        """Keep an item if it is its turn."""
        if self._n_taken % self._stride == 0:
            self.append(item)
        self._n_taken += 1
        if len(self) > MAX_CAPTURES:
            self[:] = self[::2]
            self._stride *= 2


class _Watcher:
    """Takes captures of all kinds of sources for every camera and LiDAR of a result.

    Raises:
        SessionError: the result belongs to another rig.
    """

    def __init__(self, rig: Rig, result: SavedResult, source: str, ignore_board: bool) -> None:
        if result.rig != rig.name or not result.pairs:
            what = f"the result belongs to rig {result.rig!r}" if result.pairs else "the result holds no pair"
            raise SessionError(f"{what}; {source} belongs to rig {rig.name!r}")
        for c in result.pairs:
            if c.camera not in rig.cameras or c.lidar not in rig.lidars:
                raise SessionError(f"the result names {c.camera} and {c.lidar}, which rig {rig.name!r} lacks")
        self._rig, self._source, self._ignore_board = rig, source, ignore_board
        self._pairs = result.pairs
        self._kept: list[_Thinned[_Seen]] = [_Thinned() for _ in result.pairs]
        self._notes: list[str] = []

    def take_session(self, session: Session, progress: Progress) -> None:
        """Read the captures of a session; what is damaged is skipped."""
        captures = _evenly(session.captures, MAX_CAPTURES * len(self._pairs))
        for done, capture in enumerate(captures, start=1):
            with suppress(SessionError):
                self._take_capture(capture)
            progress(done, len(captures))

    def _take_capture(self, capture: Capture) -> None:
        cameras, lidars = {c.camera for c in self._pairs}, {c.lidar for c in self._pairs}
        images: list[Image] = []
        scans: list[Scan] = []
        events: list[Events] = []
        # A damaged file costs its own sensor only.
        for key in capture.image_keys:
            if key[0] in cameras:
                with suppress(SessionError):
                    images.append(capture.image(*key))
        for lidar in capture.lidars:
            if lidar in lidars:
                with suppress(SessionError):
                    scans.append(capture.scan(lidar))
        for camera in capture.event_cameras:
            if camera in cameras:
                with suppress(SessionError):
                    events.append(capture.events(camera))
        self._take(capture.name, images, scans, [_whole(each) for each in events if len(each)])

    def take_recordings(self, paths: Sequence[Path], progress: Progress) -> None:
        """Read recordings: pairs of images and point clouds, or streams, whose scans are paired by time.

        Raises:
            SourceError: one cannot be read at all.
        """
        for recording in join_recordings(open_recordings(paths, self._rig), self._rig):
            try:
                if isinstance(recording, PairedRecording):
                    self._take_pairs(recording, progress)
                elif isinstance(recording, ContinuousRecording):
                    self._take_stream(recording, progress)
            except SourceError as error:
                if not any(self._kept):
                    raise
                # What came before the damage is judged.
                self._notes.append(f"not read to its end: {error.what}")
            self._notes += recording.notes

    def _take_pairs(self, recording: PairedRecording, progress: Progress) -> None:
        pairs = _evenly(recording.pairs, MAX_CAPTURES * len(self._pairs))
        failures: list[SourceError] = []
        for done, files in enumerate(pairs, start=1):
            try:
                pair = files.read()
                self._take(pair.label, pair.images, pair.scans)
            except SourceError as error:
                failures.append(error)
            progress(done, len(pairs))
        if failures and len(failures) == len(pairs):
            raise failures[0]
        self._notes += [f"skipped: {error.what}" for error in failures]

    def _take_stream(self, recording: ContinuousRecording, progress: Progress) -> None:
        require_sensors(recording)
        losses = Losses()
        samples = _counted(recording.samples(), recording.n_samples, progress)
        for frame in pair_by_time(samples, self._rig, losses, are_events_enough=True):
            self._take_frame(frame)
        if not any(self._kept) and losses.counts():
            (why, n), *_ = losses.counts()
            raise SourceError(f"{recording.path}: {n} scans cannot be used: {describe(why)}")

    def take_live(self, sources: Sequence[LiveSource], is_over: Callable[[int], bool]) -> None:
        """Read attached sensors until it is over.

        Raises:
            SourceError: a sensor cannot be opened.
        """
        board = next((source for source in sources if isinstance(source, SyncTimes)), None)
        clock = RigClock(self._rig, has_board=board is not None, edge_cameras=edge_cameras(self._rig))
        n_frames = 0
        with (
            AttachedSensors(sources) as sensors,
            FrameFeed(self._rig, sensors, clock, board, are_events_enough=True) as feed,
        ):
            while not is_over(n_frames):
                frame = feed.take(_LIVE_WAIT_S)
                if frame is not None:
                    n_frames += 1
                    self._take_frame(frame)
            self._notes += [error.what for error, _ in sensors.lost().values()]

    def _take_frame(self, frame: Frame) -> None:
        self._take(f"{1e-9 * frame.time_ns:.2f} s", frame.images, frame.scans, frame.events)

    def _take(
        self, name: str, images: Sequence[Image], scans: Sequence[Scan], events: Sequence[EventCut] = ()
    ) -> None:
        for c, kept in zip(self._pairs, self._kept, strict=True):
            scan = next((each for each in scans if each.sensor == c.lidar), None)
            own = [image for image in images if image.sensor == c.camera]
            # Frames before images that were made of events.
            frames = self._rig.cameras[c.camera].first_channel("frames")
            own = [image for image in own if image.channel == frames] or own
            cut = next((each for each in events if each.sensor == c.camera), None)
            if scan is not None and (own or cut):
                # Grey: colour is not used, and would hold three times the memory.
                image = replace(own[0], pixels=own[0].grey) if own else None
                kept.take(_Seen(name, image, None if own else cut, scan))

    def finish(self) -> DriftReport:
        """Judge what was taken.

        Raises:
            SourceError: nothing of any camera and LiDAR of the result was taken.
        """
        if not any(self._kept):
            wanted = " or ".join(f"{c.camera} and {c.lidar}" for c in self._pairs)
            raise SourceError(
                f"{self._source} holds no images and scans of {wanted} at the same time",
                "Check the profile's topics and timestamps; `lce-rig doctor` looks at attached sensors.",
            )
        pairs = tuple(map(self._judge, self._pairs, self._kept))
        return DriftReport(self._rig, pairs, tuple(dict.fromkeys(self._notes)))

    def _judge(self, c: Calibration, kept: Sequence[_Seen]) -> PairDrift:
        lens = self._rig.cameras[c.camera].to_intrinsics()
        views: list[SceneView] = []
        example: tuple[str, Image, SceneView] | None = None
        for seen in kept:
            if seen.image is None:
                continue
            view = build_view(self._rig, c, seen.name, seen.image, seen.scan)
            if self._ignore_board:
                view = without_board(view, BoardFinder(self._rig).image(seen.image), self._rig, c)
            views.append(view)
            if example is None or len(view.edges) > len(example[2].edges):
                example = seen.name, seen.image, view
        if self._ignore_board:
            views = without_movers(views)
        judged = watch(views, lens, c.T_cam_lidar, c.cov)
        if not kept:
            lacking = Finding("scene.no_samples", "error", c.camera, {"lidar": c.lidar})
            judged = replace(judged, findings=(lacking,))
        return PairDrift(c, judged, example)


def _whole(events: Events) -> EventCut:
    """Give all events of a capture as a cut."""
    return EventCut(events, int(events.t_ns[0]), int(events.t_ns[-1]) + 1, 0, 0)


def _counted(samples: Iterable[Sample], n_samples: int, progress: Progress) -> Iterator[Sample]:
    done = 0
    for sample in samples:
        yield sample
        if not isinstance(sample, Events):
            done += 1
            progress(done, n_samples)


def _evenly(items: Sequence[_Item], n: int) -> list[_Item]:
    """Choose n of the items or fewer."""
    if len(items) <= n:
        return list(items)
    return [items[k] for k in np.linspace(0, len(items) - 1, n).round().astype(int)]
