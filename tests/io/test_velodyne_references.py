"""Packets recorded by others give the points of their references."""

from pathlib import Path

import numpy as np
import pytest
from wire.vlp16_packets import STREAMED_VLP16

from lce_rig.core import velodyne
from lce_rig.core.errors import SourceError
from lce_rig.io import open_recording
from lce_rig.io.folder.decoding import read_cloud
from lce_rig.io.network import PcapFile
from lce_rig.io.protocol import SourceOptions
from lce_rig.io.ros.bag_file import BagFile
from lce_rig.io.ros.messages import deserialize
from lce_rig.io.velodyne.pcap import PcapRecording
from lce_rig.io.velodyne.stream import Vlp16Decoder, keep_brighter
from lce_rig.rig import Rig

from .vlp16_room import (
    decode_by_manual,
    stamps,
    stream_of,
)


def einride(recordings: Path) -> np.ndarray:
    return np.fromfile(recordings / "vlp16_packets" / "einride" / "recording.bin", velodyne.DATA_PACKET)


@pytest.mark.dataset
def test_the_einride_payloads_make_whole_scans_without_a_loss(recordings: Path) -> None:
    stream = stream_of()
    fields = einride(recordings)
    scans = [scan for packet in fields if (scan := stream.push_data(packet.tobytes(), 0)) is not None]
    assert (len(scans), stream.losses.n("packet.lost"), stream.flaws()) == (13, 0, [])


def nebula_packets(recordings: Path) -> list[tuple[int, bytes]]:
    bag = BagFile(recordings / "vlp16_packets" / "nebula" / "vlp16" / "1673400471837873222")
    messages = [deserialize(message) for message in bag.messages({"/velodyne_packets"})]
    return [
        (p.stamp.sec * 10**9 + p.stamp.nanosec, bytes(p.data))
        for message in messages
        for p in message.packets
    ]


def mrpt_packets(recordings: Path) -> bytes:
    file = PcapFile(recordings / "vlp16_packets" / "mrpt" / "sample_velodyne_vlp16_gps.pcap")
    return b"".join(d.payload for d in file.datagrams() if d.port == velodyne.DATA_PORT)


@pytest.mark.dataset
@pytest.mark.parametrize("name", ["einride", "nebula", "mrpt"])
def test_every_point_of_a_recording_is_that_of_the_manual(recordings: Path, name: str) -> None:
    payloads = {
        "einride": lambda: einride(recordings).tobytes(),
        "nebula": lambda: b"".join(payload for _, payload in nebula_packets(recordings)),
        "mrpt": lambda: mrpt_packets(recordings),
    }[name]()
    fields = np.frombuffer(payloads, velodyne.DATA_PACKET).copy()
    if name == "nebula":
        keep_brighter(fields)
    points, *_ = Vlp16Decoder(0.0, 200.0).decode(fields, [1000 * int(us) for us in fields["us"]])
    manual = decode_by_manual(fields)
    order = np.argsort(manual["packet"] * 10**7 + manual["time_ns"], kind="stable")
    assert len(points) == len(order) == np.count_nonzero(fields["blocks"]["returns"]["range"])
    off = np.linalg.norm(points - manual["points"][order], axis=1) / manual["range_m"][order]
    assert off.max() < 4.5e-4  # 0.025 deg


@pytest.mark.dataset
def test_every_point_of_nebulas_reference_cloud_is_that_of_the_manual(recordings: Path) -> None:
    reference = read_cloud(recordings / "vlp16_packets" / "nebula" / "vlp16" / "1673400472138016708.pcd")
    fields = np.frombuffer(b"".join(p for _, p in nebula_packets(recordings)), velodyne.DATA_PACKET)[-170:]
    manual = decode_by_manual(fields)
    ring = np.argsort(np.argsort(STREAMED_VLP16.elevations_rad))[manual["laser"]]
    # Of a packet's last firings nebula leaves the azimuth as it was at the block's beginning.
    is_last = manual["time_ns"] >= 5 * velodyne.BLOCK_NS
    block_deg = fields["blocks"]["azimuth"][manual["packet"][is_last], 10] / 100
    azimuth_deg = manual["azimuth_deg"].copy()
    azimuth_deg[is_last] = block_deg
    counts = np.rint(manual["range_m"] / velodyne.RANGE_STEP_M)
    # Nebula leaves the vertical offsets out, too.
    reach = np.sqrt(sum(reference[axis].astype(float) ** 2 for axis in "xyz"))
    assert np.abs(reach - reference["distance"]).max() < 1e-5
    seen_deg = np.degrees(np.arctan2(-reference["y"], reference["x"]))
    off_deg = []
    for channel, count, seen in zip(
        reference["channel"], np.rint(reach / velodyne.RANGE_STEP_M), seen_deg, strict=True
    ):
        candidates = azimuth_deg[(ring == channel) & (counts == count)]
        off_deg.append(np.abs((candidates - seen + 180) % 360 - 180).min())
    assert len(off_deg) == 14_831
    # Where two returns differ, nebula turns the strongest on by up to a block, with the last of a packet.
    is_off = np.array(off_deg) > 0.011
    assert is_off.sum() == 166
    assert max(off_deg) < 0.41


@pytest.mark.dataset
def test_nebulas_recording_was_not_synchronised_and_is_stamped_by_arrival(recordings: Path) -> None:
    stream = stream_of()
    sent = nebula_packets(recordings)
    scans = [scan for host_ns, body in sent if (scan := stream.push_data(body, host_ns)) is not None]
    assert stream.mode == velodyne.DUAL and len(scans) == 3
    assert not stream.clock.is_utc
    ahead_ns = stream.clock.ahead_ns()
    assert ahead_ns is not None and ahead_ns * 1e-9 == pytest.approx(-1531.18, abs=0.01)
    assert all(sent[0][0] < int(stamp_ns or 0) < sent[-1][0] for stamp_ns in stamps(scans))


@pytest.mark.dataset
def test_mrpts_recording_gives_its_scans_with_the_clock_in_doubt(recordings: Path, rig: Rig) -> None:
    path = recordings / "vlp16_packets" / "mrpt" / "sample_velodyne_vlp16_gps.pcap"
    recording = PcapRecording(path, rig, SourceOptions())
    scans = list(recording.samples())
    assert len(scans) == 3
    assert [len(scan.points) for scan in scans] == pytest.approx([18_550] * 3, abs=50)
    text = "\n".join(recording.notes)
    # PPS is locked and the sentences fit, but the recorder's clock was a third of a second off.
    assert "by arrival" in text and "-0.37 s" in text and "lost" not in text


@pytest.mark.dataset
def test_mrpts_hdl32_is_refused_by_name(recordings: Path, rig: Rig) -> None:
    with pytest.raises(SourceError, match="500 of HDL-32E"):
        open_recording(recordings / "vlp16_packets" / "mrpt" / "sample_velodyne_hdl32.pcap", rig)
