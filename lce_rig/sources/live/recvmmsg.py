"""Many datagrams in one system call: recvmmsg, which Python does not offer.

References:
    man 2 recvmmsg, man 3 cmsg
"""

import ctypes
import errno
import os
import socket
import struct
from typing import Any, TypeAlias

Ancillary: TypeAlias = tuple[int, int, bytes]
"""Level, kind and content of a control message, as socket.recvmsg gives them."""

_ADDRESS_BYTES = 16
_PORT_AND_ADDRESS = struct.Struct("!2xH4s")
_CONTROL = struct.Struct("@Nii")
_ALIGN = ctypes.sizeof(ctypes.c_size_t)


class _Vector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Header(ctypes.Structure):
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
    _fields_ = (("header", _Header), ("length", ctypes.c_uint32))


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
