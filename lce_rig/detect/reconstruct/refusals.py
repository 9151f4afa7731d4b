"""Why there is no picture at a stamp, with figures and what to do."""

from lce_rig.core.results import Refusal


def still_cold(n_steps: int, n_warm_up: int, seen_ns: int) -> Refusal:
    """Too little of the stream precedes the stamp for the network's state to have settled."""
    return Refusal(
        "read",
        f"{n_steps} windows of events ({seen_ns / 1e9:.2f} s) precede the picture, "
        f"the network needs {n_warm_up} to settle",
        "keep the board or the camera moving for a second before the first capture",
    )


def too_early(stamp_ns: int, first_ns: int) -> Refusal:
    """The stamp lies before the stream."""
    return Refusal(
        "read",
        f"the picture is asked for {(first_ns - stamp_ns) / 1e9:.3f} s before the first event",
        "check that both sensors' clocks agree, or start the event camera first",
    )


def too_late(stamp_ns: int, last_ns: int | None) -> Refusal:
    """The stamp lies after the stream, or there is no stream."""
    if last_ns is None:
        return Refusal("read", "the recording holds no events", "check the events' topic and the camera")
    return Refusal(
        "read",
        f"the picture is asked for {(stamp_ns - last_ns) / 1e9:.3f} s after the last event",
        "check that both sensors' clocks agree, or record events to the end",
    )
