"""A UDP port of the host, with the kernel's arrival timestamps and its count of dropped datagrams.

Many datagrams are taken in one system call: recvmmsg, which Python does not offer.

References:
    man 2 recvmmsg, man 3 cmsg
"""

import contextlib
import ctypes
import errno
import os
import socket
import struct
import time

from lce_rig.core.errors import SourceError
from lce_rig.io.network import Datagram

#: Two seconds of data packets, as the kernel accounts for them.
WANTED_BUFFER_BYTES = 4 << 20
#: What a data packet takes of the buffer: its bytes, and the kernel's own about it.
PACKET_COST_BYTES = 2304
#: Datagrams that are taken in one call: 85 ms of data packets.
N_AT_ONCE = 64

# asm-generic/socket.h; Python names neither.
_SO_TIMESTAMPNS = 35
_SO_RXQ_OVFL = 40
_MAX_PAYLOAD_BYTES = 2048
_ANCILLARY_BYTES = 256
_ADDRESS_BYTES = 16
_NS_PER_S = 1_000_000_000
_TIMESPEC = struct.Struct("@ll")
_PORT_AND_ADDRESS = struct.Struct("!2xH4s")
_CONTROL = struct.Struct("@Nii")
_ALIGN = ctypes.sizeof(ctypes.c_size_t)


class _Vector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _MessageHeader(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("vectors", ctypes.POINTER(_Vector)),
        ("n_vectors", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Message(ctypes.Structure):
    _fields_ = (("header", _MessageHeader), ("length", ctypes.c_uint32))


class UdpPort:
    """An open UDP port; other programs may listen on the same one.

    Attributes:
        port: its number.
        granted_bytes: receive buffer that the kernel granted.
        n_overflowed: datagrams that the kernel dropped because they were not taken in time.
    """

    def __init__(self, port: int, what: str) -> None:
        """Open the port.

        Args:
            port: its number.
            what: it is for, for messages: "lidar: data packets".

        Raises:
            SourceError: another program holds it alone, or it may not be opened.
        """
        self.port = port
        self.n_overflowed = 0
        self._receive = ctypes.CDLL(None, use_errno=True).recvmmsg
        self._payloads = [ctypes.create_string_buffer(_MAX_PAYLOAD_BYTES) for _ in range(N_AT_ONCE)]
        self._controls = [ctypes.create_string_buffer(_ANCILLARY_BYTES) for _ in range(N_AT_ONCE)]
        self._names = [ctypes.create_string_buffer(_ADDRESS_BYTES) for _ in range(N_AT_ONCE)]
        self._vectors = [_Vector(ctypes.addressof(each), _MAX_PAYLOAD_BYTES) for each in self._payloads]
        self._messages = (_Message * N_AT_ONCE)()
        for k, message in enumerate(self._messages):
            message.header.name = ctypes.addressof(self._names[k])
            message.header.vectors, message.header.n_vectors = ctypes.pointer(self._vectors[k]), 1
            message.header.control = ctypes.addressof(self._controls[k])
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, WANTED_BUFFER_BYTES)
            for option in (_SO_TIMESTAMPNS, _SO_RXQ_OVFL):
                # Without the one arrivals are stamped a little later; without the other, drops look like
                # losses in the network.
                with contextlib.suppress(OSError):
                    self._socket.setsockopt(socket.SOL_SOCKET, option, 1)
            self._socket.bind(("", port))
        except OSError as error:
            self._socket.close()
            if error.errno == errno.EADDRINUSE:
                hint = f"Stop the other program (ROS driver, VeloView): `ss -ulpn sport = :{port}` names it."
                raise SourceError(f"{what}: UDP port {port} is held by another program", hint) from None
            is_low = port < 1024
            hint = "Ports below 1024 need root; set driver.port as on the LiDAR's web page." if is_low else ""
            raise SourceError(f"{what}: UDP port {port} cannot be opened: {error.strerror}", hint) from None
        # Linux doubles what was asked for, for its own accounts, and reports the double.
        self.granted_bytes = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)

    def fileno(self) -> int:
        """Return the file descriptor, to wait on."""
        return self._socket.fileno()

    def receive_many(self) -> list[Datagram]:
        """Take the datagrams that came first, N_AT_ONCE at most, in one call; never waits.

        Every call lets other threads run: a thread that takes a datagram at a time falls behind beside one
        that computes.

        Raises:
            OSError: the network failed.
        """
        for message in self._messages:
            message.header.name_length = _ADDRESS_BYTES
            message.header.control_length = _ANCILLARY_BYTES
        n_came = self._receive(self._socket.fileno(), self._messages, N_AT_ONCE, socket.MSG_DONTWAIT, None)
        if n_came < 0:
            number = ctypes.get_errno()
            if number in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EINTR):
                return []
            raise OSError(number, os.strerror(number))
        return [self._to_datagram(k) for k in range(n_came)]

    def close(self) -> None:
        """Close the port."""
        self._socket.close()

    def _to_datagram(self, k: int) -> Datagram:
        message, host_ns, at = self._messages[k], 0, 0
        port, address = _PORT_AND_ADDRESS.unpack_from(self._names[k])
        control = ctypes.string_at(message.header.control, message.header.control_length)
        while at + _CONTROL.size <= len(control):
            length, level, kind = _CONTROL.unpack_from(control, at)
            if length < _CONTROL.size:
                break
            if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS):
                seconds, ns = _TIMESPEC.unpack_from(control, at + _CONTROL.size)
                host_ns = seconds * _NS_PER_S + ns
            elif (level, kind) == (socket.SOL_SOCKET, _SO_RXQ_OVFL):
                (self.n_overflowed,) = struct.unpack_from("@I", control, at + _CONTROL.size)
            at += -(-length // _ALIGN) * _ALIGN
        payload = ctypes.string_at(self._vectors[k].base, message.length)
        return Datagram(host_ns or time.time_ns(), socket.inet_ntoa(address), port, self.port, payload)
