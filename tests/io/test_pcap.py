"""Network recordings of many kinds give the same scans, or an error with the reason."""

import struct
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lce_rig.core.data import Scan
from lce_rig.core.errors import SourceError
from lce_rig.io.network import Datagram, PcapFile
from lce_rig.io.recording import SourceOptions
from lce_rig.io.velodyne_scans import PcapRecording
from tests.damage import damaged
from tests.notes import has_note
from tests.shared import changed

from .pcap_files import build_frame, write_datagrams
from .vlp16_room import NETWORK_NS, T0_NS, packets_of, room_scans

SENSOR = "192.168.1.201"
IP_AT = 14


def to_datagram(packet, source=SENSOR):
    return Datagram(packet.sent_ns + NETWORK_NS, source, packet.port, packet.payload)


@pytest.fixture(scope="module")
def datagrams():
    return [to_datagram(packet) for packet in packets_of(room_scans(3))]


@pytest.fixture(scope="module")
def frames(datagrams):
    """Arrival and Ethernet frame of each packet."""
    return [(datagram.host_ns, build_frame(datagram)) for datagram in datagrams]


def read(path, rig):
    recording = PcapRecording(path, rig, SourceOptions())
    return list(recording.samples()), recording.notes


def check_scans(scans):
    truth = room_scans(3)
    assert [len(scan.points) for scan in scans] == [len(scan.points) for scan in truth]
    for scan, true in zip(scans, truth, strict=True):
        assert abs(int(scan.stamp_ns or 0) - int(true.stamp_ns or 0)) <= 1000
        assert np.linalg.norm(scan.points - true.points, axis=1).max() < 2e-3


def write_pcap(path, frames, *, link=1, snaplen=65535):
    parts = [struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, snaplen, link)]
    for host_ns, frame in frames:
        seconds, ns = divmod(host_ns, 10**9)
        kept = frame[:snaplen]
        parts += [struct.pack("<IIII", seconds, ns // 1000, len(kept), len(frame)), kept]
    path.write_bytes(b"".join(parts))
    return path


def block(kind, body):
    body += bytes(-len(body) % 4)
    length = 12 + len(body)
    return struct.pack("<II", kind, length) + body + struct.pack("<I", length)


def write_pcapng(path, frames):
    """A card whose stamps are in units of 2**-20 s."""
    resolution = struct.pack("<HHB3x", 9, 1, 0x80 | 20) + struct.pack("<HH", 0, 0)
    parts = [
        block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)),
        block(1, struct.pack("<HHI", 1, 0, 0) + resolution),
        block(0x0BAD, b"custom"),
    ]
    for host_ns, frame in frames:
        ticks = (host_ns << 20) // 10**9
        head = struct.pack("<IIIII", 0, ticks >> 32, ticks & 0xFFFFFFFF, len(frame), len(frame))
        parts.append(block(6, head + frame))
    path.write_bytes(b"".join(parts))
    return path


ETHERNET_TYPE = b"\x08\x00"
LINKS: dict[str, tuple[int, Callable[[bytes], bytes]]] = {
    "ethernet": (1, lambda f: f),
    "VLAN": (1, lambda f: f[:12] + b"\x81\x00\x00\x07" + f[12:]),
    "SLL": (113, lambda f: bytes(14) + ETHERNET_TYPE + f[IP_AT:]),
    "SLL2": (276, lambda f: ETHERNET_TYPE + bytes(18) + f[IP_AT:]),
    "raw": (101, lambda f: f[IP_AT:]),
    "BSD loopback": (0, lambda f: struct.pack("<I", 2) + f[IP_AT:]),
    "OpenBSD loopback": (108, lambda f: struct.pack(">I", 2) + f[IP_AT:]),
    "raw IPv4": (228, lambda f: f[IP_AT:]),
}


@pytest.mark.parametrize("name", sorted(LINKS))
def test_every_link_type_gives_the_same_scans(name, frames, rig, tmp_path):
    link, wrap = LINKS[name]
    path = write_pcap(tmp_path / "a.pcap", [(ns, wrap(frame)) for ns, frame in frames], link=link)
    check_scans(read(path, rig)[0])


