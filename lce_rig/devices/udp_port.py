"""A UDP port of the host, with the kernel's own arrival timestamps and its count of what it had to drop."""

import contextlib
import ctypes
import errno
import os
import socket
import struct
import time
from collections.abc import Iterable
from typing import Any, TypeAlias

from lce_rig.core.errors import SourceError
from lce_rig.io.network import Datagram

# Many datagrams in one system call: recvmmsg, which Python does not offer.
#
# References:
#     man 2 recvmmsg, man 3 cmsg

Ancillary: TypeAlias = tuple[int, int, bytes]
"""Level, kind and content of a control message, as socket.recvmsg gives them."""

_ADDRESS_BYTES = 16
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


class BatchReceiver:
    """Buffers for datagrams of IPv4, and the call that fills them."""

    def __init__(self, call: Any, n_slots: int, payload_bytes: int, control_bytes: int) -> None:
        self._call = call
        self._payloads = [ctypes.create_string_buffer(payload_bytes) for _ in range(n_slots)]
        self._controls = [ctypes.create_string_buffer(control_bytes) for _ in range(n_slots)]
        self._names = [ctypes.create_string_buffer(_ADDRESS_BYTES) for _ in range(n_slots)]
        self._vectors = [_Vector(ctypes.addressof(each), payload_bytes) for each in self._payloads]
        self._control_bytes = control_bytes
        self._messages = (_Message * n_slots)()
        for k, message in enumerate(self._messages):
            header = message.header
            header.name = ctypes.addressof(self._names[k])
            header.vectors, header.n_vectors = ctypes.pointer(self._vectors[k]), 1
            header.control = ctypes.addressof(self._controls[k])

    @classmethod
    def build(cls, n_slots: int, payload_bytes: int, control_bytes: int) -> "BatchReceiver | None":
        """Make one for so many datagrams at once; None where the system has no such call.

        Args:
            n_slots: most datagrams of one call.
            payload_bytes: longer ones are cut.
            control_bytes: room for the control messages of each.
        """
        call = getattr(ctypes.CDLL(None, use_errno=True), "recvmmsg", None)
        return None if call is None else cls(call, n_slots, payload_bytes, control_bytes)

    def receive(self, descriptor: int) -> list[tuple[bytes, str, int, list[Ancillary]]]:
        """Take what waits at a socket, and never wait.

        Returns:
            Payload, address and port of the sender, and control messages of each.

        Raises:
            OSError: the network failed.
        """
        for message in self._messages:
            message.header.name_length = _ADDRESS_BYTES
            message.header.control_length = self._control_bytes
        n_came = self._call(descriptor, self._messages, len(self._messages), socket.MSG_DONTWAIT, None)
        if n_came < 0:
            number = ctypes.get_errno()
            if number in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EINTR):
                return []
            raise OSError(number, os.strerror(number))
        return [self._take(k) for k in range(n_came)]

    def _take(self, k: int) -> tuple[bytes, str, int, list[Ancillary]]:
        message = self._messages[k]
        port, address = _PORT_AND_ADDRESS.unpack_from(self._names[k])
        control = ctypes.string_at(message.header.control, message.header.control_length)
        payload = ctypes.string_at(self._vectors[k].base, message.length)
        return payload, socket.inet_ntoa(address), port, _split_control(control)


def _split_control(data: bytes) -> list[Ancillary]:
    """Cut control messages apart."""
    found, at = [], 0
    while at + _CONTROL.size <= len(data):
        length, level, kind = _CONTROL.unpack_from(data, at)
        if length < _CONTROL.size:
            break
        found.append((level, kind, data[at + _CONTROL.size : at + length]))
        at += -(-length // _ALIGN) * _ALIGN
    return found


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
_TIMESPEC = struct.Struct("@ll")
_NS_PER_S = 1_000_000_000


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
        self._batch = BatchReceiver.build(N_AT_ONCE, _MAX_PAYLOAD_BYTES, _ANCILLARY_BYTES)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, WANTED_BUFFER_BYTES)
            for option in (_SO_TIMESTAMPNS, _SO_RXQ_OVFL):
                # Without the one arrivals are stamped a little later; without the other, drops look like
                # losses in the network.
                with contextlib.suppress(OSError):
                    self._socket.setsockopt(socket.SOL_SOCKET, option, 1)
            self._socket.setblocking(False)
            self._socket.bind(("", port))
        except OSError as error:
            self._socket.close()
            raise _port_error(port, what, error) from None
        # Linux doubles what was asked for, for its own accounts, and reports the double.
        self.granted_bytes = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)

    def fileno(self) -> int:
        """Give the file descriptor, to wait on."""
        return self._socket.fileno()

    def receive(self) -> Datagram | None:
        """Take the datagram that came first; None where none is left.

        Raises:
            OSError: the network failed.
        """
        try:
            payload, ancillary, _, (source, source_port) = self._socket.recvmsg(
                _MAX_PAYLOAD_BYTES, _ANCILLARY_BYTES
            )
        except (BlockingIOError, InterruptedError):
            return None
        return self._to_datagram(payload, source, source_port, ancillary)

    def receive_many(self) -> list[Datagram]:
        """Take the datagrams that came first, N_AT_ONCE at most, in one call where the system allows.

        Every call lets other threads run: a thread that takes a datagram at a time falls behind beside one
        that computes.

        Raises:
            OSError: the network failed.
        """
        if self._batch is None:
            found: list[Datagram] = []
            while len(found) < N_AT_ONCE and (datagram := self.receive()) is not None:
                found.append(datagram)
            return found
        return [self._to_datagram(*each) for each in self._batch.receive(self._socket.fileno())]

    def _to_datagram(
        self, payload: bytes, source: str, source_port: int, ancillary: Iterable[Ancillary]
    ) -> Datagram:
        host_ns = 0
        for level, kind, data in ancillary:
            if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) >= _TIMESPEC.size:
                seconds, ns = _TIMESPEC.unpack_from(data)
                host_ns = seconds * _NS_PER_S + ns
            elif level == socket.SOL_SOCKET and kind == _SO_RXQ_OVFL and len(data) >= 4:
                (self.n_overflowed,) = struct.unpack_from("@I", data)
        return Datagram(host_ns or time.time_ns(), source, source_port, self.port, payload)

    def close(self) -> None:
        """Close the port."""
        self._socket.close()


def _port_error(port: int, what: str, error: OSError) -> SourceError:
    if error.errno == errno.EADDRINUSE:
        hint = f"Stop the other program (ROS driver, VeloView): `ss -ulpn sport = :{port}` names it."
        return SourceError(f"{what}: UDP port {port} is held by another program", hint)
    hint = "Ports below 1024 need root; set driver.port as on the LiDAR's web page." if port < 1024 else ""
    return SourceError(f"{what}: UDP port {port} cannot be opened: {error.strerror}", hint)
