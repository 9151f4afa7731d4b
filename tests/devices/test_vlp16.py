"""A VLP-16 on a real socket: scans at full rate, and sentences for everything that goes wrong."""

import socket
import threading
import time
from contextlib import contextmanager
from itertools import islice

import numpy as np
import pytest
from wire.vlp16_packets import SensorPacket, free_ports

from lce_rig.core import velodyne
from lce_rig.core.data import Scan
from lce_rig.core.errors import SourceError
from lce_rig.devices.vlp16 import UdpPort, Vlp16Source
from lce_rig.rig.sensors import DriverSettings
from tests.devices.attached import attached
from tests.io.vlp16_room import PERIOD_NS, T0_NS, packets_of, room_scans, settings
from tests.shared import changed, wait_until

pytestmark = pytest.mark.realtime
HERE, ELSEWHERE = "127.0.0.1", "127.0.0.2"
PATIENT_S = 60.0


@pytest.fixture
def lidar():
    """A sensor at 127.0.0.1 on ports that nobody uses."""
    data, position = free_ports()
    driver = DriverSettings(port=data, address=HERE, controls={"position_port": position})
    return settings(driver=driver)


class Sender:
    """A thread that sends packets to a source once it has opened its ports, each when its time has come."""

    def __init__(self, lidar, source, address=HERE):
        self._ports = {
            velodyne.DATA_PORT: lidar.driver.port,
            velodyne.POSITION_PORT: int(lidar.driver.controls["position_port"]),
        }
        self._source = source
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((address, 0))
        self._stop = threading.Event()

    @contextmanager
    def sending(self, make_packets):
        """Send what is made for a time a little ahead."""
        thread = threading.Thread(target=self._run, args=(make_packets,))
        thread.start()
        try:
            yield
        finally:
            self._stop.set()
            thread.join()
            self._socket.close()

    def _run(self, make_packets):
        while self._source.status().n_packets is None:
            if self._stop.wait(0.005):
                return
        packets = self._make_in_time(make_packets)
        for n_sent, packet in enumerate(packets):
            # Sleeping is not exact: packets leave in small bursts, as a network card hands them on.
            while (ahead_s := (packet.sent_ns - time.time_ns()) * 1e-9) > 0.002:
                if self._stop.wait(min(ahead_s, 0.1)):
                    return
            # What is late is sent at once, but no faster than a port can take it.
            if n_sent % 50 == 49:
                time.sleep(0.001)
            self._socket.sendto(packet.payload, (HERE, self._ports[packet.port]))

    @staticmethod
    def _make_in_time(make_packets):
        """Make packets before they are due; a busy computer needs longer."""
        for ahead_ms in (200, 800, 3000):
            start_ns = (time.time_ns() + 1_000_000 * ahead_ms) // 1000 * 1000
            packets = make_packets(start_ns)
            if time.time_ns() < start_ns:
                break
        return packets


@contextmanager
def streaming(lidar, make_packets, **options):
    """An open source that packets come to, and its samples."""
    source = Vlp16Source("lidar", lidar, **{"silence_s": PATIENT_S, **options})
    with Sender(lidar, source).sending(make_packets), attached(source) as opened:
        yield opened


class Room:
    """Makes the packets of some revolutions, and keeps the scans they were made from."""

    def __init__(self, n, mode=velodyne.STRONGEST, clock=None):
        self.scans = []
        self._arguments = n, mode, clock

    def __call__(self, start_ns):
        n, mode, clock = self._arguments
        self.scans = room_scans(n, start_ns)
        return packets_of(self.scans, mode, clock)


def take(samples, n):
    return [sample for sample in islice(samples, n) if isinstance(sample, Scan)]


def stamps(scans):
    return np.array([scan.stamp_ns for scan in scans], np.int64)


# What comes


