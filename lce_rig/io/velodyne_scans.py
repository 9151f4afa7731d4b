"""Convert a stream of Velodyne packets, live or recorded, to scans of one revolution each.

velodyne-decoder computes the points. Two of its choices matter: it adds the vertical offsets of the lasers
(up to 11 mm, which ROS 1 drivers omit), and between two azimuths takes the rotor's mean speed over the
packet, where drivers interpolate block by block (up to 0.025 deg apart). Its StreamDecoder is not used: it
cuts revolutions at packets, returns partial ones, and keeps both returns of a firing.
"""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import velodyne
from lce_rig.core.data import Scan, Stream
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding, Losses
from lce_rig.io import findings
from lce_rig.io.network import FRAME_BYTES, MIN_COVERAGE, Datagram, PcapFile
from lce_rig.io.recording import SourceOptions, choose_lidar, fingerprint, follows
from lce_rig.io.velodyne_packets import (
    BadPacketError,
    DataPacket,
    VelodyneClock,
    read_data_packet,
    read_position_packet,
)
from lce_rig.rig import LidarSettings, Rig

#: Note on recordings, as those of another driver may omit the lasers' vertical offsets.
OFFSETS_NOTE = "points include the lasers' vertical offsets (VLP-16: up to 11 mm), which ROS 1 drivers omit"
DUAL_NOTE = "dual returns: the brighter return of each firing is kept"
_CONTROLS = ("position_port", "cut_deg")
_MODELS = {"VLP-16": "VLP16", "Puck Hi-Res": "PuckHiRes", "HDL-32E": "HDL32E", "VLP-32C": "VLP32C"}
# Number of packets ahead that are accepted without the host's clock; above it, both clocks must agree.
_MAX_BLIND = 4
_MAX_DISAGREEMENT_NS = 20_000_000


def read_controls(sensor: str, settings: LidarSettings) -> tuple[int, float]:
    """Read the `driver.controls` of a Velodyne.

    Args:
        sensor: the LiDAR's name in the profile, for messages.
        settings: its block of the profile.

    Returns:
        The UDP port of position packets (`position_port`), and the direction of the seam between two scans
        (`cut_deg`), rad from the lidar frame's x axis towards y; by default behind the sensor, out of the
        cameras' view.

    Raises:
        SourceError: a key is unknown, or its value is out of range.
    """
    controls = settings.driver.controls
    where = f"lidars.{sensor}.driver.controls"
    unknown = sorted(set(controls) - set(_CONTROLS))
    if unknown:
        raise SourceError(f"{where}: a VLP-16 has no {unknown[0]!r}; it has {', '.join(_CONTROLS)}")
    port = controls.get("position_port", velodyne.POSITION_PORT)
    if not isinstance(port, int) or not 1 <= port <= 65535:
        raise SourceError(f"{where}.position_port is {port!r}, not a port from 1 to 65535")
    cut_deg = controls.get("cut_deg", 180.0)
    if isinstance(cut_deg, bool | str) or not -360 <= cut_deg <= 360:
        raise SourceError(f"{where}.cut_deg is {cut_deg!r}, not an angle from -360 to 360 degrees")
    return port, math.radians(cut_deg)


class _Piece(NamedTuple):
    """Blocks of one packet that belong to one revolution.

    Attributes:
        packet: the whole packet.
        elapsed_ns: reading of the counter at the packet's first firing.
        blocks: the slice of its blocks.
    """

    packet: DataPacket
    elapsed_ns: int
    blocks: slice


