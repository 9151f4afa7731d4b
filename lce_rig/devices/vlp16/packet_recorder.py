"""Raw packets to disk beside the captures, by a thread of its own: a slow disk must not cost packets."""

import struct
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.devices.protocol import Mailbox
from lce_rig.recordings.velodyne.datagrams import ETHERNET, Datagram, build_frame

# Writing pcap files that tcpdump, Wireshark and VeloView open: datagrams with their arrival.

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


# Twenty seconds of packets, 25 MB: longer than a disk stalls.
_N_SLOTS = 16_384
_FLUSH_S = 1.0


class PcapRecorder:
    """Records datagrams until it is closed, or the disk is full.

    Attributes:
        path: the pcap file.
        n_written: datagrams on their way to the disk.
        failure: why recording stopped; None while it goes on.
    """

    def __init__(self, path: Path) -> None:
        """Create the file and start writing.

        Raises:
            SourceError: it is there already, or cannot be created.
        """
        self.path = path
        self.n_written = 0
        self.failure: Finding | None = None
        try:
            self._writer = PcapWriter(path)
        except FileExistsError:
            raise SourceError(f"{path} is there already", "Move it away, or record elsewhere.") from None
        except OSError as error:
            raise SourceError(f"{path}: cannot be recorded to: {error.strerror}") from None
        self._mailbox: Mailbox[Datagram] = Mailbox(_N_SLOTS)
        self._thread = threading.Thread(target=self._run, name=f"record {path.name}", daemon=True)
        self._thread.start()

    @property
    def n_dropped(self) -> int:
        """Datagrams that the disk was too slow for."""
        return self._mailbox.n_dropped

    def put(self, datagram: Datagram) -> None:
        """Record a datagram; never blocks."""
        if self.failure is None:
            self._mailbox.put(datagram)

    def close(self) -> None:
        """Write what waits and close the file."""
        self._mailbox.close()
        self._thread.join()

    def _run(self) -> None:
        try:
            with self._writer as writer:
                self._write_all(writer)
        except OSError as error:
            figures = {"path": str(self.path), "cause": error.strerror}
            self.failure = Finding("device.recording_stopped", "warning", figures=figures)

    def _write_all(self, writer: PcapWriter) -> None:
        flushed_s = time.monotonic()
        while not self._mailbox.is_ended:
            datagram = self._mailbox.take(_FLUSH_S)
            if datagram is not None:
                writer.write(datagram)
                self.n_written += 1
            if time.monotonic() - flushed_s > _FLUSH_S:
                writer.flush()
                flushed_s = time.monotonic()
