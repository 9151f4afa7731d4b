"""Pcap files with arrivals in ns, written by dpkt."""

import socket
from decimal import Decimal

import dpkt


def build_frame(datagram):
    """Build the Ethernet frame of a datagram that was broadcast, as the sensor sends it when new."""
    udp = dpkt.udp.UDP(sport=datagram.port, dport=datagram.port, data=datagram.payload)
    udp.ulen = 8 + len(datagram.payload)
    source = socket.inet_aton(datagram.source)
    ip = dpkt.ip.IP(src=source, dst=b"\xff" * 4, p=dpkt.ip.IP_PROTO_UDP, df=1, data=udp)
    card = bytes.fromhex("607688000000")
    return bytes(dpkt.ethernet.Ethernet(src=card, dst=b"\xff" * 6, data=bytes(ip)))


def write_datagrams(path, datagrams):
    with path.open("xb") as file:
        writer = dpkt.pcap.Writer(file, snaplen=65535, nano=True)
        for datagram in datagrams:
            writer.writepkt_time(build_frame(datagram), Decimal(datagram.host_ns).scaleb(-9))
