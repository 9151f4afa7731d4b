"""Raw packets to disk beside the captures, by a thread of its own: a slow disk must not cost packets."""

import threading
import time
from pathlib import Path

from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.sources.datagrams import Datagram
from lce_rig.sources.live.base import Mailbox
from lce_rig.sources.pcap_writer import PcapWriter

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
