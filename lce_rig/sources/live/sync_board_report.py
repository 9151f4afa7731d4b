"""What `doctor` and the live view say about a sync board: its clock, its figures, what is wrong with it."""

from dataclasses import dataclass

from lce_rig.core.clock import NS_PER_S
from lce_rig.sources.live.sync_board_state import PPS_LINE, BoardState
from lce_rig.sources.live.sync_lines import LineReader
from lce_rig.sources.live.sync_lines.messages import LineFault, StatusFlag

STALLED_S = 3.0

_DAMAGED = 0.01
_MIN_DAMAGED = 5
_PPS_LATE_S = 2.5
_NO_CLOCK_S = 5.0


@dataclass(frozen=True)
class BoardView:
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


def clock_words(view: BoardView) -> str:
    """Say whose clock the stamps are on, and how it is tied to others."""
    host, utc = view.state.host_clock, view.state.utc_clock
    if not view.reader.dialect.has_triggers:
        return "UTC by whole seconds; no pulses"
    parts = [f"to the computer's by {host}" if host else "not yet tied to the computer's"]
    if utc is not None:
        parts.append(f"to UTC by {utc}")
    return f"the board's own, {'; '.join(parts)}"


def device_words(view: BoardView) -> str:
    """Name the board as it names itself."""
    hello = view.state.hello
    if hello is None or not hello.version:
        return ""
    return f"{hello.board}, firmware {hello.firmware}, LCE{hello.version}"


def figures(view: BoardView) -> dict[str, float]:
    """Give the board's figures by name."""
    state, faults = view.state, view.reader.faults
    found: dict[str, float] = {
        "n_messages": view.reader.n_messages,
        "n_bad_checksums": faults[LineFault.CHECKSUM],
        "n_malformed": faults[LineFault.MALFORMED] + faults[LineFault.TOO_LONG],
        "n_unknown": faults[LineFault.UNKNOWN],
        "n_implausible": state.counts.n_implausible,
        "n_resets": state.counts.n_resets,
        "line_age_s": view.age_s(view.line_ns),
    }
    for line, n_pulses in sorted(state.counts.n_pulses.items()):
        found[f"n_pulses.{line}"] = n_pulses
        found[f"n_lost.{line}"] = state.counts.n_lost.get(line, 0)
    if state.round_trip_ns is not None:
        found["round_trip_us"] = state.round_trip_ns / 1000
    host = state.host_clock
    if host is not None:
        found["drift_ppm"] = -1e6 * host.drift
        found["host_sigma_us"] = host.sigma_ns(host.last_ns) / 1000
        found["host_rms_us"] = host.rms_ns / 1000
    if state.pps is not None:
        found["pps_age_s"] = view.age_s(state.pps[1].steady_ns)
    for camera, exposure_us in sorted(state.exposure_us.items()):
        found[f"exposure_us.{camera}"] = exposure_us
    return found


def problems(view: BoardView) -> tuple[str, ...]:
    """Say what is wrong now, each a sentence with what to do."""
    silent_s = view.age_s(view.line_ns)
    if silent_s > STALLED_S:
        return (f"nothing from the board for {silent_s:.0f} s: check its cable and power, press its reset",)
    return (*_line_problems(view), *_board_problems(view), *_clock_problems(view), *_utc_problems(view))


def _line_problems(view: BoardView) -> list[str]:
    faults = view.reader.faults
    n_damaged = sum(faults.values()) - faults[LineFault.UNKNOWN] + view.state.counts.n_implausible
    n_lines = n_damaged + view.reader.n_messages
    found = []
    if n_damaged >= _MIN_DAMAGED and n_damaged > _DAMAGED * n_lines:
        found.append(
            f"{n_damaged} of {n_lines} lines damaged: check cable, ground and sync.baud, "
            "and that nothing else reads the port"
        )
    if view.n_unwritten:
        found.append(f"the board did not take {view.n_unwritten} commands: press its reset")
    return found


def _board_problems(view: BoardView) -> list[str]:
    state, counts = view.state, view.state.counts
    found = []
    if counts.reset_steady_ns is not None:
        ago_s = view.age_s(counts.reset_steady_ns)
        found.append(
            f"the board began anew {counts.n_resets} times, last {ago_s:.0f} s ago: check its power, "
            "and that no other program opens its port"
        )
    if state.error is not None:
        found.append(f"the board says: {state.error.text} (error {state.error.code})")
    for line in view.wants_triggers:
        if not counts.n_pulses.get(line) and view.age_s(view.opened_ns) > _NO_CLOCK_S:
            found.append(f"no pulses for {line}: check sync.triggers.{line}.channel and that triggers are on")
    n_lost = sum(counts.n_lost.values())
    if n_lost:
        lines = ", ".join(f"{line} {n}" for line, n in sorted(counts.n_lost.items()) if n)
        found.append(f"lines of {n_lost} pulses never came ({lines}): use a USB port of its own")
    if state.status is not None and state.status.n_lost:
        found.append(f"the board dropped {state.status.n_lost} lines: the computer read too slowly")
    return found


def _clock_problems(view: BoardView) -> list[str]:
    state = view.state
    found = []
    if view.reader.dialect.has_triggers and state.host_clock is None:
        if view.age_s(view.opened_ns) > _NO_CLOCK_S:
            found.append(
                "its clock is not tied to the computer's: it answers no time requests, sends no pulses"
            )
    elif view.reader.dialect.time_request(0) and state.round_trip_ns is None:
        found.append("it answers no time requests: its clock is tied by arrivals only, to about 1 ms")
    n_steps = len(state.host_tracker.steps)
    if n_steps:
        size_s = state.host_tracker.steps[-1].size_ns / NS_PER_S
        found.append(
            f"the computer's clock jumped {n_steps} times, last by {size_s:+.3f} s: "
            "let nothing set it while you collect (chrony slews, ntpdate jumps)"
        )
    return found


def _utc_problems(view: BoardView) -> list[str]:
    state = view.state
    if not view.reader.dialect.has_triggers:
        if state.utc is None or state.utc.utc_ns is None:
            return ["the receiver has no time yet: give its antenna a view of the sky"]
        return [] if state.utc.is_valid else ["the receiver does not vouch for its time (status V)"]
    if state.hello is None or not state.hello.version:
        return []
    if state.pps is None:
        has_waited = view.age_s(view.opened_ns) > _NO_CLOCK_S
        return ["no pulse per second: the LiDAR cannot be synchronised"] if has_waited else []
    found = []
    edge, arrival = state.pps
    if view.age_s(arrival.steady_ns) > _PPS_LATE_S:
        found.append(
            f"no pulse per second for {view.age_s(arrival.steady_ns):.0f} s: press the board's reset"
        )
    elif edge.utc_s is None:
        found.append("the board does not know UTC yet: the LiDAR's hour cannot be told")
    if state.status is not None and not state.status.flags & StatusFlag.PPS_ON:
        found.append("its output of pulses per second is off")
    if state.counts.n_lost.get(PPS_LINE):
        found.append("pulses per second were lost on the way to the computer; the LiDAR got them")
    return found
