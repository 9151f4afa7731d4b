"""LCE1, the line protocol of lce-rig's own sync board; docs/sync-protocol.md describes it."""

import re
from collections.abc import Callable

from lce_rig.devices.sync_board.lines.boards_of_others import read_rmc
from lce_rig.devices.sync_board.lines.dialect import Dialect, Reading, split_sentence, write_sentence
from lce_rig.devices.sync_board.lines.messages import (
    MAX_COUNT,
    MAX_US,
    N_CHANNELS,
    BoardError,
    BoardStatus,
    Exposure,
    Hello,
    LineFault,
    Message,
    PpsEdge,
    TimeReply,
    TriggerEdge,
)

VERSION = 1

_NUMBER = re.compile(rb"(?:0|[1-9][0-9]{0,18})\Z")
_WORD = re.compile(rb"[A-Za-z0-9._ -]{1,32}\Z")
_TEXT = re.compile(rb"[!-)+-~ ]{0,80}\Z")
_ORIGINS = {b"G": "G", b"I": "I", b"N": "N"}
_EDGES = {b"R": True, b"F": False}


class Lce1(Dialect):
    """The dialect `lce1`."""

    def read(self, line: bytes) -> Reading:
        """Read one line, without its end."""
        parts = split_sentence(line)
        if isinstance(parts, LineFault):
            return parts
        name, *fields = parts
        if name[2:] == b"RMC":
            return read_rmc(fields)
        reader = READERS.get(name)
        if reader is None:
            return LineFault.UNKNOWN
        try:
            return (reader(fields),)
        except (ValueError, KeyError):
            return LineFault.MALFORMED

    def greeting(self) -> bytes:
        """Ask the board who it is."""
        return write_sentence("LCEHI?")

    def time_request(self, cookie: int) -> bytes:
        """Ask the board for its time."""
        return write_sentence(f"LCETM?,{cookie}")

    def set_trigger(self, channel: int, rate_hz: float, phase_us: int, pulse_us: int) -> bytes:
        """Set the pulses of a line; a rate of 0 ends them."""
        return write_sentence(f"LCERT,{channel},{rate_hz:.6f},{phase_us},{pulse_us}")

    def set_utc(self, t_us: int, utc_s: int) -> bytes:
        """Tell the board which UTC second begins at a moment of its own clock."""
        return write_sentence(f"LCEUT,{t_us},{utc_s}")

    def start(self) -> bytes:
        """Let the pulses begin."""
        return write_sentence("LCEGO")


def _number(field: bytes, largest: int = MAX_COUNT) -> int:
    if not _NUMBER.match(field) or int(field) > largest:
        raise ValueError(field)
    return int(field)


def _time(field: bytes) -> int:
    return _number(field, MAX_US)


def _channel(field: bytes) -> int:
    return _number(field, N_CHANNELS - 1)


def _word(field: bytes) -> str:
    if not _WORD.match(field):
        raise ValueError(field)
    return field.decode("ascii")


def _hello(fields: list[bytes]) -> Message:
    version, firmware, board, tick_hz = fields
    return Hello(_number(version), _word(firmware), _word(board), _number(tick_hz))


def _pps(fields: list[bytes]) -> Message:
    seq, t_us, utc_s, origin = fields
    utc = _number(utc_s, MAX_US // 1_000_000) if utc_s else None
    return PpsEdge(_number(seq), _time(t_us), utc, _ORIGINS[origin])  # type: ignore[arg-type]


def _trigger(fields: list[bytes]) -> Message:
    channel, count, t_us, edge = fields
    return TriggerEdge(_channel(channel), _number(count), _time(t_us), _EDGES[edge])


def _exposure(fields: list[bytes]) -> Message:
    channel, count, start_us, duration_us = fields
    return Exposure(_channel(channel), _number(count), _time(start_us), _number(duration_us))


def _time_reply(fields: list[bytes]) -> Message:
    cookie, rx_us, tx_us = fields
    if _time(rx_us) > _time(tx_us):
        raise ValueError(fields)
    return TimeReply(_number(cookie), _time(rx_us), _time(tx_us))


def _status(fields: list[bytes]) -> Message:
    flags, n_pps, n_lost, *counts = fields
    if len(counts) > N_CHANNELS:
        raise ValueError(fields)
    return BoardStatus(_number(flags), _number(n_pps), _number(n_lost), tuple(map(_number, counts)))


def _error(fields: list[bytes]) -> Message:
    code, *text = fields
    words = b",".join(text)
    if not text or not _TEXT.match(words):
        raise ValueError(fields)
    return BoardError(_number(code), words.decode("ascii"))


READERS: dict[bytes, Callable[[list[bytes]], Message]] = {
    b"LCEHI": _hello,
    b"LCEPP": _pps,
    b"LCETG": _trigger,
    b"LCEEX": _exposure,
    b"LCETM": _time_reply,
    b"LCEST": _status,
    b"LCEER": _error,
}
"""How the fields of each sentence are read, by its name."""