def test_vlp16_full_rate_loses_no_packet(lidar):
    room = Room(13)
    with streaming(lidar, room) as (source, samples):
        scans = take(samples, 12)
        status = source.status()
    assert np.abs(stamps(scans) - stamps(room.scans[:12])).max() <= 1000
    assert [len(scan.points) for scan in scans] == [len(scan.points) for scan in room.scans[:12]]
    assert (status.n_lost, status.n_dropped) == (0, 0) and (status.n_packets or 0) >= 900
    assert status.is_utc
    assert status.clock.code == "clock.lidar_utc" and HERE in status.device
    assert {problem.code for problem in status.problems} <= {"buffer.small"}
    for scan in scans:
        # The last packet of a scan ends after it; the sender is up to 2 ms early.
        assert int(scan.host_ns or 0) - int(scan.stamp_ns or 0) >= PERIOD_NS - 2_000_000


@pytest.mark.parametrize("address", [HERE, None])
def test_vlp16_other_addresses_are_ignored(lidar, address):
    room = Room(3)
    source = Vlp16Source("lidar", changed(lidar, driver__address=address), silence_s=PATIENT_S)
    stranger = Sender(lidar, source, ELSEWHERE)

    def make_later(start_ns):
        wait_until(lambda: HERE in source.status().device)
        return packets_of(room_scans(1))

    with stranger.sending(make_later), Sender(lidar, source).sending(room), attached(source) as (_, samples):
        scans = take(samples, 2)
    assert [len(scan.points) for scan in scans] == [len(scan.points) for scan in room.scans[:2]]


def test_vlp16_closed_source_can_reopen(lidar):
    source = Vlp16Source("lidar", lidar, silence_s=PATIENT_S)
    for _ in range(2):
        with Sender(lidar, source).sending(Room(3)), attached(source) as (_, samples):
            take(samples, 1)
        assert f"read {source.sensor}" not in {thread.name for thread in threading.enumerate()}


# What does not come


def explain(lidar, packets=None, **options):
    """The error of opening a source that nothing good comes to."""
    source = Vlp16Source("lidar", lidar, **{"silence_s": 3.0 if packets else 0.3, **options})
    sending = Sender(lidar, source).sending(lambda _: packets or [])
    with pytest.raises(SourceError) as caught, sending, attached(source):
        pass
    return caught.value


def test_vlp16_absent_sensor_lists_checks(lidar):
    error = explain(lidar)
    assert HERE in error.what and str(lidar.driver.port) in error.what
    for word in ("power", "cable", "192.168.1.x", "driver.address", "firewall"):
        assert word in error.hint


def test_vlp16_silent_sensor_is_an_error(lidar):
    with streaming(lidar, lambda _: packets_of(room_scans(3)), silence_s=4.0) as (_, samples):
        assert len(take(samples, 2)) == 2
        with pytest.raises(SourceError, match=str(lidar.driver.port)):
            list(samples)


def test_another_model_is_refused_by_name(lidar):
    others = [
        SensorPacket(p.port, p.sent_ns, p.payload[:-1] + b"\x21")
        for p in packets_of(room_scans(1))
        if p.port == velodyne.DATA_PORT
    ]
    assert "HDL-32E" in explain(lidar, others).what


def test_packets_of_another_address_are_named(lidar):
    error = explain(changed(lidar, driver__address=ELSEWHERE), packets_of(room_scans(1)))
    assert HERE in error.hint and "driver.address" in error.hint


def test_vlp16_garbage_packets_are_counted(lidar):
    rubbish = [SensorPacket(velodyne.DATA_PORT, T0_NS, b"hello")] * 7
    assert "7 damaged packets" in explain(lidar, rubbish).what


def test_vlp16_busy_port_is_named(lidar):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("", lidar.driver.port))
        error = explain(lidar)
    assert str(lidar.driver.port) in error.what and "ss -ulpn" in error.hint


# What is said


def test_udp_arrival_is_stamped_by_kernel():
    port = UdpPort(free_ports()[0], "test")
    late_s = 0.02

    def is_stamped_before_taken():
        before_ns = time.time_ns()
        sender.sendto(b"x", (HERE, port.port))
        time.sleep(late_s)
        taken_ns = time.time_ns()
        (datagram,) = port.receive_many()
        assert (datagram.source, datagram.payload) == (HERE, b"x")
        assert datagram.host_ns >= before_ns - 1_000_000
        return datagram.host_ns < taken_ns - 0.5 * late_s * 1e9

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        # The kernel takes a moment to begin; datagrams before that are stamped when they are taken.
        wait_until(is_stamped_before_taken)
    assert port.receive_many() == []
    port.close()
