"""Packets of every Velodyne that is read, and those that others recorded, become scans of their own beams."""

import numpy as np
import pytest

from lce_rig.core import velodyne
from lce_rig.core.data import Scan
from lce_rig.core.data_sheets import find_data_sheet
from lce_rig.core.errors import SourceError
from lce_rig.io import open_recording
from lce_rig.io.recording import SourceOptions
from lce_rig.io.ros.bag_file import BagFile
from lce_rig.io.ros.bag_recorder import open_bag_writer
from lce_rig.io.ros.messages import deserialize, typestore
from lce_rig.io.ros.rosbag import BagRecording
from lce_rig.io.velodyne_scans import PcapRecording, Vlp16Stream
from lce_rig.rig import LidarSettings, load_rig

from .vlp16_room import stamps, stream_of

RANGE_M, RATE_HZ, T0_US = 4.0, 10.0, 5_000_000


def write_packets(path, payloads, arrivals_ns):
    """Write VelodyneScans of 40 packets each, as the ROS drivers do; ROS 1 where the path ends in .bag."""
    is_ros1 = path.suffix == ".bag"
    store, name = typestore(is_ros1), "velodyne_msgs/msg/VelodyneScan"
    kinds = ("velodyne_msgs/msg/VelodynePacket", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    packet_type, header_type, time_type = (store.types[kind] for kind in kinds)
    serialize = store.serialize_ros1 if is_ros1 else store.serialize_cdr
    with open_bag_writer(path) as writer:
        topic = writer.add_connection("/velodyne_packets", name, typestore=store)
        for first in range(0, len(payloads), 40):
            some = slice(first, first + 40)
            stamps = [time_type(t // 10**9, t % 10**9) for t in arrivals_ns[some]]
            packets = [
                packet_type(t, np.frombuffer(p, np.uint8))
                for t, p in zip(stamps, payloads[some], strict=True)
            ]
            header = header_type(**({"seq": 0} if is_ros1 else {}), stamp=stamps[-1], frame_id="velodyne")
            message = serialize(store.types[name](header, packets), name)
            writer.write(topic, arrivals_ns[some][-1], message)
    return path


def packets_of(product, n_revolutions, step_m):
    """Packets of a sensor in the middle of a sphere."""
    n = int(n_revolutions / RATE_HZ * 1e9 / product.packet_ns(is_dual=False))
    fields = np.zeros(n, velodyne.DATA_PACKET)
    block = np.arange(n * velodyne.N_BLOCKS).reshape(n, -1)
    fields["blocks"]["flag"] = velodyne.BLOCK_FLAG
    turned = RATE_HZ * velodyne.AZIMUTH_STEPS * product.block_ns * 1e-9 * block
    fields["blocks"]["azimuth"] = (17_990 + np.rint(turned).astype(int)) % velodyne.AZIMUTH_STEPS
    fields["blocks"]["returns"]["range"] = round(RANGE_M / step_m)
    fields["blocks"]["returns"]["reflectivity"] = 50
    fields["us"] = T0_US + product.packet_ns(is_dual=False) * np.arange(n) // 1000
    fields["mode"], fields["product"] = velodyne.STRONGEST, product.code
    return [packet.tobytes() for packet in fields]


@pytest.mark.parametrize("product", velodyne.READ, ids=lambda product: product.name)
def test_scans_have_the_models_rings_and_times(product):
    sheet = find_data_sheet(product.name)
    assert sheet is not None
    stream = Vlp16Stream("lidar", LidarSettings(model=product.name))
    payloads = packets_of(product, 2.3, sheet.range_step_m)
    arrivals_ns = 10**18 + product.packet_ns(is_dual=False) * np.arange(1, len(payloads) + 1)
    pushed = [stream.push_data(payload, int(t)) for payload, t in zip(payloads, arrivals_ns, strict=True)]
    scans = [scan for scan in pushed if scan is not None]
    # The stream begins within a revolution.
    assert len(scans) == 2 and {each.code for each in stream.losses.findings()} <= {"scan.partial"}
    scan = scans[0]
    assert np.linalg.norm(scan.points, axis=1) == pytest.approx(RANGE_M, abs=0.03)
    flat_m = np.hypot(scan.points[:, 0], scan.points[:, 1])
    elevation = np.arctan2(scan.points[:, 2], flat_m)
    seen = np.array([np.median(elevation[scan.ring == ring]) for ring in range(sheet.n_rings)])
    # At 4 m, the laser's own height bends it by up to 0.3 deg.
    assert seen == pytest.approx(sheet.rings_rad, abs=0.006)
    n_per_ring = np.bincount(scan.ring)
    assert n_per_ring == pytest.approx(2 * np.pi / sheet.step_rad(RATE_HZ), abs=2)
    assert 0 <= scan.offset_ns.min() < 60_000 and scan.offset_ns.max() == pytest.approx(0.1e9, abs=200_000)


def test_a_model_without_packets_is_named():
    with pytest.raises(SourceError) as caught:
        Vlp16Stream("lidar", LidarSettings(model="OS1-64"))
    assert "HDL-32E" in caught.value.hint


@pytest.mark.parametrize("name", ["packets.bag", "packets"])
def test_velodyne_bag_scans_equal_pcap(tmp_path, rig, name):
    product = velodyne.READ[0]
    payloads = packets_of(product, 2.3, 0.002)
    arrivals_ns = [10**18 + product.packet_ns(is_dual=False) * (k + 1) for k in range(len(payloads))]
    stream = Vlp16Stream("lidar", rig.lidars["lidar"])
    pushed = [stream.push_data(payload, t) for payload, t in zip(payloads, arrivals_ns, strict=True)]
    bag = write_packets(tmp_path / name, payloads, arrivals_ns)
    recording = open_recording(bag, rig, SourceOptions(topics={"lidar": "/velodyne_packets"}, is_part=True))
    scans = list(recording.samples())
    wanted = [scan for scan in pushed if scan is not None]
    assert len(scans) == len(wanted) == 2
    for scan, other in zip(scans, wanted, strict=True):
        assert isinstance(scan, Scan) and scan.stamp_ns == other.stamp_ns
        np.testing.assert_array_equal(scan.points, other.points)
    assert any("vertical offsets" in note for note in recording.notes)


def test_velodyne_bag_other_model_is_named(tmp_path, rig):
    payloads = packets_of(velodyne.product_of("HDL-32E") or velodyne.READ[0], 0.2, 0.002)
    bag = write_packets(tmp_path / "packets", payloads, [10**18 + k for k in range(len(payloads))])
    recording = open_recording(bag, rig, SourceOptions(topics={"lidar": "/velodyne_packets"}, is_part=True))
    assert isinstance(recording, BagRecording)
    with pytest.raises(SourceError) as caught:
        list(recording.samples())
    assert "HDL-32E" in str(caught.value)


@pytest.mark.dataset
def test_a_recorded_hdl32e_is_read(recordings):
    path = recordings / "vlp16_packets" / "mrpt" / "sample_velodyne_hdl32.pcap"
    recording = open_recording(path, load_rig("hdl32e"), SourceOptions(is_part=True))
    (scan,) = recording.samples()
    elevation = np.degrees(np.arctan2(scan.points[:, 2], np.hypot(scan.points[:, 0], scan.points[:, 1])))
    top = np.median(elevation[scan.ring == 31])
    assert len(scan.points) > 50_000 and top == pytest.approx(10.67, abs=0.3)


def einride(recordings):
    return np.fromfile(recordings / "vlp16_packets" / "einride" / "recording.bin", velodyne.DATA_PACKET)


@pytest.mark.dataset
def test_einride_payloads_lose_no_packet(recordings):
    stream = stream_of()
    fields = einride(recordings)
    scans = [scan for packet in fields if (scan := stream.push_data(packet.tobytes(), 0)) is not None]
    assert (len(scans), stream.losses.n("packet.lost"), stream.flaws()) == (13, 0, [])


def nebula_packets(recordings):
    bag = BagFile(recordings / "vlp16_packets" / "nebula" / "vlp16" / "1673400471837873222")
    messages = [deserialize(message) for message in bag.messages({"/velodyne_packets"})]
    return [
        (p.stamp.sec * 10**9 + p.stamp.nanosec, bytes(p.data))
        for message in messages
        for p in message.packets
    ]


@pytest.mark.dataset
def test_nebula_recording_uses_arrival(recordings):
    stream = stream_of()
    sent = nebula_packets(recordings)
    scans = [scan for host_ns, body in sent if (scan := stream.push_data(body, host_ns)) is not None]
    assert stream.mode == velodyne.DUAL and len(scans) == 3
    assert not stream.clock.is_utc
    ahead_ns = stream.clock.ahead_ns()
    assert ahead_ns is not None and ahead_ns * 1e-9 == pytest.approx(-1531.18, abs=0.01)
    assert all(sent[0][0] < int(stamp_ns or 0) < sent[-1][0] for stamp_ns in stamps(scans))


@pytest.mark.dataset
def test_mrpt_recording_clock_is_in_doubt(recordings, rig):
    path = recordings / "vlp16_packets" / "mrpt" / "sample_velodyne_vlp16_gps.pcap"
    recording = PcapRecording(path, rig, SourceOptions())
    scans = list(recording.samples())
    assert len(scans) == 3
    assert [len(scan.points) for scan in scans] == pytest.approx([18_550] * 3, abs=50)
    text = "\n".join(recording.notes)
    # PPS is locked and the sentences fit, but the recorder's clock was a third of a second off.
    assert "by arrival" in text and "-0.37 s" in text and "lost" not in text


@pytest.mark.dataset
def test_mrpts_hdl32_is_refused_by_name(recordings, rig):
    with pytest.raises(SourceError, match="HDL-32E"):
        open_recording(recordings / "vlp16_packets" / "mrpt" / "sample_velodyne_hdl32.pcap", rig)