def test_pcapng_is_read(frames, rig, tmp_path):
    check_scans(read(write_pcapng(tmp_path / "a.pcapng", frames), rig)[0])


def test_pcap_datagrams_are_read_back(datagrams, tmp_path):
    path = tmp_path / "a.pcap"
    write_datagrams(path, datagrams)
    back = list(PcapFile(path).datagrams())
    assert [vars(datagram) for datagram in back] == [vars(datagram) for datagram in datagrams]


def test_pcap_notes_state_sensor_and_clock(frames, rig, tmp_path):
    lossy = frames[:100] + frames[110:]
    n_lost = sum(len(frame) > 1206 for _, frame in frames[100:110])  # the others are of the LiDAR's state
    _, notes = read(write_pcap(tmp_path / "a.pcap", lossy), rig)
    assert has_note(notes, "vertical offsets") and has_note(notes, "UTC", "PPS")
    assert 0 < n_lost <= 10 and has_note(notes, f"{n_lost} data packets", "lost")


def test_pcap_torn_file_is_read_to_the_tear(frames, rig, tmp_path):
    whole = write_pcap(tmp_path / "a.pcap", frames).read_bytes()
    torn = tmp_path / "torn.pcap"
    for end, note in ((len(whole) - 1, "cut short"), (len(whole) - 1255, "read up to byte")):
        torn.write_bytes(whole[:end])
        scans, notes = read(torn, rig)
        assert len(scans) >= 2
        assert has_note(notes, note)


@pytest.mark.parametrize("suffix", ["pcap", "pcapng"])
@settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=st.data())
def test_pcap_damaged_gives_source_error(suffix, frames, rig, tmp_path, data):
    """Any beginning and any flipped byte: scans or a SourceError."""
    path = tmp_path / f"a.{suffix}"
    whole = (write_pcap if suffix == "pcap" else write_pcapng)(path, frames[:90]).read_bytes()
    path.write_bytes(data.draw(damaged(whole)))
    try:
        assert all(isinstance(scan, Scan) for scan in read(path, rig)[0])
    except SourceError as error:
        assert path.name in error.what


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"some text, longer than a header of pcap\n",
        b"\x1f\x8b" + bytes(40),
        struct.pack("<IHH", 0xA1B2C3D4, 2, 4),
        struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1),
        struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 127),
        block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
        + block(1, struct.pack("<HHI", 105, 0, 0)),
    ],
    ids=["empty", "text", "packed", "torn header", "no frames", "wireless", "pcapng of a wireless card"],
)
def test_pcap_of_other_link_types_is_refused(content, rig, tmp_path):
    path = tmp_path / "a.pcap"
    path.write_bytes(content)
    with pytest.raises(SourceError, match=path.name):
        read(path, rig)


def test_pcap_uses_the_profiles_sensor(datagrams, rig, tmp_path):
    both = [
        (d.host_ns, build_frame(Datagram(d.host_ns, source, d.port, d.payload)))
        for d in datagrams
        for source in (SENSOR, "192.168.1.77")
    ]
    path = write_pcap(tmp_path / "a.pcap", both)
    check_scans(read(path, rig)[0])
    with pytest.raises(SourceError) as caught:
        read(path, changed(rig, lidars__lidar__driver__address="192.168.1.9"))
    assert all(address in caught.value.what for address in (SENSOR, "192.168.1.77"))


def test_pcap_no_revolution_is_an_error(frames, rig, tmp_path):
    """No packets of the sensor, cut packets, or less than one revolution."""
    with pytest.raises(SourceError, match="243"):
        read(write_pcap(tmp_path / "a.pcap", frames, snaplen=96), rig)
    mdns = build_frame(Datagram(T0_NS, "10.0.0.1", 5353, b"mdns"))
    for others in ([(T0_NS, mdns)] * 3, frames[:40]):
        with pytest.raises(SourceError):
            read(write_pcap(tmp_path / "a.pcap", others), rig)
