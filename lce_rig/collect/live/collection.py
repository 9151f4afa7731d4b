"""The live loop: detect the board in the newest frame, give instructions, capture it at its placement.

Threads: one per sensor reads into one queue (`AttachedSensors`), one pairs (`FrameFeed`), one writes captures
(`CaptureWriter`). This loop alone decides, and updates the views. Processes: one detects the board
(`BoardSearch`), one calibrates from the captures (`Learning`).
"""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from lce_rig.collect.board_search import BoardSearch
from lce_rig.collect.board_tracker import BoardDetection, CaptureMoment, ImageKey
from lce_rig.collect.live.capture_writer import CaptureWriter, Learning, record_streams
from lce_rig.collect.live.frame_feed import FrameFeed
from lce_rig.collect.live.guide import (
    GIVE_UP_S,
    Guide,
    Narration,
    SlowBoards,
    StillBoards,
    count_in,
    make_guides,
    narrate_refused,
    narrate_unseen,
)
from lce_rig.collect.live.monitor import Monitor
from lce_rig.collect.live.state import Ending, Key, LiveOptions, LiveReport, LiveState, TakeBack
from lce_rig.collect.placement_dedupe import Placements
from lce_rig.core.geometry import Array
from lce_rig.devices import edge_cameras
from lce_rig.devices.reading import AttachedSensors, LiveSource
from lce_rig.devices.sync_board import SyncBoard
from lce_rig.session import Session
from lce_rig.session.capture import SERIALS
from lce_rig.timing.rig_clock import RigClock

# Switch interval of threads, s: sensor threads need the interpreter often and briefly, the loop holds it for
# long. Python's 5 ms would slow guidance by a third.
_TURN_S = 0.0005
# Largest apparent motion of a board at rest.
_SAME_M, _SAME_DEG = 0.02, 2.0


def collect_live(
    session: Session,
    sources: Sequence[LiveSource],
    options: LiveOptions | None = None,
    show: Callable[[LiveState], None] = lambda _state: None,
    keys: Callable[[], Key | TakeBack | None] = lambda: None,
    record_to: Path | None = None,
) -> LiveReport:
    """Collect from attached sensors until there are enough captures.

    Args:
        session: session, open for writing; its captures count.
        sources: live sources of every sensor, and of the sync board if there is one; not open yet.
        options: options of the collection.
        show: receives the state after every frame, and twice a second without one; must not block.
        keys: returns the user's last key or request, if any.
        record_to: a new folder for the raw streams; None to record none.

    Raises:
        SourceError: a sensor cannot be opened, or the folder for the raw streams cannot be created.
        SessionError: a capture cannot be written; those before are safe.
        ProfileError: the profile cannot be used, for example its network.
    """
    options = options or LiveOptions()
    rig = session.rig
    board = next((source for source in sources if isinstance(source, SyncBoard)), None)
    guides = make_guides(rig)
    for capture in session.captures:
        count_in(capture, session, guides)
    # Close in this order: stop new data first, then write the pending captures.
    with ExitStack() as stack:
        stack.callback(sys.setswitchinterval, sys.getswitchinterval())
        sys.setswitchinterval(_TURN_S)
        record, recorded = None, None
        if record_to is not None:
            record, recorded = record_streams(record_to, rig)
            stack.enter_context(recorded)
        keeper = CaptureWriter(session)
        stack.enter_context(keeper.disk)
        search = BoardSearch(rig)
        with search, Learning(rig, guides) as learning:
            clock = RigClock(rig, has_board=board is not None, edge_cameras=edge_cameras(rig))
            with AttachedSensors(sources) as sensors, FrameFeed(rig, sensors, clock, board, record) as feed:
                loop = _Loop(options, guides, feed, search, keeper, learning)
                loop.run(show, keys)
            keeper.close()
            loop.take_kept()
            report = loop.close_books()
    if recorded is not None:
        report.n_recorded, report.recording_error = recorded.n_written, recorded.failure
        report.notes += [finding.sentence for finding in recorded.findings()]
    return report


