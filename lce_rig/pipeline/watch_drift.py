"""Check deployed extrinsics on recordings without a board, by the edges of the scene.

Captures come from sessions, recordings of all kinds and attached sensors, in bounded memory.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from lce_rig.collect.live.frame_feed import FrameFeed
from lce_rig.core.calibration import ResultFile, read_result
from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import SessionError, SourceError
from lce_rig.core.findings import Losses
from lce_rig.core.progress import Progress, silent
from lce_rig.devices import edge_cameras
from lce_rig.devices.reading import AttachedSensors, LiveSource
from lce_rig.devices.sync_board import SyncBoard
from lce_rig.io import open_recordings
from lce_rig.io.folder import FolderRecording, read_pairs
from lce_rig.io.recording import ContinuousRecording, join_recordings, read_samples, require_sensors
from lce_rig.pipeline.pair_drift import DriftReport, PairJudge, Seen, own_offset_ns
from lce_rig.pipeline.result_files import RESULT, result_folder
from lce_rig.pipeline.scene_samples import Thinned, image_or_events, read_events
from lce_rig.pipeline.verification import with_lenses_of
from lce_rig.rig import Rig
from lce_rig.scene.views import MAX_CAPTURES, evenly
from lce_rig.session import Session
from lce_rig.timing.rig_clock import RigClock
from lce_rig.timing.scan_pairing import EventCut, Frame, event_channel, pair_by_time


class SceneCaptures:
    """Captures from all kinds of sources, for every camera and LiDAR of a result.

    Memory does not grow with a recording's length: of each camera and LiDAR, 60 captures are kept.

    Args:
        rig: the profile.
        result: the deployed extrinsics.
        source: the source's name in messages.

    Attributes:
        kept: by index of the result's pairs.
        notes: choices, assumptions and unreadable files, in words.

    Raises:
        SessionError: the result belongs to another rig.
    """

    def __init__(self, rig: Rig, result: ResultFile, source: str) -> None:
        if result.rig != rig.name or not result.pairs:
            what = f"the result belongs to rig {result.rig!r}" if result.pairs else "the result holds no pair"
            raise SessionError(f"{what}; {source} belongs to rig {rig.name!r}")
        of_cameras = tuple(c for c in result.pairs if not c.is_of_peers)
        if not of_cameras:
            raise SessionError(
                "the result is of LiDARs alone",
                "Compare two sessions: `lce-rig verify SESSION --result FILE`.",
            )
        for c in of_cameras:
            if c.camera not in rig.cameras or c.lidar not in rig.lidars:
                raise SessionError(f"the result names {c.camera} and {c.lidar}, which rig {rig.name!r} lacks")
        self._rig, self._source = rig, source
        self._pairs = of_cameras
        self.kept: list[Thinned[Seen]] = [Thinned(MAX_CAPTURES) for _ in of_cameras]
        self.notes: list[str] = []
        self._last: dict[str, Scan] = {}

    def take_session(self, session: Session, progress: Progress) -> None:
        """Read the captures of a session; skip damaged ones."""
        cameras, lidars = {c.camera for c in self._pairs}, {c.lidar for c in self._pairs}
        captures = evenly(session.captures, MAX_CAPTURES * len(self._pairs))
        for done, capture in enumerate(captures, start=1):
            progress(done, len(captures))
            with suppress(SessionError):  # A damaged one is skipped.
                images = [capture.image(*key) for key in capture.image_keys if key[0] in cameras]
                scans = [capture.scan(lidar) for lidar in capture.lidars if lidar in lidars]
                self._take(capture.name, images, scans, read_events(capture, self._rig))

    def take_recordings(self, paths: Sequence[Path], progress: Progress) -> None:
        """Read recordings: pairs of images and point clouds, or streams, whose scans are paired by time.

        Raises:
            SourceError: one cannot be read at all.
        """
        for recording in join_recordings(open_recordings(paths, self._rig), self._rig):
            try:
                if isinstance(recording, FolderRecording):
                    self._take_pairs(recording, progress)
                elif isinstance(recording, ContinuousRecording):
                    self._take_stream(recording, progress)
            except SourceError as error:
                if not any(self.kept):
                    raise
                # Samples before the damage are judged.
                self.notes.append(f"not read to its end: {error.what}")
            self.notes += recording.notes

    def _take_pairs(self, recording: FolderRecording, progress: Progress) -> None:
        pairs = evenly(recording.pairs, MAX_CAPTURES * len(self._pairs))
        for label, images, scans in read_pairs(pairs, self.notes, progress):
            self._take(label, images, scans)

    def _take_stream(self, recording: ContinuousRecording, progress: Progress) -> None:
        require_sensors(recording, self._rig)
        losses = Losses()
        samples = read_samples(recording, self._rig, progress)
        for frame in pair_by_time(samples, self._rig, losses, are_events_enough=True):
            self.take_frame(frame)
        if not any(self.kept) and losses.counts():
            (why, n), *_ = losses.counts()
            raise SourceError(f"{recording.path}: {n} scans cannot be used: {why.text}")

    def take_live(self, sources: Sequence[LiveSource], is_over: Callable[[int], bool]) -> None:
        """Read attached sensors until the time is over.

        Raises:
            SourceError: a sensor cannot be opened.
        """
        board = next((source for source in sources if isinstance(source, SyncBoard)), None)
        clock = RigClock(self._rig, has_board=board is not None, edge_cameras=edge_cameras(self._rig))
        n_frames = 0
        with (
            AttachedSensors(sources) as sensors,
            FrameFeed(self._rig, sensors, clock, board, are_events_enough=True) as feed,
        ):
            while not is_over(n_frames):
                frame = feed.take()
                if frame is not None:
                    n_frames += 1
                    self.take_frame(frame)
            self.notes += [error.what for error, _ in sensors.lost().values()]

    def take_frame(self, frame: Frame) -> None:
        """Take the rig's samples at one time of a continuous recording."""
        self._take(f"{1e-9 * frame.time_ns:.2f} s", frame.images, frame.scans, frame.events)
        self._last = {scan.sensor: self._rig.corrected(scan) for scan in frame.scans}

    def _take(
        self, name: str, images: Sequence[Image], scans: Sequence[Scan], events: Sequence[EventCut] = ()
    ) -> None:
        for c, kept in zip(self._pairs, self.kept, strict=True):
            scan = next((each for each in scans if each.sensor == c.lidar), None)
            if scan is None:
                continue
            scan = self._rig.corrected(scan)
            late_ns = own_offset_ns(c, event_channel(self._rig, c.camera) or "")
            image = image_or_events(
                self._rig, c.camera, images, events, scan, self._rig.lens_of(c), c.T_cam_lidar, late_ns
            )
            if isinstance(image, Image):
                # Grey: colour is not used, and would hold three times the memory.
                image = replace(image, pixels=image.grey)
            if image is not None:
                kept.take(Seen(name, image, scan, self._last.get(c.lidar)))

    def judge(self) -> DriftReport:
        """Judge the result by the samples taken.

        Raises:
            SourceError: nothing of any camera and LiDAR of the result.
        """
        if not any(self.kept):
            wanted = " or ".join(f"{c.camera} and {c.lidar}" for c in self._pairs)
            raise SourceError(
                f"{self._source} holds no images and scans of {wanted} at the same time",
                "Check the profile's topics and timestamps; "
                "`lce-rig doctor --rig RIG` looks at attached sensors.",
            )
        pairs = tuple(map(PairJudge(self._rig).pair, self._pairs, self.kept))
        return DriftReport(self._rig, pairs, tuple(dict.fromkeys(self.notes)))


