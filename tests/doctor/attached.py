"""A rig attached by real transports: a VLP-16 on loopback, a camera's pipe, a board's pty."""

import socket
import sys
import threading
import time
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from wire.sync_board import FakeBoard
from wire.vlp16_packets import STREAMED_VLP16, Vlp16Clock, Vlp16Packets, free_ports

from lce_rig.core import velodyne
from lce_rig.core.data import Scan
from lce_rig.rig import Rig
from tests.io.vlp16_room import T0_NS, room_scan

HERE = "127.0.0.1"
PERIOD_S = 0.1
# Pictures come so long after the beginning of each tenth of a second, at which the board pulses.
DELAY_S = 0.015
PIXELS = np.full((260, 346), 120, np.uint8)
SCAN = room_scan(T0_NS, dropout=0.0)
CAMERA = """
import sys, time
data = open(sys.argv[1], "rb").read()
period_s, delay_s = float(sys.argv[2]), float(sys.argv[3])
due_s = (time.time() // period_s + 1) * period_s + delay_s
while True:
    time.sleep(max(0, due_s - time.time()))
    sys.stdout.buffer.write(data)
    sys.stdout.buffer.flush()
    due_s += period_s
"""


class Vlp16Sender(threading.Thread):
    """Sends the same scan again and again, as fast as a rotor turns, each packet when its time has come."""

    def __init__(self, scan, ports, clock):
        super().__init__(daemon=True)
        self.stop = threading.Event()
        self._scan, self._clock = scan, clock
        self._ports = dict(zip((velodyne.DATA_PORT, velodyne.POSITION_PORT), ports, strict=True))

    def run(self):
        packets = Vlp16Packets(clock=self._clock)
        stamp_ns = (time.time_ns() + 50_000_000) // 1000 * 1000
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not self.stop.is_set():
                for packet in packets.feed(replace(self._scan, stamp_ns=stamp_ns)):
                    time.sleep(max(0.0, (packet.sent_ns - time.time_ns()) * 1e-9 - 0.001))
                    sender.sendto(packet.payload, (HERE, self._ports[packet.port]))
                stamp_ns += STREAMED_VLP16.period_ns


@dataclass(frozen=True, eq=False)
class Attached:
    """What is attached, and how it does."""

    rig: Rig
    pixels: NDArray[np.uint8] | None = None
    scan: Scan | None = None
    clock: Vlp16Clock | None = None
    has_board: bool = True


@contextmanager
def attach(attached, folder):
    """Attach everything; return the profile with the connections."""
    ports = free_ports()
    document = attached.rig.model_dump()
    document["lidars"]["lidar"]["driver"] = {
        "port": ports[0],
        "address": HERE,
        "controls": {"position_port": ports[1]},
    }
    command = ["false"] if attached.pixels is None else _camera(attached.pixels, folder)
    document["cameras"]["cam"]["driver"] = {"type": "command", "command": command, "pixel_format": "GREY"}
    trigger = {"channel": 0, "rate_hz": 1 / PERIOD_S, "max_delay_s": 0.04}
    document["sync"] = {"device": "/dev/not-there", "triggers": {"cam": trigger}}
    with ExitStack() as stack:
        if attached.scan is not None:
            sender = Vlp16Sender(attached.scan, ports, attached.clock)
            sender.start()
            stack.callback(sender.join)
            stack.callback(sender.stop.set)
        if attached.has_board:
            document["sync"]["device"] = stack.enter_context(FakeBoard(period_s=PERIOD_S)).path
        yield Rig.model_validate(document)


def _camera(pixels, folder):
    path = folder / "picture"
    path.write_bytes(pixels.tobytes())
    return [sys.executable, "-c", CAMERA, str(path), str(PERIOD_S), str(DELAY_S)]