class Vlp16Stream:
    """Assembles the packets of one sensor into scans.

    Attributes:
        n_data, n_position: data and position packets that passed the checks.
        n_scans: revolutions returned.
        losses: packets and revolutions lost or skipped, and steps of the sensor's clock.
        product: the model whose packets are decoded.
        other_models: data packets of other models, by name.
        clock: clock of the timestamps.
        mode: return mode of the last packet, of velodyne.RETURN_MODES; 0 before the first.
        rotor_hz: last speed of the rotor; 0 before the first packet.

    Raises:
        SourceError: the model's packets are not supported, or `driver.controls` is not valid.
    """

    def __init__(self, sensor: str, settings: LidarSettings) -> None:
        self.n_data = self.n_position = self.n_scans = 0
        self.losses = Losses()
        self.other_models: Counter[str] = Counter()
        self.clock = VelodyneClock(settings.timestamps.clock != "host")
        self.mode = 0
        self.rotor_hz = 0.0
        product = velodyne.product_of(settings.model)
        if product is None:
            read = ", ".join(model.name for model in velodyne.READ)
            raise SourceError(
                f"lidars.{sensor}.model: packets of {settings.model} are not supported", f"Supported: {read}."
            )
        self.product = product
        self._sensor = sensor
        # Time of the sensor's counter since the first packet, ns; hours are added, and steps excluded.
        self._elapsed_ns = 0
        self._last: DataPacket | None = None
        import velodyne_decoder  # type: ignore[import-untyped]

        self._library: Any = velodyne_decoder
        config = velodyne_decoder.Config(
            model=getattr(velodyne_decoder.Model, _MODELS[product.name]),
            min_range=settings.min_range_m,
            max_range=settings.max_range_m,
            timestamp_first_packet=True,
        )
        self._decoder = velodyne_decoder.ScanDecoder(config)
        # The sensor counts clockwise.
        _, cut_rad = read_controls(sensor, settings)
        self._cut = round(-cut_rad / velodyne.AZIMUTH_STEP_RAD) % velodyne.AZIMUTH_STEPS
        self._pieces: list[_Piece] = []
        self._is_from_cut = False
        self._last_stamp_ns: int | None = None

    def flaws(self) -> list[Finding]:
        """List the packets that are damaged or another model's."""
        kinds = {findings.DAMAGED.code, findings.OTHER_MODEL.code}
        return [loss for loss in self.losses.findings() if loss.code in kinds]

    def push_position(self, payload: bytes | memoryview) -> None:
        """Decode a position packet; a bad one is counted."""
        try:
            self.clock.position = read_position_packet(payload)
        except BadPacketError as error:
            self.losses.add(findings.DAMAGED(where=f"position packet: {error}"))
            return
        self.n_position += 1

    def push_data(self, payload: bytes | memoryview, host_ns: int) -> Scan | None:
        """Decode a data packet; return the scan that it completes. A bad one is counted.

        Args:
            payload: payload of the UDP packet.
            host_ns: its arrival; 0 where unknown.
        """
        try:
            packet = read_data_packet(payload, host_ns, self.product)
        except BadPacketError as error:
            kind = findings.OTHER_MODEL if error.model else findings.DAMAGED
            self.losses.add(kind(where=f"data packet: {error}"))
            self.other_models.update([error.model] if error.model else [])
            return None
        place = self._place(packet)
        if place == "late":
            return None
        self.n_data += 1
        if place == "after a step":
            # The rest of the revolution is counted when the rotor passes the cut.
            self._pieces, self._is_from_cut = [], False
            self.clock.restart()
        self.mode, self.rotor_hz = packet.mode, packet.steps_per_ns * 1e9 / velodyne.AZIMUTH_STEPS
        self.clock.see_data(packet, self._elapsed_ns)
        return self._add(packet)

    def finish(self) -> Scan | None:
        """End the stream; return the last scan if only its closing packet is missing."""
        if not self._pieces:
            return None
        packet = self._pieces[-1].packet
        to_go = velodyne.AZIMUTH_STEPS - (int(packet.azimuth[-1]) - self._cut) % velodyne.AZIMUTH_STEPS
        if to_go <= 2 * packet.steps_per_ns * self.product.block_ns:
            return self._close()
        self._pieces, self._is_from_cut = [], False
        self.losses.add(findings.SCAN_PARTIAL())
        return None

    def _place(self, packet: DataPacket) -> Literal["next", "late", "after a step"]:
        """Compare the sensor's counter with the host's clock since the previous packet.

        Returns:
            "late" for a packet to skip, which was sent before an arrived one, or twice;
            "after a step" if the sensor's clock (as when it locks to a pulse) or its return mode was set.
        """
        last, self._last = self._last, packet
        if last is None:
            return "next"
        # Shortest difference, modulo one hour.
        half_us = velodyne.HOUR_US // 2
        step_ns = 1000 * ((packet.us - last.us + half_us) % velodyne.HOUR_US - half_us)
        n_ahead = round(step_ns / packet.packet_ns)
        is_host_known = bool(last.host_ns and packet.host_ns)
        off_ns = packet.host_ns - last.host_ns - step_ns if is_host_known else 0
        do_agree = abs(off_ns) <= _MAX_DISAGREEMENT_NS
        if packet.mode == last.mode and n_ahead > 0 and (n_ahead <= _MAX_BLIND or do_agree):
            self.losses.add(findings.LOST(), n_ahead - 1)
            self._elapsed_ns += step_ns
            return "next"
        if n_ahead <= 0 and step_ns > -_MAX_DISAGREEMENT_NS and do_agree:
            self._last = last
            self.losses.add(findings.LATE())
            return "late"
        self.losses.add(findings.CLOCK_SET())
        return "after a step"

    def _add(self, packet: DataPacket) -> Scan | None:
        """Add a packet to its revolution, or to two if the rotor passes the cut within it."""
        past_cut = (packet.azimuth - self._cut) % velodyne.AZIMUTH_STEPS
        scan = None
        if self._pieces:
            last = self._pieces[-1]
            before = (int(last.packet.azimuth[-1]) - self._cut) % velodyne.AZIMUTH_STEPS
            turned = packet.steps_per_ns * (self._elapsed_ns - last.elapsed_ns)
            if past_cut[0] < before or turned > velodyne.AZIMUTH_STEPS:  # passed between the two packets
                scan = self._close()
                self._is_from_cut = True
        else:
            self._is_from_cut = bool(past_cut[0] <= packet.steps_per_ns * self.product.block_ns)
        drops = np.flatnonzero(np.diff(past_cut) < 0)
        if len(drops) == 0:
            self._pieces.append(_Piece(packet, self._elapsed_ns, slice(0, velodyne.N_BLOCKS)))
            return scan
        first_after = int(drops[0]) + 1
        self._pieces.append(_Piece(packet, self._elapsed_ns, slice(0, first_after)))
        closed = self._close()
        self._is_from_cut = True
        self._pieces = [_Piece(packet, self._elapsed_ns, slice(first_after, velodyne.N_BLOCKS))]
        return closed or scan

    def _close(self) -> Scan | None:
        """Build the scan of the revolution that has ended."""
        pieces, self._pieces = self._pieces, []
        if not self._is_from_cut:
            self.losses.add(findings.SCAN_PARTIAL())
            return None
        n_blocks = sum(piece.blocks.stop - piece.blocks.start for piece in pieces)
        packet = pieces[-1].packet
        n_turn = velodyne.AZIMUTH_STEPS / (packet.steps_per_ns * self.product.block_ns)
        if n_blocks < MIN_COVERAGE * n_turn * (1 + packet.is_dual):
            self.losses.add(findings.SCAN_THIN())
            return None
        packets = np.array([piece.packet.fields for piece in pieces], velodyne.DATA_PACKET)
        for piece, ranges in zip(pieces, packets["blocks"]["returns"]["range"], strict=True):
            ranges[: piece.blocks.start] = 0
            ranges[piece.blocks.stop :] = 0
        first = pieces[0]
        if first.packet.is_dual:
            keep_brighter(packets)
        points, intensity, ring, offset_ns = self._decode(packets, [p.elapsed_ns for p in pieces])
        if len(points) == 0:
            self.losses.add(findings.SCAN_THIN())
            return None
        n_before = first.blocks.start // (2 if first.packet.is_dual else 1)
        lead_ns = self.product.block_ns * n_before
        # Timestamps by arrival and by the sensor may differ by 0.1 s when one takes over from the other.
        stamp_ns = self.clock.stamp_ns(first.elapsed_ns + lead_ns)
        if not follows(stamp_ns, self._last_stamp_ns, self.losses):
            return None
        self._last_stamp_ns = self._last_stamp_ns if stamp_ns is None else stamp_ns
        self.n_scans += 1
        host_ns = packet.host_ns or None
        return Scan(self._sensor, stamp_ns, points, intensity, ring, offset_ns - lead_ns, host_ns)

    def _decode(
        self, packets: NDArray[np.void], start_ns: Sequence[int]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int16], NDArray[np.int64]]:
        """Decode packets of one return mode.

        Args:
            packets: (P,) of velodyne.DATA_PACKET; ranges of 0 give no point.
            start_ns: (P,) time of each one's first firing, rising.

        Returns:
            Of the points in the order of firing: (N, 3) float32 m in frame lidar; (N,) float32 reflectivity,
            0 to 255; (N,) int16 ring, 0 = lowest; (N,) int64 ns after the first packet's first firing.
        """
        # The library completes the hour from the host's time, so a clock that agrees past the hour is enough.
        zero_s = 3600.0 + int(packets["us"][0]) * 1e-6
        vector = self._library.PacketVector()
        for packet, at_ns in zip(packets, start_ns, strict=True):
            stamp_s = zero_s + (at_ns - start_ns[0]) * 1e-9
            vector.append(self._library.VelodynePacket(stamp_s, packet.tobytes()))
        _, cloud = self._decoder.decode(vector, True)
        points = np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=1).astype(np.float32, copy=False)
        offset_ns = np.rint(cloud["time"].astype(np.float64) * 1e9).astype(np.int64)
        return points, cloud["intensity"].astype(np.float32), cloud["ring"].astype(np.int16), offset_ns


