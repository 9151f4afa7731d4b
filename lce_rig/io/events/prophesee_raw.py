"""Prophesee's .raw files: lines of text, then EVT2 or EVT3 words up to the end.

References:
    https://docs.prophesee.ai/stable/data/file_formats/raw.html
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import EventColumns
from lce_rig.core.errors import SourceError, reading
from lce_rig.core.losses import Losses
from lce_rig.io import findings
from lce_rig.io.events.stream import parse_size
from lce_rig.io.events.word_codec import EVT3, Evt2Decoder, WordDecoder

_BLOCK_BYTES = 1 << 18
_WORDS = {"2": "<u4", "3": "<u2"}
# Of files that name their sensor but not its resolution.
_RESOLUTION_PX = {
    "gen31": (640, 480),
    "gen3": (640, 480),
    "genx320": (320, 320),
    "gen4": (1280, 720),
    "imx636": (1280, 720),
    "imx646": (1280, 720),
}


class PropheseeEvents:
    """Events of a .raw file; see `EventStream`.

    Attributes:
        serial: the camera's serial number, "" if the file does not name it.
    """

    def __init__(self, path: Path) -> None:
        """Read the header.

        Raises:
            SourceError: it is no .raw file, or of another encoding.
        """
        self._path = path
        self.notes: list[str] = []
        with reading(path), path.open("rb") as file:
            header = _read_header(file)
            self._begin = file.tell()
        self.serial = header.get("serial_number", "")
        # The format line holds more: "EVT3;height=720;width=1280".
        encoding, *fields = header.get("format", "").split(";")
        named = header.get("evt", encoding.upper().removeprefix("EVT"))
        self._version = named.removesuffix(".0")
        if self._version not in _WORDS:
            hint = "Check that it is a Prophesee .raw file, or convert it to EVT3."
            raise SourceError(f"{path} has the encoding {named[:20]!r}, not EVT2 or EVT3", hint)
        size = dict(field.partition("=")[::2] for field in fields)
        width, height = size.get("width", ""), size.get("height", "")
        if not (width and height):
            width, _, height = header.get("geometry", "").partition("x")
        self.resolution_px = parse_size(width, height)
        if self.resolution_px is None and (width or height):
            self.notes.append(
                f"{path.name}: its header's size {width[:9]}x{height[:9]} is not a sensor's and is ignored"
            )
        elif self.resolution_px is None:
            generation = header.get("sensor_generation", "").replace(".", "")
            sensor = (
                f"{header.get('plugin_name', '')} {header.get('sensor_name', '')} gen{generation}".lower()
            )
            sizes = (px for name, px in _RESOLUTION_PX.items() if name in sensor)
            self.resolution_px = next(sizes, None)

    def stretches(self, losses: Losses) -> Iterator[EventColumns]:
        """Yield the events of the file, block by block."""
        dtype = np.dtype(_WORDS[self._version])
        decoder: Any = WordDecoder(EVT3) if self._version == "3" else Evt2Decoder()
        with reading(self._path), self._path.open("rb") as file:
            file.seek(self._begin)
            while block := file.read(_BLOCK_BYTES):
                n_torn = len(block) % dtype.itemsize
                words: NDArray[Any] = np.frombuffer(block, dtype, len(block) // dtype.itemsize)
                yield decoder.decode(words)
                if n_torn:
                    losses.add(findings.TORN_WORD(), n_torn)
        losses.add(findings.EVENTS_UNTIMED(), decoder.n_untimed)
        losses.add(findings.TIME_WORDS_REPAIRED(), decoder.n_repaired)
        losses.add(findings.UNKNOWN_WORDS(), decoder.n_unknown)


def _read_header(file: BinaryIO) -> dict[str, str]:
    """Read "% key value" lines, up to the first other line or "% end"."""
    header: dict[str, str] = {}
    while True:
        begin = file.tell()
        line = file.readline()
        if not line.startswith(b"% ") or not line.endswith(b"\n"):
            file.seek(begin)
            return header
        key, _, value = line[2:].decode("utf-8", errors="replace").strip().partition(" ")
        if key == "end":
            return header
        header[key] = value