def _time_s(detection: BoardDetection) -> float:
    """Return the sensors' time in s: timeouts count sensor time, however slow this computer is."""
    return detection.frame.time_ns * 1e-9


class _Asked(NamedTuple):
    """A capture requested in this run: its name, detection time, and the board's pose by camera."""

    name: str
    time_ns: int
    poses: Mapping[ImageKey, Array]


class _Loop:
    def __init__(
        self,
        options: LiveOptions,
        guides: Sequence[Guide],
        feed: FrameFeed,
        search: BoardSearch,
        keeper: CaptureWriter,
        learning: Learning,
    ) -> None:
        self.report = LiveReport()
        self._session, self._rig, self._options = keeper.session, keeper.session.rig, options
        self._sensors, self._clock, self._feed, self._keeper = feed.sensors, feed.clock, feed, keeper
        self._guides, self._search, self._learning = guides, search, learning
        self._began_s = time.monotonic()
        self._gate: StillBoards | SlowBoards | None = None
        self._taken = Placements()
        self._n_before = len(self._session.captures)
        self._number = int(self._session.next_name)
        self._asked: list[_Asked] = []
        self._kept: set[str] = set()
        self._captured_s = self._began_s
        self._monitor = Monitor(self._session, options, feed)
        self._last: BoardDetection | None = None

    def run(self, show: Callable[[LiveState], None], keys: Callable[[], Key | TakeBack | None]) -> None:
        """Collect until an end condition; losses are logged while the sensors are still open."""
        while True:
            frame = self._feed.take()
            self.take_kept()
            if frame is not None:
                detection = self._search.sight(frame)
                if not self.report.n_frames:
                    self._captured_s = time.monotonic()  # not counting the start of the search
                self.report.n_frames += 1
                self._see(detection)
            key = keys()
            self._obey(key)
            ending = self._find_ending(key)
            if frame is not None or ending is not None or self._monitor.is_due():
                show(self._state(has_ended=ending is not None))
            if ending is not None:
                self.report.ending = ending
                lost = {name: error for name, (error, _) in self._sensors.lost().items()}
                self.report.notes += [f"{name} is lost: {e.what}. {e.hint}" for name, e in lost.items()]
                self.report.is_enough = all(guide.has_enough for guide in self._guides)
                for name, status in self._sensors.statuses().items():
                    self.report.n_lost[name] = status.n_lost + status.n_dropped
                return

    def take_kept(self) -> None:
        """Count the saved and rejected captures, and adopt new planners."""
        self._learning.teach()
        for name, detection, latency_s in self._keeper.take():
            if detection is None:
                self._learning.forget(name)
                self.report.taken_back.append(name)
                restore = f"lce-rig captures {self._session.path} --restore {name}"
                self._monitor.cue("taken_back", f"{name} taken back ({restore})")
                continue
            self._learning.show(name, detection)
            self.report.latencies_s.append(latency_s)
            self._kept.add(name)
            if any(name == asked.name for asked in self._asked):
                self._monitor.cue("captured", f"captured {name} ({latency_s:.2f} s)")
        self.report.captured = [asked.name for asked in self._asked if asked.name in self._kept]

    def close_books(self) -> LiveReport:
        """Complete the report, and write it into the session's journal."""
        report = self.report
        if report.ending == "exhausted":
            waited_s = time.monotonic() - self._captured_s
            report.notes.append(f"no capture in the last {waited_s:.0f} s, {self._monitor.last_words()}")
        predictions = [guide.predict() for guide in self._guides]
        report.predicted = [finding for finding in predictions if finding is not None]
        ties = self._clock.problems() + self._clock.account()
        report.notes += self._learning.notes()
        report.notes += [f"{finding.subject}: {finding.sentence}" for finding in ties]
        self._session.journal(
            "collected live",
            ending=report.ending,
            captured=len(report.captured),
            frames=report.n_frames,
            lost=report.n_lost,
            error="" if report.error is None else report.error.what,
        )
        return report

    def _see(self, detection: BoardDetection) -> None:
        """Capture the moments of a detection, and choose the instruction to show."""
        self._last = detection
        self._monitor.see(detection)
        gate = self._find_gate()
        moments = gate.take(detection)
        guide, poses = self._active_guide(detection), detection.poses
        for planned in self._guides:
            planned.plan(
                poses.get(planned.key),
                _time_s(detection),
                is_asked=planned is guide,
                others=self._guides if planned is guide else (),
            )
        present = poses.get(guide.key)
        if present is not None and guide.sees(detection):
            narration = gate.narrate(guide, present)
        else:
            narration = narrate_unseen(detection, guide, self._monitor.reasons)
        if len(self._guides) > 1 and narration.phase == "moving":
            narration = replace(narration, headline=f"{guide.key[0]}: {narration.headline}")
        for moment in moments:
            narration = self._decide(moment, narration)
        self._monitor.narrate(narration, guide, present)

    def _decide(self, moment: CaptureMoment, narration: Narration) -> Narration:
        """Capture a moment if it adds information."""
        detection = moment.detection
        guide = self._seeing_guide(detection)
        if guide is None:
            return narration
        n_wanted = self._options.n_wanted
        if n_wanted is not None and self._n_before + len(self._asked) >= n_wanted:
            return narration  # the last captures may still be waiting for the disk
        present = detection.poses[guide.key]
        refusal = guide.adds_nothing(present)
        if refusal is None:
            confirmed = self._search.confirm(moment)
            if isinstance(confirmed, CaptureMoment):
                self._capture(confirmed)
                return Narration("saving", "captured")
            refusal = confirmed
        self._monitor.cue("refused", f"not captured: {refusal.text}")
        guide.note_refusal(present)
        guide.plan(present, _time_s(detection))
        return narrate_refused(guide, present, refusal)

    def _capture(self, moment: CaptureMoment) -> None:
        detection, gate = moment.detection, self._find_gate()
        frame = detection.frame
        verdict = self._clock.verdict()
        meta: dict[str, object] = {
            "source": {"key": f"live:{frame.time_ns}", "label": f"live, at {frame.time_ns} ns"},
            "still_boards_only": verdict.requires_still_boards,
        }
        statuses = self._sensors.statuses()
        serials = {name: status.serial for name, status in statuses.items() if status.serial}
        meta |= {SERIALS: serials} if serials else {}
        # A board at rest gives too few events.
        self._keeper.keep(moment, frame.events if isinstance(gate, SlowBoards) else (), meta)
        name = f"{self._number:06d}"
        self._number += 1
        self._asked.append(_Asked(name, frame.time_ns, detection.poses))
        if isinstance(gate, SlowBoards):
            self._taken.add(str(frame.time_ns), detection.poses)
        else:
            gate.is_decided = True
        self._captured_s = time.monotonic()
        for guide in self._guides:
            if guide.sees(detection):
                guide.add(name, detection.poses[guide.key])

    @property
    def _n_captures(self) -> int:
        """Number of captures in the session that are saved and not rejected."""
        return self._n_before + len(self.report.captured)

    def _obey(self, key: Key | TakeBack | None) -> None:
        if isinstance(key, TakeBack):
            last = self._asked[-1].name if self._asked else ""
            if not last:
                self._monitor.cue("refused", "nothing to take back: no capture in this run")
            if not last or key.name not in ("", last):
                return  # A late or repeated tap must not reject another capture.
            # The capture may or may not be on the disk yet.
            taken = self._asked.pop()
            self._keeper.take_back(last)
            self.report.captured = [name for name in self.report.captured if name != last]
            for planned in self._guides:
                planned.remove(last)
            self._taken.remove(str(taken.time_ns))
            return
        guide = None if self._last is None else self._active_guide(self._last)
        if key == "next" and guide is not None:
            guide.give_up()
            self._monitor.log("another placement requested")
        if key == "capture" and guide is not None and self._last is not None:
            self._capture_by_hand(self._last)

    def _capture_by_hand(self, detection: BoardDetection) -> None:
        """Capture the board at once on request, even if it moves, unless it was just captured."""
        if self._seeing_guide(detection) is None:
            self._monitor.cue("refused", "not captured: not every sensor sees the board")
            return
        # A keypress just after an automatic capture is treated as late and ignored.
        is_recent = time.monotonic() - self._captured_s < self._options.hold_s
        places = Placements() if is_recent else Placements(_SAME_M, _SAME_DEG)
        if self._asked and places.are_alike(self._asked[-1].poses, detection.poses):
            name = self._asked[-1].name
            self._monitor.cue("refused", f"not captured: {name} shows the board here; move it first")
            return
        confirmed = self._search.confirm(CaptureMoment(detection, {"by_hand": 1.0}))
        if isinstance(confirmed, CaptureMoment):
            self._capture(confirmed)
        else:
            self._monitor.cue("refused", f"not captured: {confirmed.sentence}")

    def _find_ending(self, key: Key | TakeBack | None) -> Ending | None:
        options, elapsed_s = self._options, time.monotonic() - self._began_s
        lost = self._sensors.lost()
        vital = {name: why for name, why in lost.items() if name in {*self._rig.lidars, *self._rig.cameras}}
        for error, since_s in vital.values():
            if time.monotonic() - since_s > options.lost_s:
                self.report.error = error
                return "lost"
        if key == "stop":
            return "stopped"
        if options.n_wanted is not None and self._n_captures >= options.n_wanted:
            return "frames"
        if options.timeout_s is not None and elapsed_s > options.timeout_s:
            return "timeout"
        if self._keeper.is_busy:
            return None
        if self._is_enough() and not options.is_open:
            return "enough"
        if options.idle_s is None:
            return None
        # No new placement was shown for long, or none is left.
        has_nothing_left = all(guide.is_exhausted for guide in self._guides)
        patience_s = min(options.idle_s, GIVE_UP_S) if has_nothing_left else options.idle_s
        return "exhausted" if time.monotonic() - self._captured_s > patience_s else None

    def _is_enough(self) -> bool:
        return all(guide.is_enough for guide in self._guides)

    def _state(self, *, has_ended: bool) -> LiveState:
        lacking = [why for guide in self._guides if (why := guide.explain()) is not None]
        goes_on = ""
        if lacking and not has_ended:
            # Report the reason of the guide that needs most captures.
            most = max(lacking, key=lambda why: why.figures.get("n_more") or 0)
            goes_on = (f"{most.subject}: " if len(self._guides) > 1 else "") + most.sentence
        return self._monitor.state(
            self._n_captures,
            is_enough=self._is_enough(),
            has_ended=has_ended,
            last_capture=self._asked[-1].name if self._asked and not has_ended else "",
            goes_on=goes_on,
        )

    def _active_guide(self, detection: BoardDetection) -> Guide:
        """Pick the guide to show: the one that needs captures most among those with a visible board.

        If these all have enough, include the cameras whose guides have not.
        """
        seeing = [g for g in self._guides if g.key in detection.poses]
        if seeing and all(guide.is_enough for guide in seeing):
            seeing += [guide for guide in self._guides if not guide.is_enough]
            return max(seeing, key=lambda guide: (not guide.is_enough, guide.need))
        return max(seeing or self._guides, key=lambda guide: guide.need)

    def _seeing_guide(self, detection: BoardDetection) -> Guide | None:
        """Pick the guide that judges a placement: the neediest of those that detect it."""
        return max((g for g in self._guides if g.sees(detection)), key=lambda g: g.need, default=None)

    def _find_gate(self) -> StillBoards | SlowBoards:
        """Choose the gate: for moving boards with events and synchronised clocks, else for still boards."""
        has_events = self._last is not None and bool(self._last.frame.events)
        may_move = has_events and not self._clock.verdict().requires_still_boards
        if self._gate is None or may_move != isinstance(self._gate, SlowBoards):
            self._gate = (
                SlowBoards(self._rig, self._taken)
                if may_move
                else StillBoards(self._rig, self._options.hold_s)
            )
        return self._gate
