"""Damaged lines of sync boards: none may crash a parser, and none be taken for what its checksum denies.

What the parsers accept is judged by code that shares nothing with them: a sentence must be framed and summed
right, a line without sum must say nothing but what was made of it.
"""

import json
import re
import resource
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timezone

import numpy as np

from lce_rig.devices.sync_board.lines import DIALECTS, LineReader
from lce_rig.devices.sync_board.lines.messages import (
    BoardError,
    BoardStatus,
    Exposure,
    Hello,
    Message,
    PpsEdge,
    TimeReply,
    TriggerEdge,
    UtcTime,
)

Mutation = Callable[[bytes, np.random.Generator], bytes]
_FRAMED = re.compile(rb"\$([^$*]+)\*([0-9A-Fa-f]{1,2})")


@dataclass
class LineReport:
    """What became of damaged lines.

    Attributes:
        n_lines: lines fed.
        n_messages: messages made of them.
        n_unnoticed: lines that had changed and made a message all the same: the damage was beside the
            sentence, kept its sum, or hit a dialect without one.
        n_wrong: messages that the line did not say, or that its sum denies.
        wrong: the first few of those, with what was fed.
        faults: lines refused, by reason.
        grown_bytes: by how much the process grew after the first tenth.
        lines_per_s: speed, the judging included.
    """

    n_lines: int = 0
    n_messages: int = 0
    n_unnoticed: int = 0
    n_wrong: int = 0
    wrong: list[tuple[bytes, Message]] = field(default_factory=list)
    faults: Counter[str] = field(default_factory=Counter)
    grown_bytes: int = 0
    lines_per_s: float = 0.0


def fuzz_lines(n_lines: int, seed: int) -> LineReport:
    """Feed damaged lines of all dialects to their parsers, in pieces, and judge every message.

    Args:
        n_lines: how many.
        seed: same seed, same lines.
    """
    rng = np.random.default_rng(seed)
    report, began_s, early_bytes = LineReport(), time.perf_counter(), 0
    readers = [(name, LineReader(make())) for name, make in sorted(DIALECTS.items())]
    for index in range(n_lines):
        name, reader = readers[index % len(readers)]
        original = sound_line(name, rng)
        data = damaged(original, rng)
        cut = int(rng.integers(0, len(data) + 1))
        messages = reader.feed(data[:cut]) + reader.feed(data[cut:] + b"\n")
        report.n_messages += len(messages)
        report.n_unnoticed += bool(messages) and data.strip() != original.strip()
        for message in messages:
            if not is_sanctioned(name, message, data):
                report.n_wrong += 1
                report.wrong = [*report.wrong, (data, message)][:10]
        if index == n_lines // 10:
            early_bytes = _resident_bytes()
    report.n_lines = n_lines
    report.grown_bytes = _resident_bytes() - early_bytes
    report.lines_per_s = n_lines / (time.perf_counter() - began_s)
    for _, reader in readers:
        report.faults.update({fault.value: count for fault, count in reader.faults.items()})
    return report


