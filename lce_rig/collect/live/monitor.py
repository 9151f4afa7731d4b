"""The states that views show."""

import time
from collections import deque

import numpy as np

from lce_rig.collect.board_tracker import BoardDetection
from lce_rig.collect.live.frame_feed import FrameFeed
from lce_rig.collect.live.guide import Guide, Narration
from lce_rig.collect.live.state import Cue, Drawing, LiveOptions, LiveState, Phase, Sound, StreamState
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.devices.reading import SourceStatus
from lce_rig.session import Session

# Longest time without an update of the views, and interval for reading the sensors' states, s.
_EVERY_S = 0.5
_N_CUES, _N_LOG = 8, 40
_ENOUGH = "enough: you may stop"
_MET, _COUNTED = "the target is predicted to be met", "enough placements"
_WAIT = "waiting for the sensors"
# Age at which the last detection is out of date, s.
_STALE_S = 2.0


class Monitor:
    """Keeps the latest detection, sensor states and messages for the views.

    Attributes:
        reasons: why the board is not seen, by the stream's name.
    """

    def __init__(self, session: Session, options: LiveOptions, feed: FrameFeed) -> None:
        """Begin without a detection."""
        self.reasons: dict[str, Refusal] = {}
        self._session = session
        self._options = options
        self._sensors, self._clock = feed.sensors, feed.clock
        self._began_s = self._told_s = self._asked_s = time.monotonic()
        self._statuses: dict[str, SourceStatus] = {}
        self._cues: deque[Cue] = deque(maxlen=_N_CUES)
        self._n_cues = 0
        self._log: deque[str] = deque(maxlen=_N_LOG)
        self._n_logged = 0
        self._narration = Narration("starting", _WAIT)
        self._guide: Guide | None = None
        self._drawing: Drawing | None = None
        self._detection: BoardDetection | None = None
        self._seen_s = 0.0
        self._ticks_left: int | None = None
        self._lost: frozenset[str] = frozenset()
        self._was_enough = False
        self._is_of_one_kind = not session.rig.cameras or not session.rig.lidars
        self._met = _COUNTED if self._is_of_one_kind else _MET

    def see(self, detection: BoardDetection) -> None:
        """Store a detection and the reasons why streams do not show the board."""
        self._detection, self._seen_s = detection, time.monotonic()
        for key, why in detection.unseen.items():
            self.reasons[".".join(key)] = why
        self.reasons.update(detection.unscanned)
        for key in detection.images:
            self.reasons.pop(".".join(key), None)
        for key, why in detection.unfit.items():
            self.reasons[".".join(key)] = why
        for lidar in detection.lidars:
            self.reasons.pop(lidar, None)

    def narrate(self, narration: Narration, guide: Guide, present: Array | None) -> None:
        """Store the instruction for the last detection."""
        self._narration, self._guide = narration, guide
        # Tick every half second while the board is held.
        ticks_left = None if narration.hold_s is None else int(narration.hold_s / 0.5)
        if ticks_left not in (None, self._ticks_left):
            self.cue("tick")
        self._ticks_left = ticks_left
        assert self._detection is not None
        picture = next(
            (each for each in self._detection.frame.images if (each.sensor, each.channel) == guide.key), None
        )
        if picture is not None:
            self._drawing = Drawing(
                ".".join(guide.key),
                picture.pixels,
                None if present is None else guide.outline_px(present),
                None if guide.wanted is None else guide.outline_px(guide.wanted),
                present is not None and guide.is_there(present),
                present,
                guide.wanted,
            )

    def cue(self, sound: Sound, text: str = "") -> None:
        """Request a sound, and log a message."""
        self._n_cues += 1
        self._cues.append(Cue(self._n_cues, sound))
        if text:
            self.log(text)

    def log(self, text: str) -> None:
        """Log a message with the time since the start."""
        elapsed_s = int(time.monotonic() - self._began_s)
        self._n_logged += 1
        self._log.append(f"{elapsed_s // 60:02d}:{elapsed_s % 60:02d} {text}")

    def last_words(self) -> str:
        """Return the last instruction, for a report."""
        said = self._narration
        return f"last said: {said.headline}" + (f" ({said.detail})" if said.detail else "")

    def is_due(self) -> bool:
        """Check whether the views are due for an update."""
        return time.monotonic() - self._told_s > _EVERY_S

    def state(
        self, n_captures: int, *, is_enough: bool, has_ended: bool, last_capture: str = "", goes_on: str = ""
    ) -> LiveState:
        """Return the present state of the collection."""
        self._told_s = now_s = time.monotonic()
        self._watch_sensors()
        if is_enough and not self._was_enough:
            n_wanted = self._options.n_wanted
            what_now = "you may stop" if n_wanted is None else f"going on to {n_wanted} captures"
            self.cue("enough", f"{self._met}: {what_now}")
            self._was_enough = True
        phase, headline, detail = self._phase(is_enough=is_enough, has_ended=has_ended)
        rig, guidance = self._session.rig, self._guide.guidance if self._guide else None
        # Before the first capture the figures are those of the wide priors.
        guidance = guidance if guidance is not None and guidance.n_captures else None
        return LiveState(
            rig=rig.name,
            session=str(self._session.path),
            elapsed_s=now_s - self._began_s,
            phase=phase,
            headline=headline,
            detail=detail,
            hold_s=self._narration.hold_s if phase == "holding" else None,
            n_captures=n_captures,
            n_wanted=self._options.n_wanted,
            streams=self._streams(),
            drawing=self._drawing,
            coverage=self._guide.coverage() if self._guide else None,
            sigma_deg=np.nan if guidance is None else guidance.bound_rotation_deg,
            sigma_mm=np.nan if guidance is None else 1000 * guidance.bound_translation_m,
            target_deg=rig.calibration.target_sigma_deg,
            target_mm=1000 * rig.calibration.target_sigma_m,
            cues=tuple(self._cues),
            log=tuple(self._log),
            notes=self._notes(),
            n_logged=self._n_logged,
            last_capture=last_capture,
            goes_on=goes_on,
            requires_still_boards=self._clock.verdict().requires_still_boards,
        )

    def _phase(self, *, is_enough: bool, has_ended: bool) -> tuple[Phase, str, str]:
        said = self._narration
        if has_ended:
            return "ended", "collection has ended", self._met if is_enough else ""
        if self._lost:
            name = sorted(self._lost)[0]
            error = self._sensors.lost().get(name)
            return "lost", f"{name} is lost", "" if error is None else f"{error[0].what} {error[0].hint}"
        if is_enough and not self._options.is_open:
            return "enough", _ENOUGH, said.headline
        if self._is_stale():
            waited_s = time.monotonic() - self._seen_s
            pair = "simultaneous samples" if self._is_of_one_kind else "image with a simultaneous scan"
            return "searching", _WAIT, f"no {pair} for {waited_s:.0f} s"
        return said.phase, said.headline, said.detail or (self._met if is_enough else "")

    def _watch_sensors(self) -> None:
        """Update the states of sensors, and log lost and reconnected ones."""
        if not self._statuses or time.monotonic() - self._asked_s > _EVERY_S:
            self._asked_s = time.monotonic()
            self._statuses = self._sensors.statuses()
        lost = self._sensors.lost()
        for name in sorted(lost.keys() - self._lost):
            self.cue("lost", f"{name} is lost: {lost[name][0].what}")
        for name in sorted(self._lost - lost.keys()):
            self.log(f"{name} is back")
        self._lost = frozenset(lost)

    def _is_stale(self) -> bool:
        """Check whether the last detection is out of date."""
        return self._detection is not None and time.monotonic() - self._seen_s > _STALE_S

    def _streams(self) -> tuple[StreamState, ...]:
        """List every stream: the cameras' channels, LiDARs, then other sources."""
        rig, streams = self._session.rig, []
        detection = None if self._is_stale() else self._detection
        images = [] if detection is None else [(i.sensor, i.channel) for i in detection.frame.images]
        for name, camera in rig.cameras.items():
            status = self._statuses.get(name, SourceStatus(name))
            for channel, settings in camera.channels.items():
                figures = None
                if detection is not None and (name, channel) in images:
                    board = (
                        None if (name, channel) in detection.unfit else detection.images.get((name, channel))
                    )
                    figures = f"{board.distance_m:.1f} m, {board.reprojection_px:.2f} px" if board else ""
                # Only the source knows the separate rates of a camera's frames and events.
                usual_hz = status.rate_hz if settings.kind == "frames" else 0.0
                rate_hz = status.rates_hz.get(settings.kind, usual_hz)
                streams.append(self._stream(f"{name}.{channel}", status, rate_hz, figures))
        for name in rig.lidars:
            status, figures = self._statuses.get(name, SourceStatus(name)), None
            if detection is not None and detection.poses:
                boards = detection.lidars.get(name)
                figures = (
                    f"{boards[0].quality.n_rings} rings, {len(boards[0].points)} points" if boards else ""
                )
            streams.append(self._stream(name, status, status.rate_hz, figures))
        others = (each for name, each in self._statuses.items() if name not in {*rig.cameras, *rig.lidars})
        return (*streams, *(self._stream(each.sensor, each, each.rate_hz, None) for each in others))

    def _stream(self, name: str, status: SourceStatus, rate_hz: float, figures: str | None) -> StreamState:
        """Describe a stream; its board figures are "" if not detected, None if not searched for."""
        lost = self._sensors.lost().get(status.sensor)
        reason = "" if lost is None else f"lost: {lost[0].what}"
        if figures == "" and not reason:
            reason = self.reasons[name].sentence if name in self.reasons else "no board"
        sees_board = None if figures is None else bool(figures)
        return StreamState(name, rate_hz, status.n_lost + status.n_dropped, sees_board, reason, figures or "")

    def _notes(self) -> tuple[str, ...]:
        verdict = self._clock.verdict()
        notes = []
        if verdict.requires_still_boards:
            reasons = "; ".join(reason.sentence for reason in verdict.reasons)
            notes.append(f"{verdict.finding.text}: {reasons}")
        notes += [f"{problem.subject}: {problem.sentence}" for problem in self._clock.problems()]
        named: dict[str, list[str]] = {}
        for name, status in self._statuses.items():
            for problem in status.problems:
                named.setdefault(problem.sentence, []).append(name)
        notes += [f"{', '.join(names)}: {sentence}" for sentence, names in named.items()]
        if self._guide is not None and self._guide.problem:
            notes.append(self._guide.why_none)
        return tuple(notes)
