"""Damage to files, reproducible from a random generator: to bytes, to numbers in text, to values in JSON."""

import json
import re
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

Form = Literal["bytes", "text", "json", "lines"]
"""What is damaged: any bytes, text with numbers, one JSON document, or one JSON document a line."""

_MAX_MUTATIONS = 3
_ENDS_BYTES = 256
_WHOLE_NUMBERS = (
    *(0, 1, 2, 3, 7, 8, 0x7F, 0x80, 0xFF, 0x100, 0x7FFF, 0x8000, 0xFFFF, 0x10000, 30_000, 50_000, 65_536),
    *(1 << 20, 1 << 24, 1 << 28, 1 << 30, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 32, 10**12),
    *(1 << 40, 0x7FFFFFFFFFFFFFFF, 0x8000000000000000, 0xFFFFFFFFFFFFFFFF),
)
_NUMBERS_IN_TEXT = (
    *(b"0", b"-1", b"1", b"-0", b"65536", b"50000", b"4294967296", b"2147483648", b"9223372036854775808"),
    *(b"1e308", b"-1e308", b"1.0e+308", b"1e999", b"-1e999", b"1e-320", b"NaN", b"nan", b"inf", b"-inf"),
    *(b"2x0", b"0x10", b"1_000", b"1,5", b"", b"true", b"null", b"9" * 401, b"9" * 5000, b"0." + b"3" * 400),
    *("\u0664\u0662".encode(), "\u00b2".encode(), b"1e", b"--1", b"+1"),
)
_RAW = "<raw number {}>"
_RAW_NUMBERS = ("1e999", "-1e999", "1e308", "-1e308", "NaN", "9" * 401, "9" * 5000, "-0.0", "1e-320")
_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2, 3.5, -0.5, 1 << 31, 1 << 63, 1 << 64, 10**30, 1e300),
    *("", "a b", "..", "../../etc/hostname", "/etc/hostname", "\u0000", "\ud800", "x" * 10_000, "nan", "0"),
    *([], {}, [[]], [0], [None], {"": 0}, ["a"] * 3, [1.0] * 16, [[1, 0, 0, 0]] * 4, [[0.0] * 4] * 4),
)
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][A-Za-z_0-9]*")


def damaged(data: bytes, others: Sequence[bytes], form: Form, rng: np.random.Generator) -> bytes:
    """Damage data once or several times.

    Args:
        data: what is damaged.
        others: of the same kind, to splice pieces from.
        form: what `data` is; documents and text are damaged as bytes, too.
        rng: decides everything.
    """
    for _ in range(int(rng.integers(1, _MAX_MUTATIONS + 1))):
        kind: Form = form if form == "bytes" or rng.random() < 0.8 else "bytes"
        if kind == "json":
            data = _damage_document(data, rng)
        elif kind == "lines":
            data = _damage_line(data, rng)
        elif kind == "text":
            data = _pick(_OF_TEXT, rng)(data, rng)
        elif others and rng.random() < 0.08:
            data = _splice(data, others[int(rng.integers(len(others)))], rng)
        else:
            data = _pick(_OF_BYTES, rng)(data, rng)
    return data


def _pick(choices: Sequence[Any], rng: np.random.Generator) -> Any:
    return choices[int(rng.integers(len(choices)))]


def _place(data: bytes, rng: np.random.Generator) -> int:
    """Choose a place; heads and ends of files say more than what lies between."""
    n = max(len(data), 1)
    side = rng.random()
    if side < 0.4:
        return int(rng.integers(min(n, _ENDS_BYTES)))
    if side < 0.55:
        return n - 1 - int(rng.integers(min(n, _ENDS_BYTES)))
    return int(rng.integers(n))


def _run(data: bytes, rng: np.random.Generator) -> tuple[int, int]:
    begin = _place(data, rng)
    length = int(rng.integers(1, 1 + min(max(len(data), 1), int(2 ** rng.integers(1, 14)))))
    return begin, begin + length


