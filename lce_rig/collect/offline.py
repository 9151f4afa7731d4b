"""Build a session from recordings, unattended: new placements become captures, refusals are counted."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from lce_rig.collect.board_search import sight_ahead
from lce_rig.collect.board_tracker import BoardDetection, BoardTracker, CaptureMoment
from lce_rig.collect.event_pictures import with_event_pictures
from lce_rig.collect.events_check import EventsCheck
from lce_rig.collect.findings import CALIBRATE_SAME_PLACEMENT
from lce_rig.collect.gates import MotionGate, StillnessGate, find_moments, stillness_window_s
from lce_rig.collect.placement_dedupe import (
    Placements,
    capture_poses,
    pose_figures,
)
from lce_rig.core.data import Events, Image, Sample, Scan
from lce_rig.core.errors import LceRigError, SessionError, SourceError, refusal_of
from lce_rig.core.findings import Losses, Refusal
from lce_rig.core.phrasing import as_line
from lce_rig.core.progress import Progress, silent
from lce_rig.detect.finder import check_origin
from lce_rig.io.beams import compare_beams
from lce_rig.io.folder import FolderRecording
from lce_rig.io.recording import (
    ContinuousRecording,
    Recording,
    check_overlap,
    join_recordings,
    require_sensors,
    serials_of,
)
from lce_rig.session import Session
from lce_rig.session.capture import SERIALS
from lce_rig.timing.scan_pairing import pair_by_time

# Interval between thorough searches of an image without a board, s; each takes most of a second.
_THOROUGH_S = 1.0
# Minimum number of samples that justify a separate process for images, which takes a second to start.
_LONG_SAMPLES = 200


@dataclass
class CollectReport:
    """Outcome of collecting from recordings.

    Attributes:
        captured: names of the new captures.
        n_known: pairs and moments already in the session, rejected captures included.
        refused: refusals of image-scan pairs, by label.
        counts: number of refusals of moments of continuous recordings, by cause.
        notes: choices, assumptions and skipped data, in words.
        errors: recordings that could not be read to their end; captures made before are kept.
        n_missing: captures short of the target.
        has_events: whether any recording held events, which require the board to move.
        longest_s: time from first to last scan of the longest continuous recording; 0 without any.
    """

    captured: list[str] = field(default_factory=list)
    n_known: int = 0
    refused: dict[str, Refusal] = field(default_factory=dict)
    counts: Losses = field(default_factory=Losses)
    notes: list[str] = field(default_factory=list)
    errors: list[SourceError] = field(default_factory=list)
    n_missing: int = 0
    has_events: bool = False
    longest_s: float = 0.0

    def note(self, notes: Iterable[str]) -> None:
        """Add notes, each once."""
        self.notes.extend(note for note in notes if note not in self.notes)


def collect(
    session: Session,
    recordings: Sequence[Recording],
    n_wanted: int | None = None,
    progress: Progress = silent,
) -> CollectReport:
    """Fill a session from recordings.

    A folder's pairs become captures unchanged. From a continuous recording, captures are taken while the
    board stands still in every sensor that sees it, at a placement that the session lacks. If it holds
    events, captures are taken at the best time at each place that the board passes slowly, with the raw
    events around it. Simultaneous recordings of several recorders are read as one. Captures of an earlier run
    are not repeated.

    Args:
        session: session, open for writing.
        recordings: recordings in any order.
        n_wanted: number of captures in the session at which to stop; None to read everything.
        progress: called with (done, total) samples or pairs.

    Raises:
        SourceError: no recording could be read; it names the first file and the cause.
        SessionError: the session cannot be written; captures made before are safe.
    """
    collector = _Collector(session, n_wanted, progress)
    for recording in join_recordings(recordings, session.rig):
        collector.report.note(recording.notes)
        try:
            if isinstance(recording, FolderRecording):
                collector.take_pairs(recording)
            elif isinstance(recording, ContinuousRecording):
                collector.take_moments(recording)
        except SourceError as error:
            collector.report.errors.append(error)
        finally:
            collector.report.note(recording.notes)
    return collector.finish()


class _Collector:
    def __init__(self, session: Session, n_wanted: int | None, progress: Progress) -> None:
        self.report = CollectReport()
        self._session = session
        self._n_wanted = n_wanted
        self._progress = progress
        self._rejected = {capture.name: capture for capture in session.rejected}
        # Captures, rejected ones included, by the key of their data.
        self._names_by_key: dict[str, str] = {}
        for capture in session.captures + session.rejected:
            with suppress(SessionError):  # A damaged capture is reported when it is used.
                source = capture.meta.get("source", {})
                if isinstance(source, dict) and isinstance(source.get("key"), str):
                    self._names_by_key[source["key"]] = capture.name
        self._n_captures = len(session.captures)
        self._torn: SourceError | None = None
        self._compared = set[str]()  # LiDARs whose beams were compared with their model's

    def take_pairs(self, recording: FolderRecording) -> None:
        """Capture every pair of a folder.

        Raises:
            SourceError: no pair could be read; the cause is that of the first.
        """
        failures: list[SourceError] = []
        n_left_out = 0
        for done, files in enumerate(recording.pairs):
            if self._is_enough():
                n_left_out += 1
                continue
            try:
                key = files.key()
                if key in self._names_by_key:
                    self.report.n_known += 1
                else:
                    images, scans, notes = files.read()
                    for scan in scans:
                        _require_own_frame(scan, files.label)
                        self._compare_beams(scan)
                    self.report.note(notes)
                    self._store(key, files.label, images, scans, {})
            except SourceError as error:
                failures.append(error)
                self.report.refused[files.label] = refusal_of("read", error, "record it again")
            self._progress(done + 1, len(recording.pairs))
        if n_left_out:
            self.report.note(
                [f"{n_left_out} pairs skipped: the session holds {self._n_captures} captures, as requested"]
            )
        if failures and len(failures) == len(recording.pairs):
            raise failures[0]

    def take_moments(self, recording: ContinuousRecording) -> None:
        """Capture the usable moments of a continuous recording.

        Raises:
            SourceError: it lacks a LiDAR or a camera, or their clocks do not overlap; or it is torn: moments
                before the damage have been captured.
        """
        require_sensors(recording, self._session.rig)
        known = Placements()
        # Skip placements whose capture of this recording was rejected.
        unwanted = {name for key, name in self._names_by_key.items() if key.startswith(f"{recording.key}:")}
        rejected = [capture for name, capture in self._rejected.items() if name in unwanted]
        for capture in [*self._session.captures, *rejected]:
            with suppress(LceRigError):  # A damaged capture is reported when it is used.
                known.add(capture.name, capture_poses(capture, self._session))
        # Reconstruct images for cameras without frames while the stream runs.
        with_images = {stream.sensor for stream in recording.streams if stream.kind == "images"}
        events = [stream for stream in recording.streams if stream.kind == "events"]
        reconstructed = {(s.sensor, s.channel) for s in events if s.sensor not in with_images}
        self.report.has_events |= bool(events)
        cameras = {camera for camera, _ in reconstructed}
        for moment in self._moments(recording, cameras, has_events=bool(events)):
            if self._is_enough():
                self.report.note(["stopped early: the session has the requested number of captures"])
                break
            # The capture keeps the events instead of the images reconstructed from them.
            images = moment.detection.frame.images
            stored = [image for image in images if (image.sensor, image.channel) not in reconstructed]
            self._take_moment(recording, moment, stored, known)
        if self._torn is not None:
            raise self._torn

    def _moments(
        self, recording: ContinuousRecording, cameras: set[str], *, has_events: bool
    ) -> Iterator[CaptureMoment]:
        """Yield confirmed moments: selected by motion in recordings with events, else by stillness.

        Args:
            recording: recording, read once.
            cameras: cameras with events and without images.
            has_events: whether events are kept with captures, so that the board has to move.
        """
        rig, losses = self._session.rig, self.report.counts
        samples = self._read(recording)
        if cameras:
            samples = with_event_pictures(samples, rig, cameras, losses)
        tracker = BoardTracker(rig, _THOROUGH_S, refusals=losses)
        # Scans without a reconstructed image are counted by `with_event_pictures`.
        check = EventsCheck(rig)
        frames = check.watch(pair_by_time(samples, rig, Losses() if cameras else losses))
        detections: Iterable[BoardDetection] = map(tracker.sight, frames)
        if recording.n_samples >= _LONG_SAMPLES and rig.cameras:
            detections = sight_ahead(tracker, frames)
        gate: StillnessGate | MotionGate = StillnessGate(
            rig.board.to_board(),
            rig.quality.max_motion_m,
            takes_singles=True,
            window_s=stillness_window_s(rig),
        )
        if has_events:
            gate = MotionGate(rig, Placements(), losses, takes_frames=True)
        for moment in find_moments(detections, gate):
            confirmed = tracker.confirm(moment)
            if isinstance(confirmed, Refusal):
                losses.add(confirmed)
            else:
                yield confirmed
        self.report.note(finding.sentence for finding in check.findings())

    def finish(self) -> CollectReport:
        """Complete the report.

        Raises:
            SourceError: nothing could be read and the session is empty.
        """
        report = self.report
        if self._n_wanted is not None:
            report.n_missing = max(0, self._n_wanted - self._n_captures)
        self._session.journal(
            "collected",
            captured=len(report.captured),
            known=report.n_known,
            refused={label: refusal.text for label, refusal in report.refused.items()},
            counts=report.counts.by_code(),
            errors=[error.what for error in report.errors],
        )
        if report.errors and self._n_captures == 0:
            raise report.errors[0]
        return report

    def _take_moment(
        self,
        recording: ContinuousRecording,
        moment: CaptureMoment,
        images: Sequence[Image],
        known: Placements,
    ) -> None:
        frame, poses = moment.detection.frame, moment.detection.poses
        stamps = [scan.stamp_ns for scan in frame.scans] + [image.stamp_ns for image in images]
        key = f"{recording.key}:{'/'.join(str(stamp) for stamp in stamps)}"
        label = f"at {stamps[0]} ns"
        if key in self._names_by_key:
            self.report.n_known += 1
            return
        if known.has_like(poses):
            self.report.counts.add(CALIBRATE_SAME_PLACEMENT.refusal())
            return
        events = [cut.events for cut in frame.events]
        serials = serials_of(recording)
        figures = {**moment.figures, **pose_figures(poses), **({SERIALS: serials} if serials else {})}
        self._store(key, label, images, frame.scans, figures, events)
        known.add(self._names_by_key.get(key, label), poses)

    def _store(
        self,
        key: str,
        label: str,
        images: Sequence[Image],
        scans: Sequence[Scan],
        figures: dict[str, object],
        events: Sequence[Events] = (),
    ) -> None:
        if self._session.find_duplicate(images, scans, events) is not None:
            self.report.n_known += 1
            return
        meta = {"source": {"key": key, "label": label}, **figures}
        name = self._session.add_capture(images, scans, meta, events)
        self._names_by_key[key] = name
        self._n_captures += 1
        self.report.captured.append(name)

    def _compare_beams(self, scan: Scan) -> None:
        """Add a note, once, if a LiDAR's rings differ from its model's."""
        if scan.sensor not in self._compared:
            self._compared.add(scan.sensor)
            found = compare_beams(scan, self._session.rig.lidars[scan.sensor])
            self.report.note(finding.sentence for finding in found)

    def _is_enough(self) -> bool:
        return self._n_wanted is not None and self._n_captures >= self._n_wanted

    def _read(self, recording: ContinuousRecording) -> Iterator[Sample]:
        """Yield samples up to a damaged part; its error is kept, and earlier moments are still captured."""
        done, self._torn = 0, None
        first_ns: int | None = None
        try:
            known = set[str]()
            for sample in check_overlap(recording.samples(), self._session.rig, recording.notes):
                if isinstance(sample, Scan) and sample.stamp_ns is not None:
                    first_ns = sample.stamp_ns if first_ns is None else first_ns
                    self.report.longest_s = max(self.report.longest_s, (sample.stamp_ns - first_ns) / 1e9)
                if isinstance(sample, Scan) and sample.sensor not in known:
                    _require_own_frame(sample, str(recording.path))
                    known.add(sample.sensor)
                    self._compare_beams(sample)
                yield sample
                if not isinstance(sample, Events):
                    done += 1
                    self._progress(done, recording.n_samples)
        except SourceError as error:
            self._torn = error


def _require_own_frame(scan: Scan, where: str) -> None:
    """Raise SourceError for a scan whose points are not in its LiDAR's own frame."""
    moved = check_origin(scan)
    if moved is not None:
        raise SourceError(f"{where}: {scan.sensor}: {moved.text}", as_line(moved.advice))
