"""Why there is no picture at a stamp."""

from lce_rig.core.results import Refusal


def still_cold(n_steps: int, n_warm_up: int, seen_ns: int) -> Refusal:
    """Too little of the stream precedes the stamp for the network's state to have settled."""
    figures = {"n_steps": n_steps, "n_warm_up": n_warm_up, "seen_s": 1e-9 * seen_ns}
    return Refusal("read.network_settling", figures=figures)


def too_early(stamp_ns: int, first_ns: int) -> Refusal:
    """The stamp lies before the stream."""
    return Refusal("read.before_events", figures={"gap_s": 1e-9 * (first_ns - stamp_ns)})


def too_late(stamp_ns: int, last_ns: int | None) -> Refusal:
    """The stamp lies after the stream, or there is no stream."""
    if last_ns is None:
        return Refusal("read.no_events")
    return Refusal("read.after_events", figures={"gap_s": 1e-9 * (stamp_ns - last_ns)})
