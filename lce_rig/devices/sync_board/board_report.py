"""What a sync board's status holds: its clock, its figures, what is wrong with it."""

from dataclasses import dataclass

from lce_rig.core.findings import Figure, Finding
from lce_rig.devices.protocol import ClockState
from lce_rig.devices.sync_board.board_state import IMPLAUSIBLE, PULSE_LOST, RESTARTED, BoardState
from lce_rig.devices.sync_board.lines import LineReader
from lce_rig.devices.sync_board.lines.messages import LineFault, StatusFlag
from lce_rig.rig.sync_settings import PPS_LINE
from lce_rig.timing.clock import NS_PER_S

STALLED_S = 3.0

_DAMAGED = 0.01
_MIN_DAMAGED = 5
_PPS_LATE_S = 2.5
_NO_CLOCK_S = 5.0


@dataclass(frozen=True)
class BoardSnapshot:
    """A board at one moment.

    Attributes:
        state: what its messages add up to.
        reader: reads its lines.
        now_ns: the computer's steady clock.
        opened_ns, line_ns: when it was opened, and when its last message came.
        wants_triggers: lines that should pulse.
        n_unwritten: commands that it did not take.
    """

    state: BoardState
    reader: LineReader
    now_ns: int
    opened_ns: int
    line_ns: int
    wants_triggers: tuple[str, ...]
    n_unwritten: int

    def age_s(self, then_ns: int) -> float:
        """Give the seconds since a moment of the steady clock."""
        return (self.now_ns - then_ns) / NS_PER_S


def clock_state(view: BoardSnapshot) -> ClockState:
    """Say whose clock the timestamps are on, and how it is tied to others."""
    if not view.reader.dialect.has_triggers:
        return ClockState(Finding("clock.receiver", "note"))
    found: dict[str, Figure] = {}
    for name, model in (("host", view.state.host_clock), ("utc", view.state.utc_clock)):
        if model is not None:
            found |= {
                f"{name}_by": model.origin,
                f"{name}_drift_ppm": 1e6 * model.drift,
                f"{name}_sigma_us": model.sigma_ns(model.last_ns) / 1000,
            }
    if view.state.round_trip_ns is not None:
        found["round_trip_ms"] = view.state.round_trip_ns / 1e6
    return ClockState(Finding("clock.board", "note", figures=found))


def device_words(view: BoardSnapshot) -> str:
    """Name the board as it names itself."""
    hello = view.state.hello
    if hello is None or not hello.version:
        return ""
    return f"{hello.board}, firmware {hello.firmware}, LCE{hello.version}"


def figures(view: BoardSnapshot) -> dict[str, float]:
    """Give the board's figures by name."""
    state, faults = view.state, view.reader.faults
    found: dict[str, float] = {
        "n_messages": view.reader.n_messages,
        "n_bad_checksums": faults[LineFault.CHECKSUM],
        "n_malformed": faults[LineFault.MALFORMED] + faults[LineFault.TOO_LONG],
        "n_unknown": faults[LineFault.UNKNOWN],
        "n_implausible": state.losses.n(IMPLAUSIBLE),
        "n_resets": state.losses.n(RESTARTED),
        "line_age_s": view.age_s(view.line_ns),
    }
    for line, n_pulses in sorted(state.n_pulses.items()):
        found[f"n_pulses.{line}"] = n_pulses
    host = state.host_clock
    if host is not None:
        found["host_rms_us"] = host.rms_ns / 1000
    if state.pps is not None:
        found["pps_age_s"] = view.age_s(state.pps[1].steady_ns)
    for camera, exposure_us in sorted(state.exposure_us.items()):
        found[f"exposure_us.{camera}"] = exposure_us
    return found


def problems(view: BoardSnapshot) -> tuple[Finding, ...]:
    """Find what is wrong now."""
    silent_s = view.age_s(view.line_ns)
    if silent_s > STALLED_S:
        return (_warn("device.board_silent", silent_s=silent_s),)
    return (*_line_problems(view), *_board_problems(view), *_clock_problems(view), *_utc_problems(view))


def _warn(code: str, **figures: Figure) -> Finding:
    return Finding(code, "warning", figures=figures)


def _line_problems(view: BoardSnapshot) -> list[Finding]:
    faults = view.reader.faults
    n_damaged = sum(faults.values()) - faults[LineFault.UNKNOWN] + view.state.losses.n(IMPLAUSIBLE)
    n_lines = n_damaged + view.reader.n_messages
    found = []
    if n_damaged >= _MIN_DAMAGED and n_damaged > _DAMAGED * n_lines:
        found.append(_warn(IMPLAUSIBLE, n=n_damaged, n_lines=n_lines))
    if view.n_unwritten:
        found.append(_warn("device.commands_not_taken", n=view.n_unwritten))
    return found


def _board_problems(view: BoardSnapshot) -> list[Finding]:
    state = view.state
    found = []
    if state.reset_steady_ns is not None:
        ago_s = view.age_s(state.reset_steady_ns)
        found.append(_warn(RESTARTED, n=state.losses.n(RESTARTED), ago_s=ago_s))
    if state.error is not None:
        found.append(_warn("device.board_error", message=state.error.text, number=state.error.code))
    for line in view.wants_triggers:
        if not state.n_pulses[line] and view.age_s(view.opened_ns) > _NO_CLOCK_S:
            found.append(_warn("stream.no_pulses", line=line))
    by_line = state.n_lost_by_line()
    if by_line:
        n_lost, of_lines = sum(by_line.values()), tuple(sorted(by_line.items()))
        found.append(_warn(PULSE_LOST, n=n_lost, by_line=of_lines))
    if state.status is not None and state.status.n_lost:
        found.append(_warn("stream.lines_dropped_by_board", n=state.status.n_lost))
    return found


def _clock_problems(view: BoardSnapshot) -> list[Finding]:
    state = view.state
    found = []
    if view.reader.dialect.has_triggers and state.host_clock is None:
        if view.age_s(view.opened_ns) > _NO_CLOCK_S:
            found.append(_warn("clock.board_not_tied"))
    elif view.reader.dialect.time_request(0) and state.round_trip_ns is None:
        found.append(_warn("clock.board_by_arrivals"))
    n_steps = len(state.host_tracker.steps)
    if n_steps:
        size_s = state.host_tracker.steps[-1].size_ns / NS_PER_S
        found.append(_warn("clock.computer_jumped", n=n_steps, last_s=size_s))
    return found


def _utc_problems(view: BoardSnapshot) -> list[Finding]:
    state = view.state
    if not view.reader.dialect.has_triggers:
        if state.utc is None or state.utc.utc_ns is None:
            return [_warn("clock.receiver_no_time")]
        return [] if state.utc.is_valid else [_warn("clock.receiver_not_valid")]
    if state.hello is None or not state.hello.version:
        return []
    if state.pps is None:
        has_waited = view.age_s(view.opened_ns) > _NO_CLOCK_S
        return [_warn("clock.no_pps")] if has_waited else []
    found = []
    edge, arrival = state.pps
    if view.age_s(arrival.steady_ns) > _PPS_LATE_S:
        found.append(_warn("clock.pps_stopped", silent_s=view.age_s(arrival.steady_ns)))
    elif edge.utc_s is None:
        found.append(_warn("clock.board_without_utc"))
    if state.status is not None and not state.status.flags & StatusFlag.PPS_ON:
        found.append(_warn("clock.pps_output_off"))
    n_lost = state.n_lost_by_line().get(PPS_LINE)
    if n_lost:
        found.append(_warn("stream.pps_lines_lost", n=n_lost))
    return found
