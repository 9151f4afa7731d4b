"""Gathers the states that views show."""

import time
from collections import deque

import numpy as np

from lce_rig.collect.board_tracker import BoardDetection
from lce_rig.collect.live.guide import Guide
from lce_rig.collect.live.narration import Narration, image_figures, scan_figures, stream_name
from lce_rig.collect.live.state import Cue, Drawing, LiveOptions, LiveState, Phase, Sound, StreamState
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.devices.reading import AttachedSensors, SourceStatus
from lce_rig.session import Session
from lce_rig.timing.rig_clock import RigClock

_EVERY_S = 0.5
_N_CUES, _N_LOG = 8, 40
_TICK_S = 0.5
_ENOUGH = "enough: you may stop"
_MET = "the target is predicted to be met"
_WAIT = "waiting for the sensors"
# Without a frame for so long, the last detection is out of date.
_STALE_S = 2.0


class Monitor:
    """Remembers the latest of everything.

    Attributes:
        reasons: why the board is not seen, by the stream's name.
    """

    def __init__(
        self, session: Session, options: LiveOptions, sensors: AttachedSensors, clock: RigClock
    ) -> None:
        """Begin with nothing seen."""
        self.reasons: dict[str, Refusal] = {}
        self._session = session
        self._options = options
        self._sensors = sensors
        self._clock = clock
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

    def see(self, detection: BoardDetection) -> None:
        """Take a detection, and remember why streams do not show the board."""
        self._detection, self._seen_s = detection, time.monotonic()
        for key, why in detection.unseen.items():
            self.reasons[stream_name(key)] = why
        self.reasons.update(detection.unscanned)
        for key in detection.images:
            self.reasons.pop(stream_name(key), None)
        for key, why in detection.unfit.items():
            self.reasons[stream_name(key)] = why
        for lidar in detection.lidars:
            self.reasons.pop(lidar, None)

    def narrate(self, narration: Narration, guide: Guide, present: Array | None) -> None:
        """Take the narration of the last detection."""
        self._narration, self._guide = narration, guide
        # Tick every half second while the board is held.
        ticks_left = None if narration.hold_s is None else int(narration.hold_s / _TICK_S)
        if ticks_left not in (None, self._ticks_left):
            self.cue("tick")
        self._ticks_left = ticks_left
        assert self._detection is not None
        picture = next(
            (each for each in self._detection.frame.images if (each.sensor, each.channel) == guide.key), None
        )
        if picture is not None:
            self._drawing = Drawing(
                stream_name(guide.key),
                picture.pixels,
                None if present is None else guide.outline_px(present),
                None if guide.wanted is None else guide.outline_px(guide.wanted),
                present is not None and guide.is_there(present),
                present,
                guide.wanted,
            )

    def cue(self, sound: Sound, text: str = "") -> None:
        """Ask for a sound, and log a message."""
        self._n_cues += 1
        self._cues.append(Cue(self._n_cues, sound))
        if text:
            self.log(text)

    def log(self, text: str) -> None:
        """Log a message, with the time since the beginning."""
        elapsed_s = int(time.monotonic() - self._began_s)
        self._n_logged += 1
        self._log.append(f"{elapsed_s // 60:02d}:{elapsed_s % 60:02d} {text}")

    def last_words(self) -> str:
        """Repeat what was said last, for a report."""
        said = self._narration
        return f"last said: {said.headline}" + (f" ({said.detail})" if said.detail else "")

    def is_due(self) -> bool:
        """Check whether views have not been updated for long."""
        return time.monotonic() - self._told_s > _EVERY_S

    def state(
        self, n_captures: int, *, is_enough: bool, has_ended: bool, last_capture: str = "", goes_on: str = ""
    ) -> LiveState:
        """Give everything as it is now."""
        self._told_s = now_s = time.monotonic()
        self._watch_sensors()
        if is_enough and not self._was_enough:
            n_wanted = self._options.n_wanted
            what_now = "you may stop" if n_wanted is None else f"going on to {n_wanted} captures"
            self.cue("enough", f"{_MET}: {what_now}")
            self._was_enough = True
        phase, headline, detail = self._phase(is_enough=is_enough, has_ended=has_ended)
        rig, guidance = self._session.rig, self._guide.guidance if self._guide else None
        # Before the first capture there is nothing but wide priors.
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
            sigma_deg=np.nan if guidance is None else guidance.sigma_rotation_deg,
            sigma_mm=np.nan if guidance is None else 1000 * guidance.sigma_translation_m,
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
            return "ended", "collection has ended", _MET if is_enough else ""
        if self._lost:
            name = sorted(self._lost)[0]
            error = self._sensors.lost().get(name)
            return "lost", f"{name} is lost", "" if error is None else f"{error[0].what} {error[0].hint}"
        if is_enough and not self._options.is_open:
            return "enough", _ENOUGH, said.headline
        if self._is_stale():
            waited_s = time.monotonic() - self._seen_s
            return "searching", _WAIT, f"no image with a scan of its time for {waited_s:.0f} s"
        return said.phase, said.headline, said.detail or (_MET if is_enough else "")

    def _watch_sensors(self) -> None:
        """Ask how sensors do, and log those that go and come back."""
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
        """List every stream: channels of cameras, LiDARs, then what else there is."""
        rig, streams = self._session.rig, []
        for name, camera in rig.cameras.items():
            status = self._statuses.get(name, SourceStatus(name))
            for channel, settings in camera.channels.items():
                # Only its source knows the rates of frames and events of one camera.
                is_framed = settings.kind == "frames"
                kind_hz = status.rates_hz.get(settings.kind, status.rate_hz if is_framed else 0.0)
                streams.append(self._camera_stream(name, channel, is_framed, kind_hz, status))
        for name in rig.lidars:
            streams.append(self._lidar_stream(name, self._statuses.get(name, SourceStatus(name))))
        for name, status in self._statuses.items():
            if name not in {*rig.cameras, *rig.lidars}:
                streams.append(StreamState(name, status.rate_hz, status.n_lost, None, self._trouble(name)))
        return tuple(streams)

    def _camera_stream(
        self, camera: str, channel: str, is_framed: bool, rate_hz: float, status: SourceStatus
    ) -> StreamState:
        name, detection = f"{camera}.{channel}", None if self._is_stale() else self._detection
        n_lost = status.n_lost + status.n_dropped
        pictures = {(i.sensor, i.channel) for i in detection.frame.images} if detection else set()
        if detection is None or (camera, channel) not in pictures:
            return StreamState(name, rate_hz, n_lost, None, self._trouble(camera) if is_framed else "")
        board = detection.images.get((camera, channel))
        if board is None or (camera, channel) in detection.unfit:
            why = self.reasons.get(name)
            reason = self._trouble(camera) or (why.sentence if why else "no board")
            return StreamState(name, rate_hz, n_lost, False, reason)
        return StreamState(name, rate_hz, n_lost, True, self._trouble(camera), image_figures(board))

    def _lidar_stream(self, lidar: str, status: SourceStatus) -> StreamState:
        detection, n_lost = None if self._is_stale() else self._detection, status.n_lost + status.n_dropped
        if detection is None or not detection.images:
            return StreamState(lidar, status.rate_hz, n_lost, None, self._trouble(lidar))
        boards = detection.lidars.get(lidar)
        if not boards:
            why = self.reasons.get(lidar)
            reason = self._trouble(lidar) or (why.sentence if why else "no board")
            return StreamState(lidar, status.rate_hz, n_lost, False, reason)
        return StreamState(lidar, status.rate_hz, n_lost, True, self._trouble(lidar), scan_figures(boards[0]))

    def _trouble(self, sensor: str) -> str:
        """Say what is wrong with a sensor now; "" where nothing is."""
        lost = self._sensors.lost().get(sensor)
        return "" if lost is None else f"lost: {lost[0].what}"

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
            notes.append(self._guide.problem.sentence)
        return tuple(notes)