def _flip(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 9)) if data else 0):
        changed[_place(data, rng)] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _overwrite(data: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _run(data, rng)
    kind = int(rng.integers(3))
    n = len(data[begin:end])
    return (
        data[:begin] + (rng.bytes(n) if kind == 0 else bytes([0, 0, 255][kind : kind + 1]) * n) + data[end:]
    )


def _truncate(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def _remove(data: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _run(data, rng)
    return data[:begin] + data[end:]


def _duplicate(data: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _run(data, rng)
    return data[:end] + data[begin:end] * int(rng.integers(1, 5)) + data[end:]


def _exchange(data: bytes, rng: np.random.Generator) -> bytes:
    a, b, c = sorted(int(value) for value in rng.integers(0, len(data) + 1, 3))
    return data[:a] + data[b:c] + data[a:b] + data[c:]


def _insert(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return data[:at] + rng.bytes(int(rng.integers(1, 64))) + data[at:]


def _set_field(data: bytes, rng: np.random.Generator) -> bytes:
    """Put a number that matters into a field of 1, 2, 4 or 8 bytes, aligned or not."""
    size = int(_pick((1, 2, 4, 4, 8), rng))
    at = _place(data, rng)
    at -= at % size if rng.random() < 0.5 else 0
    if at + size > len(data):
        return data
    old = int.from_bytes(data[at : at + size], "little")
    near = (old + int(rng.integers(-3, 4))) if rng.random() < 0.2 else int(_pick(_WHOLE_NUMBERS, rng))
    order: Any = "little" if rng.random() < 0.7 else "big"
    return data[:at] + (near % (1 << 8 * size)).to_bytes(size, order) + data[at + size :]


def _splice(data: bytes, other: bytes, rng: np.random.Generator) -> bytes:
    """Put the head of one file before the end of another, or a piece of it inside."""
    if rng.random() < 0.5:
        return data[: _place(data, rng)] + other[_place(other, rng) :]
    (begin, end), at = _run(other, rng), _place(data, rng)
    return data[:at] + other[begin:end] + data[at:]


_OF_BYTES: tuple[Callable[[bytes, np.random.Generator], bytes], ...] = (
    *(_flip, _flip, _overwrite, _truncate, _remove, _duplicate, _exchange, _insert),
    *(_set_field, _set_field, _set_field),
)


def _replace_match(data: bytes, pattern: re.Pattern[bytes], new: bytes, rng: np.random.Generator) -> bytes:
    matches = [(m.start(), m.end()) for m in pattern.finditer(data[:100_000])]
    if not matches:
        return data
    # The first numbers of a file are those of its header.
    few = matches[:40] if rng.random() < 0.6 else matches
    begin, end = _pick(few, rng)
    return data[:begin] + new + data[end:]


def _replace_number(data: bytes, rng: np.random.Generator) -> bytes:
    return _replace_match(data, _NUMBER, _pick(_NUMBERS_IN_TEXT, rng), rng)


def _replace_word(data: bytes, rng: np.random.Generator) -> bytes:
    words = _WORD.findall(data[:20_000]) or [b""]
    return _replace_match(data, _WORD, _pick((*words[:50], b"", b"x", b"a b", b"*", b"&a", b"!!x"), rng), rng)


def _change_line(data: bytes, rng: np.random.Generator) -> bytes:
    """Remove, repeat, move or merge a line."""
    lines = data.split(b"\n")
    at, to = int(rng.integers(min(len(lines), 60))), int(rng.integers(len(lines)))
    kind = int(rng.integers(4))
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines[at:at] = [lines[at]] * int(_pick((1, 2, 100), rng))
    elif kind == 2:
        lines.insert(min(to, len(lines) - 1), lines.pop(at))
    else:
        lines[at : at + 2] = [b" ".join(lines[at : at + 2])]
    return b"\n".join(lines)


_OF_TEXT: tuple[Callable[[bytes, np.random.Generator], bytes], ...] = (
    *(_replace_number, _replace_number, _replace_number, _replace_word, _change_line),
)


def _damage_line(data: bytes, rng: np.random.Generator) -> bytes:
    lines = data.split(b"\n")
    at = int(rng.integers(len(lines)))
    lines[at] = _damage_document(lines[at], rng).replace(b"\n", b" ")
    return b"\n".join(lines)


def _damage_document(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage one value or key of a JSON document; as text where it is none."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return bytes(_pick(_OF_TEXT, rng)(data, rng))
    kind = rng.random()
    if kind < 0.04:
        return _nested(int(_pick((50, 2_000, 100_000), rng)), data, rng)
    places = list(_places(document))
    if kind < 0.08 and places:
        return _with_key_twice(data, rng)
    raw = ""
    if not places or kind < 0.1:
        document = _pick(_VALUES, rng)
    else:
        holder, key = _pick(places, rng)
        raw = _damage_place(holder, key, places, rng)
    text = json.dumps(document, indent=1 if rng.random() < 0.5 else None)
    return text.replace(json.dumps(_RAW.format(0)), raw).encode("utf-8", "surrogatepass")


def _places(document: Any) -> list[tuple[Any, Any]]:
    """List every value of a document as its holder and its key or index."""
    found: list[tuple[Any, Any]] = []
    waiting = [document]
    while waiting and len(found) < 5_000:
        holder = waiting.pop()
        keys = (
            list(holder)
            if isinstance(holder, dict)
            else range(len(holder) if isinstance(holder, list) else 0)
        )
        found += [(holder, key) for key in keys]
        waiting += [holder[key] for key in keys]
    return found


def _damage_place(holder: Any, key: Any, places: Sequence[Any], rng: np.random.Generator) -> str:
    """Change one value or key in place; gives the number that cannot be written from Python's values."""
    kind = int(rng.integers(9))
    value = holder[key]
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, dict):
        new = str(_pick(("", "a b", "lidar", "cam", "nobody", "0", "../x", str(key) + "s"), rng))
        holder[new] = holder.pop(key)
    elif kind == 2 and isinstance(holder, list):
        holder[key:key] = [value] * int(_pick((1, 3, 20_000), rng))
    elif kind == 3:
        other, its = _pick(places, rng)
        holder[key] = json.loads(json.dumps(other[its])) if its in other or isinstance(other, list) else None
    elif kind == 4 and isinstance(value, int | float):
        holder[key] = _RAW.format(0)
        return str(_pick(_RAW_NUMBERS, rng))
    elif kind == 5 and isinstance(value, int | float):
        holder[key] = type(value)(-value) if rng.random() < 0.5 else int(_pick(_WHOLE_NUMBERS, rng))
    elif kind == 6 and isinstance(value, str):
        at = int(rng.integers(len(value) + 1))
        holder[key] = (
            value[:at] + str(_pick(("x", " ", "\n", "/", "\u0000", "[bold]", "\x1b[2J"), rng)) + value[at:]
        )
    elif kind == 7 and isinstance(value, str):
        holder[key] = str(_pick(("nobody", "cam", "lidar", "frames", "events", "image", "scan"), rng))
    else:
        holder[key] = _pick(_VALUES, rng)
    return ""


def _nested(depth: int, data: bytes, rng: np.random.Generator) -> bytes:
    """Put a deeply nested value in place of a number, or of everything."""
    opening, closing = _pick(((b"[", b"]"), (b'{"a":', b"}")), rng)
    bomb = opening * depth + b"0" + closing * depth if rng.random() < 0.5 else opening * depth
    return _replace_match(data, _NUMBER, bomb, rng) if rng.random() < 0.5 else bomb


def _with_key_twice(data: bytes, rng: np.random.Generator) -> bytes:
    pairs = [(m.start(), m.end()) for m in re.finditer(rb'"\w+": *(?:"[^"]*"|[^,\[\]{}]+)', data[:100_000])]
    if not pairs:
        return data
    begin, end = _pick(pairs, rng)
    return data[:end] + b", " + data[begin:end] + data[end:]
