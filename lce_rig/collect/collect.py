"""Build a session from recordings, unattended: what is new becomes a capture, the rest is counted."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from lce_rig.collect.novelty import KnownPoses, board_figures
from lce_rig.collect.pairing import PairingCounts, pair_by_time
from lce_rig.collect.stillness import BoardWatcher, Still, StillnessOptions, find_still_moments
from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import SessionError, SourceError
from lce_rig.core.results import Refusal
from lce_rig.session import Session
from lce_rig.sources.base import ContinuousRecording, PairedRecording, PairFiles, Recording, Sample

Progress = Callable[[int, int, str], None]
"""Told (samples done, samples in all, what happened)."""


@dataclass(frozen=True)
class CollectOptions:
    """What becomes a capture.

    Attributes:
        max_captures: the session is never filled beyond this; None for no limit.
        target: number of captures wanted: recordings are read until the session has as many.
        min_move_m, min_turn_deg: a board differs from one captured before when it moved or turned as far; for
            continuous recordings only.
        stillness: when a board stands still; None takes the profile's `quality.max_motion_m`.
    """

    max_captures: int | None = None
    target: int | None = None
    min_move_m: float = 0.15
    min_turn_deg: float = 10.0
    stillness: StillnessOptions | None = None


@dataclass
class CollectReport:
    """What became of everything that was read.

    Attributes:
        captured: names of the new captures.
        n_resumed: pairs and moments that an earlier run had captured already.
        duplicates: capture that holds the same data, by label.
        refused: why something became no capture, by label.
        counts: how often each reason kept a moment of a continuous recording from becoming one.
        notes: what was chosen, assumed or left out, in words.
        errors: recordings that could not be read to their end; what was captured before is kept.
        n_missing: captures short of the target.
    """

    captured: list[str] = field(default_factory=list)
    n_resumed: int = 0
    duplicates: dict[str, str] = field(default_factory=dict)
    refused: dict[str, Refusal] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    errors: list[SourceError] = field(default_factory=list)
    n_missing: int = 0


def collect(
    session: Session,
    recordings: Sequence[Recording],
    options: CollectOptions | None = None,
    progress: Progress | None = None,
) -> CollectReport:
    """Fill a session from recordings.

    A folder's pairs become captures as they are. A continuous recording is cut where the board stands still
    in every sensor that sees it, and differs from what the session holds. What an earlier run captured is not
    captured again.

    Raises:
        SourceError: nothing could be read at all; it names the first file and the cause.
        SessionError: the session cannot be written; what was captured before is safe.
    """
    collector = _Collector(session, options or CollectOptions(), progress or _silent)
    for recording in recordings:
        collector.note(recording.notes)
        try:
            if isinstance(recording, PairedRecording):
                collector.take_pairs(recording)
            elif isinstance(recording, ContinuousRecording):
                collector.take_moments(recording)
        except SourceError as error:
            collector.report.errors.append(error)
        finally:
            collector.note(recording.notes)
    return collector.finish()


def _silent(_done: int, _total: int, _message: str) -> None:
    return


class _Collector:
    def __init__(self, session: Session, options: CollectOptions, progress: Progress) -> None:
        self.report = CollectReport()
        self._session = session
        self._options = options
        self._progress = progress
        self._names_by_key = _known_keys(session)
        self._n_captures = len(session.captures)

    def take_pairs(self, recording: PairedRecording) -> None:
        """Capture every pair of a folder.

        Raises:
            SourceError: not one pair could be read; its cause is that of the first.
        """
        failures: list[SourceError] = []
        n_left_out = 0
        for done, files in enumerate(recording.pairs):
            message = files.label
            if self._is_enough():
                n_left_out += 1
                continue
            try:
                message = self._take_pair(files)
            except SourceError as error:
                failures.append(error)
                self.report.refused[files.label] = Refusal(
                    "read", error.what, error.hint or "record it again"
                )
                message = f"{files.label} refused: {error.what}"
            self._progress(done + 1, len(recording.pairs), message)
        if n_left_out:
            self.note(
                [f"{n_left_out} pairs left out: the session holds {self._n_captures} captures, as wanted"]
            )
        if failures and len(failures) == len(recording.pairs):
            raise failures[0]

    def take_moments(self, recording: ContinuousRecording) -> None:
        """Capture a continuous recording's still moments.

        Raises:
            SourceError: the recording is torn; what came before it has been captured.
        """
        rig = self._session.rig
        stillness = self._options.stillness or StillnessOptions(max_motion_m=rig.quality.max_motion_m)
        board = rig.board.to_board()
        known = KnownPoses(self._session, self._options.min_move_m, self._options.min_turn_deg)
        counts = PairingCounts()
        watcher = BoardWatcher(rig, stillness)
        torn: list[SourceError] = []
        samples = self._counted(_until_torn(recording.samples(), torn), recording.n_samples)
        sightings = (watcher.sight(frame) for frame in pair_by_time(samples, rig, counts))
        for still in find_still_moments(sightings, board, stillness):
            if self._is_enough():
                self.note(["stopped early: the session has as many captures as wanted"])
                break
            self._take_moment(recording.key, still, known)
        self.report.counts.update(watcher.counts)
        self._note_pairing(counts)
        if torn:
            raise torn[0]

    def note(self, notes: Iterable[str]) -> None:
        """Keep notes, each once."""
        self.report.notes.extend(note for note in notes if note not in self.report.notes)

    def finish(self) -> CollectReport:
        """Close the books.

        Raises:
            SourceError: nothing could be read and the session is empty.
        """
        report = self.report
        if self._options.target is not None:
            report.n_missing = max(0, self._options.target - self._n_captures)
        self._session.journal(
            "collected",
            captured=len(report.captured),
            resumed=report.n_resumed,
            duplicates=report.duplicates,
            refused={label: refusal.cause for label, refusal in report.refused.items()},
            counts=dict(sorted(report.counts.items())),
            errors=[error.what for error in report.errors],
        )
        if report.errors and self._n_captures == 0:
            raise report.errors[0]
        return report

    def _take_pair(self, files: PairFiles) -> str:
        key = files.key()
        if key in self._names_by_key:
            self.report.n_resumed += 1
            return f"{files.label} is capture {self._names_by_key[key]} already"
        pair = files.read()
        self.note(pair.notes)
        self._note_sizes(pair.images)
        return self._store(key, files.label, pair.images, pair.scans, {})

    def _take_moment(self, recording_key: str, still: Still, known: KnownPoses) -> None:
        frame = still.sighting.frame
        stamps = [scan.stamp_ns for scan in frame.scans] + [image.stamp_ns for image in frame.images]
        key = f"{recording_key}:{'/'.join(str(stamp) for stamp in stamps)}"
        label = f"at {stamps[0]} ns"
        if key in self._names_by_key:
            self.report.n_resumed += 1
            return
        same = known.find_like(still.sighting.images)
        if same is not None:
            self.report.counts["the board stood as in a capture before"] += 1
            return
        self._note_sizes(frame.images)
        figures = {"motion_m": round(still.motion_m, 6), **board_figures(still.sighting.images)}
        self._store(key, label, frame.images, frame.scans, figures)
        known.add(self._names_by_key.get(key, label), still.sighting.images)

    def _store(
        self, key: str, label: str, images: Sequence[Image], scans: Sequence[Scan], figures: dict[str, object]
    ) -> str:
        duplicate = self._session.find_duplicate(images, scans)
        if duplicate is not None:
            self.report.duplicates[label] = duplicate
            return f"{label} is a duplicate of {duplicate}"
        meta = {"source": {"key": key, "label": label}, **figures}
        name = self._session.add_capture(images, scans, meta)
        self._names_by_key[key] = name
        self._n_captures += 1
        self.report.captured.append(name)
        return f"{label} captured as {name}"

    def _is_full(self) -> bool:
        limit = self._options.max_captures
        return limit is not None and self._n_captures >= limit

    def _is_enough(self) -> bool:
        target = self._options.target
        return self._is_full() or (target is not None and self._n_captures >= target)

    def _counted(self, samples: Iterable[Sample], n_samples: int) -> Iterator[Sample]:
        for done, sample in enumerate(samples):
            yield sample
            self._progress(done + 1, n_samples, f"{len(self.report.captured)} captured")

    def _note_sizes(self, images: Iterable[Image]) -> None:
        for image in images:
            height, width = image.pixels.shape[:2]
            wanted = self._session.rig.cameras[image.sensor].resolution_px
            if (width, height) != wanted:
                size = f"{wanted[0]}x{wanted[1]}"
                self.note(
                    [f"camera {image.sensor}: pictures of {width}x{height} where the profile says {size}"]
                )

    def _note_pairing(self, counts: PairingCounts) -> None:
        if counts.n_alone == 0:
            return
        self.report.counts["no picture at the time of the scan"] += counts.n_alone
        if counts.nearest_ns is None:
            self.note(["no picture could be compared with a scan: one of the two has none"])
        else:
            apart_s = counts.nearest_ns * 1e-9
            self.note([f"{counts.n_alone} scans without a picture; the nearest was {apart_s:.3f} s away"])


def _until_torn(samples: Iterable[Sample], torn: list[SourceError]) -> Iterator[Sample]:
    """Pass samples on, and end where the recording is torn: moments found so far must still be captured."""
    try:
        yield from samples
    except SourceError as error:
        torn.append(error)


def _known_keys(session: Session) -> dict[str, str]:
    keys = {}
    for capture in session.captures:
        try:
            source = capture.meta.get("source", {})
        except SessionError:
            continue  # A damaged capture is named when it is used.
        if isinstance(source, dict) and isinstance(source.get("key"), str):
            keys[source["key"]] = capture.name
    return keys
