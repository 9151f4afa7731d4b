"""Phrases of drivers: devices, streams, clocks, and the pulses and edges that synchronise them."""

from collections.abc import Mapping

from lce_rig.core.findings import Finding
from lce_rig.words.rendering import Phrase


def _simulated_slowly(finding: Finding) -> str:
    """The simulation runs {factor} times slower than real time."""
    factor = f"{'more than' if finding.figures['is_more'] else 'about'} {finding.figures['factor']}"
    return f"simulated {factor} times slower than real time"


_SIMULATED: Mapping[str, Phrase] = {
    "clock.simulated": Phrase("simulated"),
    "stream.simulated_slowly": Phrase(
        _simulated_slowly, "expect low rates: this computer is too busy or too slow, no sensor is at fault"
    ),
}
PHRASES: Mapping[str, Phrase] = _SIMULATED