def keep_brighter(packets: NDArray[np.void]) -> None:
    """Blank the weaker of two returns in dual-mode packets (P,), or the last of two equal ones.

    At the board's border, board and wall may both return one pulse; in its strongest mode, the sensor reports
    the brighter return.
    """
    returns = packets["blocks"]["returns"]
    last, strongest = returns[:, 0::2], returns[:, 1::2]
    is_last_kept = (last["range"] > 0) & (
        (strongest["range"] == 0) | (last["reflectivity"] > strongest["reflectivity"])
    )
    strongest["range"][is_last_kept] = 0
    last["range"][~is_last_kept] = 0


class PcapRecording:
    """The scans of one Velodyne in a pcap or pcapng file.

    Attributes:
        path: the file.
        notes: after reading, the losses.
        key: fingerprint of the file.
        n_samples: number of scans to come, estimated from the file's size.
        streams: the LiDAR's scans.
    """

    def __init__(self, path: Path, rig: Rig, options: SourceOptions) -> None:
        """Find the sensor's packets.

        Raises:
            SourceError: the file is not a network recording, or has no packets of the profile's model, or
                packets of several sensors of which none has the profile's address.
        """
        self.path = path
        self.notes: list[str] = []
        self._file = PcapFile(path)
        self._lidar = choose_lidar(rig, options, self.notes)
        self._settings: LidarSettings = rig.lidars[self._lidar]
        self._product = Vlp16Stream(self._lidar, self._settings).product
        driver = self._settings.driver
        self._address, _ = self._file.choose_sender(self._explain, self._product.name, self._lidar, driver)
        self.key = fingerprint([path])
        self.streams = frozenset([Stream(self._lidar, "", "scans")])
        n_packets = path.stat().st_size // (velodyne.DATA_BYTES + FRAME_BYTES)
        sweep_s = n_packets * self._product.packet_ns(is_dual=False) * 1e-9
        self.n_samples = max(1, round(sweep_s * self._settings.rate_hz))

    def samples(self) -> Iterator[Scan]:
        """Yield the scans in order of time; damaged, late and lost packets are counted in `notes`.

        Raises:
            SourceError: not one whole revolution was recorded.
        """
        stream = Vlp16Stream(self._lidar, self._settings)
        try:
            for datagram in self._file.datagrams():
                if datagram.source != self._address:
                    continue
                if len(datagram.payload) == velodyne.POSITION_BYTES:
                    stream.push_position(datagram.payload)
                elif len(datagram.payload) == velodyne.DATA_BYTES:
                    scan = stream.push_data(datagram.payload, datagram.host_ns)
                    if scan is not None:
                        yield scan
            last = stream.finish()
            if last is not None:
                yield last
        finally:
            lines = [OFFSETS_NOTE, *([DUAL_NOTE] if stream.mode == velodyne.DUAL else [])]
            lines += [stream.clock.state().text, *findings.worded(stream.losses), *self._file.account()]
            notes = [f"{self.path.name}: {line}" for line in lines]
            self.notes += [note for note in notes if note not in self.notes]
        if stream.n_scans == 0:
            causes = (
                "; ".join(findings.worded(stream.losses))
                or f"{stream.n_data} packets are less than a revolution"
            )
            raise SourceError(f"{self.path}: no whole revolution in it: {causes}", "Record at least 1 s.")

    def _explain(self, datagram: Datagram) -> str:
        try:
            read_data_packet(datagram.payload, datagram.host_ns, self._product)
        except BadPacketError as error:
            return f"of {error.model}" if error.model else f"to port {datagram.port}"
        return ""
