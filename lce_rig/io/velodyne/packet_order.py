"""The order of data packets by the sensor's own counter: losses, latecomers, damaged times, set clocks."""

from enum import Enum

from lce_rig.core import velodyne
from lce_rig.core.findings import Finding
from lce_rig.core.losses import Losses
from lce_rig.io.velodyne.packet import DataPacket, max_uneven_steps

# A packet's time is right within this of the grid of firings; a disciplined counter moves by microseconds.
_GRID_NS = 100_000
# So many packets ahead are believed whatever the host's clock says; beyond, both clocks must agree.
_MAX_BLIND = 4
_MAX_DISAGREEMENT_NS = 20_000_000
# Over less than a revolution the rotor's speed, averaged over some packets, tells where the next begins.
_MAX_OFF_SHARE = 0.01
_SPEED_WEIGHT = 0.1
_LOST, _LATE = Finding("packet.lost", "warning"), Finding("packet.late", "warning")
_ASTRAY, _CLOCK_SET = Finding("packet.astray", "warning"), Finding("packet.clock_set", "note")


class Place(Enum):
    """The position of a packet."""

    NEXT = "next"
    HELD = "held back"
    AFTER_STEP = "after a step of the sensor's clock"


class PacketOrder:
    """Follows the counter from packet to packet.

    Args:
        losses: receives packets that never arrived, came late or went astray, and steps of the clock.

    Attributes:
        elapsed_ns: of the counter since the first packet; hours are counted on, and steps excluded.
    """

    def __init__(self, losses: Losses) -> None:
        self._losses = losses
        self.elapsed_ns = 0
        self._last: DataPacket | None = None
        self._held: DataPacket | None = None
        self._steps_per_ns = 0.0

    def place(self, packet: DataPacket) -> Place:
        """Say where the next packet that arrived belongs; HELD packets are to be skipped.

        A packet that goes astray is damaged, unless the next one continues from there: then the sensor's
            clock
        was set, as it is when it locks to a pulse.
        """
        if self._last is None:
            return self._accept(packet, 0, Place.NEXT)
        step_ns = _gap_ns(self._last, packet)
        n_ahead = self._packets_ahead(self._last, packet)
        if 1 <= n_ahead <= _MAX_BLIND or (n_ahead > _MAX_BLIND and _agrees(self._last, packet, step_ns)):
            self._drop_held()
            return self._accept(packet, step_ns, Place.NEXT)
        if -_MAX_DISAGREEMENT_NS < step_ns <= 0 and _agrees(self._last, packet, step_ns):
            self._losses.add(_LATE)
            return Place.HELD
        if self._held is not None and 1 <= self._packets_ahead(self._held, packet) <= _MAX_BLIND:
            # The packet held back was sound, but the revolution that it belongs to is broken anyway.
            self._held = None
            self._losses.add(_CLOCK_SET)
            return self._accept(packet, 0, Place.AFTER_STEP)
        self._drop_held()
        self._held = packet
        return Place.HELD

    def _accept(self, packet: DataPacket, step_ns: int, place: Place) -> Place:
        if step_ns:
            spacing_ns = packet.packet_ns
            self._losses.add(_LOST, round(step_ns / spacing_ns) - 1)
        weight = _SPEED_WEIGHT if step_ns else 1.0
        self._steps_per_ns += weight * (packet.steps_per_ns - self._steps_per_ns)
        self.elapsed_ns += step_ns
        self._last = packet
        return place

    def _drop_held(self) -> None:
        if self._held is not None:
            self._losses.add(_ASTRAY)
            self._held = None

    def _packets_ahead(self, before: DataPacket, after: DataPacket) -> int:
        """Count the packets from one to another; 0 where the second does not follow the first."""
        step_ns = _gap_ns(before, after)
        spacing_ns = after.packet_ns
        n_ahead = round(step_ns / spacing_ns)
        if before.mode != after.mode or n_ahead < 1:
            return 0
        # After a longer break neither the grid of firings nor the rotor is known well enough.
        if self._steps_per_ns * step_ns >= velodyne.AZIMUTH_STEPS:
            return n_ahead
        is_on_grid = abs(step_ns - n_ahead * spacing_ns) <= _GRID_NS
        return n_ahead if is_on_grid and self._has_turned(before, after, n_ahead * spacing_ns) else 0

    def _has_turned(self, before: DataPacket, after: DataPacket, step_ns: int) -> bool:
        """Return whether the rotor turned as it should from the one's last block to the other's first."""
        half = velodyne.AZIMUTH_STEPS // 2
        steps_per_block = self._steps_per_ns * after.product.block_ns
        expected = self._steps_per_ns * (step_ns - before.packet_ns) + steps_per_block
        turned = after.azimuth[0] - before.azimuth[-1]
        off = (turned - expected + half) % velodyne.AZIMUTH_STEPS - half
        allowed = max_uneven_steps(steps_per_block) + _MAX_OFF_SHARE * (expected - steps_per_block)
        return bool(abs(off) <= allowed)


def _gap_ns(before: DataPacket, after: DataPacket) -> int:
    """Give the shorter way from one counter reading to another around the hour."""
    half_us = velodyne.HOUR_US // 2
    return 1000 * ((after.us - before.us + half_us) % velodyne.HOUR_US - half_us)


def _agrees(before: DataPacket, after: DataPacket, step_ns: int) -> bool:
    """Return whether the host saw about the same time go by; it may not know."""
    if not before.host_ns or not after.host_ns:
        return True
    return abs(after.host_ns - before.host_ns - step_ns) <= _MAX_DISAGREEMENT_NS
