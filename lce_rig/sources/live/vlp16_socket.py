"""A UDP port of the host, with the kernel's own arrival stamps and its count of what it had to drop."""

import contextlib
import errno
import socket
import struct
import time
from collections.abc import Iterable

from lce_rig.core.errors import SourceError
from lce_rig.sources.datagrams import Datagram
from lce_rig.sources.live.recvmmsg import Ancillary, BatchReceiver

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
        n_overflowed: datagrams that the kernel dropped because nobody took them in time.
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
                # Without the one arrivals are stamped a little later, without the other drops are not told
                # from losses on the way.
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