def sound_line(dialect: str, rng: np.random.Generator) -> bytes:
    """Make a line as a board of that dialect would write it."""
    a, b, c = (int(value) for value in rng.integers(0, 10**9, 3))
    sentences = {
        "lce1": (
            f"LCEHI,1,0.{a % 9},teensy40,1000000",
            f"LCEPP,{a},{b},{c},{'GIN'[a % 3]}",
            f"LCEPP,{a},{b},,N",
            f"LCETG,{a % 16},{b},{c},{'RF'[a % 2]}",
            f"LCEEX,{a % 16},{b},{c},{a % 9999}",
            f"LCETM,{a},{b},{b + c}",
            f"LCEST,{a % 16},{b},{c},{a},{b}",
            f"LCEER,{a % 99},rate too high",
        ),
        "nmea": (
            f"GPRMC,{a % 24:02d}{b % 60:02d}{c % 60:02d},{'AV'[a % 2]},4807.038,N,01131.000,E,022.4,084.4,"
            f"{1 + a % 28:02d}{1 + b % 12:02d}{c % 100:02d},003.1,W",
            "GNRMC,,V,,,,,,,,,,N",
            "GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,",
        ),
    }
    if dialect in sentences:
        body = sentences[dialect][int(rng.integers(len(sentences[dialect])))].encode()
        return b"$%s*%02X\r\n" % (body, _sum(body))
    if dialect == "tline":
        return b"T,%d,%d\n" % (a, b)
    lines = (
        b'{"f":"t","s":%d,"t":%d,"c":%d}\n' % (a % 256, b, c),
        b'{"f":"a","a":%d,"b":%d}\n{"f":"b","a":%d}\n' % (a, b, b + c),
    )
    return lines[int(rng.integers(2))]


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage a line once or several times; one in twenty stays whole."""
    if rng.uniform() < 0.05:
        return data
    for _ in range(int(rng.integers(1, 4))):
        data = _MUTATIONS[int(rng.integers(len(_MUTATIONS)))](data, rng)
    return data


def is_sanctioned(dialect: str, message: Message, data: bytes) -> bool:
    """Tell whether bytes say what was made of them, and their sum allows it."""
    if data.find(b"$") < 0:
        return any(_says(dialect, message, line.strip()) for line in data.split(b"\n"))
    bodies = [body for body, digits in _FRAMED.findall(data) if _sum(body) == int(digits, 16)]
    lines = (line.strip() for line in data.split(b"\n"))
    return any(_is_written_as(message, body) for body in bodies) or any(
        _says(dialect, message, line) for line in lines
    )


def _is_written_as(message: Message, body: bytes) -> bool:
    if isinstance(message, UtcTime):
        return _is_time_of(message, body.split(b","))
    fields: tuple[object, ...]
    match message:
        case Hello(version, firmware, board, tick_hz):
            fields = ("LCEHI", version, firmware, board, tick_hz)
        case PpsEdge(seq, t_us, utc_s, origin):
            fields = ("LCEPP", seq, t_us, "" if utc_s is None else utc_s, origin)
        case TriggerEdge(channel, count, t_us, is_rising):
            fields = ("LCETG", channel, count, t_us, "R" if is_rising else "F")
        case Exposure(channel, count, start_us, duration_us):
            fields = ("LCEEX", channel, count, start_us, duration_us)
        case TimeReply(cookie, rx_us, tx_us):
            fields = ("LCETM", cookie, rx_us, tx_us)
        case BoardStatus(flags, n_pps, n_lost, n_by_channel):
            fields = ("LCEST", flags, n_pps, n_lost, *n_by_channel)
        case BoardError(code, text):
            fields = ("LCEER", code, text)
    return ",".join(map(str, fields)).encode() == body


def _is_time_of(message: UtcTime, fields: list[bytes]) -> bool:
    if not fields[0].endswith(b"RMC"):
        return False
    if message.utc_ns is None:
        return not fields[1] or not fields[9]
    moment = datetime.fromtimestamp(message.utc_ns // 10**9, tz=timezone.utc)
    says = fields[1][:6].decode(), fields[9].decode(), fields[2] == b"A"
    return says == (moment.strftime("%H%M%S"), moment.strftime("%d%m%y"), message.is_valid)


def _says(dialect: str, message: Message, line: bytes) -> bool:
    """Judge a line without a sum."""
    if dialect == "tline":
        if isinstance(message, Hello):
            return line == b"READY"
        return isinstance(message, TriggerEdge) and line.replace(b" ", b"") == b"T,%d,%d" % (
            message.count,
            message.t_us,
        )
    if dialect != "simplesensorsync":
        return False
    try:
        said = json.loads(line)
        if isinstance(message, TriggerEdge):
            figures = said["t"], said["c"], said["s"] >> message.channel & 1
            return bool(said["f"] == "t" and figures == (message.t_us, message.count, 1))
        # The other half of an answer stands in another line, perhaps an earlier one.
        return isinstance(message, TimeReply) and said["f"] == "b" and said["a"] == message.tx_us
    except (ValueError, KeyError, TypeError):
        return False


def _sum(body: bytes) -> int:
    total = 0
    for byte in body:
        total ^= byte
    return total


def _resident_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _place(data: bytes, rng: np.random.Generator) -> int:
    return int(rng.integers(max(len(data), 1)))


def _flip(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return (
        data[:at] + bytes([byte ^ (1 << int(rng.integers(8))) for byte in data[at : at + 1]]) + data[at + 1 :]
    )


def _replace(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return data[:at] + b'0123456789,*$-+. \r\nRFGINeE{}":'[int(rng.integers(30)) :][:1] + data[at + 1 :]


def _drop(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return data[:at] + data[at + int(rng.integers(1, 6)) :]


def _insert(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return data[:at] + rng.bytes(int(rng.integers(1, 9))) + data[at:]


def _repeat(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return data[:at] + data[at : at + 8] * 2 + data[at + 8 :]


def _swap(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return data[:at] + data[at : at + 2][::-1] + data[at + 2 :]


def _truncate(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: _place(data, rng)]


def _prolong(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: _place(data, rng)] + b"9" * int(rng.integers(1, 1500))


def _run_on(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: _place(data, rng)] + data


_MUTATIONS: tuple[Mutation, ...] = (
    _flip, _replace, _drop, _insert, _repeat, _swap, _truncate, _prolong, _run_on
)  # fmt: skip
