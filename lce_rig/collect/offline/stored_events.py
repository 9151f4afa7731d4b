"""What has to be said about the events that captures keep."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from lce_rig.detect.events.event_limits import look_for_flicker
from lce_rig.timing.event_buffer import BEFORE_NS, EventCut


@dataclass
class StoredEvents:
    """Keeps account of stored stretches of events that are short, or flicker."""

    _n_short: Counter[str] = field(default_factory=Counter)
    _shortest_ns: dict[str, int] = field(default_factory=dict)
    _lamps: Counter[tuple[str, str]] = field(default_factory=Counter)

    def note(self, cuts: Sequence[EventCut]) -> None:
        """Look at the events of one capture, of every camera."""
        for cut in cuts:
            if cut.missing_ns:
                before_ns = max(0, BEFORE_NS - cut.missing_ns)
                self._n_short[cut.sensor] += 1
                self._shortest_ns[cut.sensor] = min(before_ns, self._shortest_ns.get(cut.sensor, before_ns))
            lamps = look_for_flicker(cut.events)
            if lamps is not None:
                self._lamps[cut.sensor, lamps.sentence] += 1

    def notes(self) -> list[str]:
        """Say how many captures have less than 1.2 s of events before their scan, and which lamps flicker."""
        short = [
            f"{camera}: {n} captures with less than {BEFORE_NS * 1e-9:g} s of events before their scan "
            f"(at least {self._shortest_ns[camera] * 1e-9:.2f} s): start recording a second earlier"
            for camera, n in sorted(self._n_short.items())
        ]
        return short + [
            f"{camera}: {n} captures: {said}" for (camera, said), n in sorted(self._lamps.items())
        ]
