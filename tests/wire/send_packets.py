"""Send a reel's packets as a VLP-16 would: data and position packets by UDP, stamped with the time of day.

Sending begins when somebody listens on the data port. Lines on standard input change what is sent:
`pause S`, `loss SHARE`, `clock PPS_STATE ERROR_US`, `stop`. In the end it prints what was sent, as JSON.
"""

import argparse
import json
import random
import select
import socket
import struct
import sys
import time
from pathlib import Path

from lce_rig.core import velodyne
from wire.timing import PACKET_NS, PACKETS_PER_LOOP, placement_at
from wire.vlp16_packets import gprmc

_DATA_PER_POSITION = 14
_SENTENCE_DELAY_NS = 300_000_000
_BURST_S = 0.004
# Late packets are sent no faster than a port can receive them.
_MOST_AT_ONCE = 40
_US = struct.Struct("<I")
_US_AT, _POSITION_US_AT, _PPS_AT, _NMEA_AT = 1200, 0xC6, 0xCA, 0xCE


class Sensor:
    """A VLP-16 that shows a reel."""

    def __init__(self, reel, loops_per_hold, data_port, position_port):
        figures = json.loads((reel / "reel.json").read_text())
        data = (reel / "packets.bin").read_bytes()
        size = velodyne.DATA_BYTES
        self._payloads = [bytearray(data[k : k + size]) for k in range(0, len(data), size)]
        self._n_placements, self._loops_per_hold = figures["n_placements"], loops_per_hold
        self._ports = data_port, position_port
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._random = random.Random(0)
        self.n_sent = self.n_withheld = 0
        self.loss = 0.0
        self.pps, self.error_us = velodyne.PPS_LOCKED, 0

    def send(self, number):
        """Send the packet of this number since the epoch."""
        start_ns = number * PACKET_NS
        placement = placement_at(start_ns, self._loops_per_hold, self._n_placements)
        payload = self._payloads[placement * PACKETS_PER_LOOP + number % PACKETS_PER_LOOP]
        if self._random.random() < self.loss:
            self.n_withheld += 1
        else:
            _US.pack_into(payload, _US_AT, self._count_us(start_ns))
            self._socket.sendto(payload, ("127.0.0.1", self._ports[0]))
            self.n_sent += 1
        if number % _DATA_PER_POSITION == 0:
            self._socket.sendto(self._position(start_ns + PACKET_NS), ("127.0.0.1", self._ports[1]))

    def _position(self, now_ns):
        packet = bytearray(velodyne.POSITION_BYTES)
        _US.pack_into(packet, _POSITION_US_AT, self._count_us(now_ns))
        packet[_PPS_AT] = self.pps
        if self.pps == velodyne.PPS_LOCKED:
            sentence = gprmc(now_ns - _SENTENCE_DELAY_NS).encode() + b"\r\n"
            packet[_NMEA_AT : _NMEA_AT + len(sentence)] = sentence
        return packet

    def _count_us(self, time_ns):
        return (time_ns // 1000 + self.error_us) % velodyne.HOUR_US


def is_heard(port):
    """Check whether a process listens on a UDP port."""
    table = Path("/proc/net/udp").read_text().splitlines()[1:]
    return any(line.split()[1].endswith(f":{port:04X}") for line in table)


def run(sensor, port):
    """Send until told to stop."""
    number, is_open, paused_s = 0, False, 0.0
    while True:
        if select.select([sys.stdin], [], [], _BURST_S)[0]:
            word, *values = sys.stdin.readline().split() or ["stop"]
            if word == "stop":
                return
            if word == "pause":
                paused_s = time.monotonic() + float(values[0])
            elif word == "loss":
                sensor.loss = float(values[0])
            elif word == "clock":
                sensor.pps, sensor.error_us = velodyne.PPS_STATES.index(values[0]), int(values[1])
        is_open = is_open or is_heard(port)
        if time.monotonic() < paused_s or not is_open:
            number = time.time_ns() // PACKET_NS + 1
            continue
        due = min(time.time_ns() // PACKET_NS, number + _MOST_AT_ONCE)
        while number < due:
            sensor.send(number)
            number += 1


def main():
    """Read the arguments and send."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("reel", type=Path)
    parser.add_argument("--loops", type=int, required=True, help="of 0.3 s that the board is held for")
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--position-port", type=int, required=True)
    given = parser.parse_args()
    sensor = Sensor(given.reel, given.loops, given.port, given.position_port)
    print("ready", flush=True)
    run(sensor, given.port)
    print(json.dumps({"sent": sensor.n_sent, "withheld": sensor.n_withheld}), flush=True)


if __name__ == "__main__":
    main()
