"""Sentences as NMEA 0183 has them: `$`, name and fields, `*`, and the exclusive or of what lies between.

The sum is weak: two characters that trade places leave it as it was. What passes it is therefore still held
to a strict grammar, and to what the board has said before (`BoardState`).

References:
    NMEA 0183 sentence format; checksums of one digit instead of two are written by boards in the field.
"""

import re
from functools import reduce
from operator import xor

from lce_rig.devices.sync_board.lines.messages import LineFault

_SENTENCE = re.compile(rb"([!-#%-)+-~ ]+)\*([0-9A-Fa-f]{1,2})\Z")


def checksum(body: bytes) -> int:
    """Compute the exclusive or of all bytes between `$` and `*`."""
    return reduce(xor, body, 0)


def write_sentence(body: str) -> bytes:
    """Frame the name and fields of a sentence."""
    data = body.encode("ascii")
    return b"$%s*%02X\r\n" % (data, checksum(data))


def split_sentence(line: bytes) -> list[bytes] | LineFault:
    """Take a sentence apart into its name and fields.

    What stands before the last `$` is left out: a board that begins anew breaks off in the middle of a line.

    Args:
        line: without its end.
    """
    start = line.rfind(b"$")
    found = _SENTENCE.match(line, start + 1) if start >= 0 else None
    if found is None:
        return LineFault.MALFORMED if start >= 0 else LineFault.UNKNOWN
    if checksum(found[1]) != int(found[2], 16):
        return LineFault.CHECKSUM
    return found[1].split(b",")
