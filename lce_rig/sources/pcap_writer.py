"""Writing pcap files that tcpdump, Wireshark and VeloView open: datagrams with their arrival."""

import struct
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from lce_rig.sources.datagrams import ETHERNET, Datagram, build_frame

_NS_MAGIC = 0xA1B23C4D
_MAX_FRAME_BYTES = 65535
_NS_PER_S = 1_000_000_000


class PcapWriter:
    """A pcap file with arrivals in ns; a context manager. Torn off anywhere, it is read up to there.

    Raises:
        FileExistsError: the file is there already.
        OSError: it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._file: BinaryIO = path.open("xb")
        self._file.write(struct.pack("<IHHiIII", _NS_MAGIC, 2, 4, 0, 0, _MAX_FRAME_BYTES, ETHERNET))

    def write(self, datagram: Datagram) -> None:
        """Append a datagram.

        Raises:
            OSError: it cannot be written; the disk may be full.
        """
        frame = build_frame(datagram)
        seconds, ns = divmod(datagram.host_ns, _NS_PER_S)
        self._file.write(struct.pack("<IIII", seconds, ns, len(frame), len(frame)) + frame)

    def flush(self) -> None:
        """Hand what was written to the operating system: it survives the death of this program."""
        self._file.flush()

    def close(self) -> None:
        """Write what waits, and close the file.

        Raises:
            OSError: it cannot be written; the disk may be full.
        """
        self._file.close()

    def __enter__(self) -> "PcapWriter":
        """Write within a `with` block."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file."""
        self.close()