def drift(
    source: Path | str | Sequence[Path | str],
    result: ResultFile | None = None,
    *,
    rig: Rig | None = None,
    profile: Rig | None = None,
    progress: Progress = silent,
) -> DriftReport:
    """Compare the extrinsics of a result with the scene of a session or of recordings.

    Memory does not grow with the length of a recording: of each camera and LiDAR, 60 captures are kept.

    Args:
        source: a session; or with `rig` a folder of images and point clouds, a bag, or several recordings of
            the same time, such as a pcap and a camera's file.
        result: the deployed extrinsics; None for the session's own result.
        rig: the profile of a recording; a session has its own.
        profile: with which the result was made, as `profile_behind` finds it: its lenses count.
        progress: called with (done, total) captures, or images and scans.

    Raises:
        SessionError: the result is missing or belongs to another rig, or the session cannot be read.
        SourceError: a recording cannot be read, or holds nothing of any camera and LiDAR of the result.
    """
    paths = [Path(each) for each in ([source] if isinstance(source, str | Path) else source)]
    if rig is not None:
        place = " and ".join(map(str, paths))
        if result is None:
            raise SessionError(f"{place}: a recording has no result", "Name one with --result FILE.")
        rig, notes = with_lenses_of(rig, profile)
        captures = SceneCaptures(rig, result, place)
        captures.take_recordings(paths, progress)
    elif len(paths) != 1:
        raise SessionError("several recordings need the profile of their rig", "Name one with --rig.")
    else:
        session = Session.open(paths[0])
        result = result or read_result(result_folder(session.path) / RESULT)
        rig, notes = with_lenses_of(session.rig, profile)
        captures = SceneCaptures(rig, result, str(session.path))
        captures.take_session(session, progress)
    report = captures.judge()
    return replace(report, notes=(*(note.sentence for note in notes), *report.notes))


def drift_live(
    rig: Rig,
    result: ResultFile,
    sources: Sequence[LiveSource],
    *,
    is_over: Callable[[int], bool],
) -> DriftReport:
    """Compare the extrinsics of a result with samples of attached sensors.

    Args:
        rig: the profile.
        result: the deployed extrinsics.
        sources: live sources of every sensor and of the sync board; not open yet.
        is_over: asked several times a second with the number of scans so far; True ends it.

    Raises:
        SessionError: the result belongs to another rig.
        SourceError: a sensor cannot be opened, or nothing came of any camera and LiDAR of the result.
    """
    captures = SceneCaptures(rig, result, f"the sensors of rig {rig.name}")
    captures.take_live(sources, is_over)
    return captures.judge()
