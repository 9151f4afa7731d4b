"""Raw streams beside captures, written in a thread: a slow disk costs samples of them, and no guidance."""

import threading
from pathlib import Path
from types import TracebackType

import numpy as np

from lce_rig.core.data import Events, Image, Sample, Scan
from lce_rig.core.errors import SourceError
from lce_rig.devices.protocol import Mailbox
from lce_rig.recordings.folder.folder_recorder import FolderRecorder
from lce_rig.rig import Rig

#: What may wait for the disk.
MOST_WAITING_BYTES = 512 * 2**20
_WAIT_S = 0.2


class SampleRecorder:
    """Writes samples into a folder; open while its `with` block lasts.

    What the disk cannot take in time is left out and counted; a full disk ends the recording, nothing else.

    Attributes:
        n_written, n_left_out: samples.
    """

    def __init__(self, folder: Path, rig: Rig, but_not: frozenset[str] = frozenset()) -> None:
        """Prepare.

        Args:
            folder: a new one.
            rig: the profile.
            but_not: sensors whose sources record for themselves.
        """
        self.n_written = self.n_left_out = 0
        self._folder = folder
        self._rig = rig
        self._but_not = but_not
        self._queue: Mailbox[Sample] = Mailbox(100_000)
        self._n_waiting_bytes = 0
        self._lock = threading.Lock()
        self._failure: SourceError | None = None
        self._thread = threading.Thread(target=self._run, name="record samples", daemon=True)

    def __enter__(self) -> "SampleRecorder":
        """Make the folder.

        Raises:
            SourceError: it is there already, or cannot be made.
        """
        self._writer = FolderRecorder(self._folder, self._rig)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write what waits, and finish the files."""
        self._queue.close()
        self._thread.join()
        try:
            self._writer.close()
        except SourceError as failure:
            self._failure = self._failure or failure

    def put(self, sample: Sample) -> None:
        """Take a sample; never blocks."""
        if sample.sensor in self._but_not or self._failure is not None:
            return
        n_bytes = _size_bytes(sample)
        with self._lock:
            if self._n_waiting_bytes + n_bytes > MOST_WAITING_BYTES:
                self.n_left_out += 1
                return
            self._n_waiting_bytes += n_bytes
        self._queue.put(sample)

    def problems(self) -> list[str]:
        """Say what is missing in the recording, and why."""
        found = []
        if self._failure is not None:
            found.append(f"the recording has ended: {self._failure.what}")
        if self.n_left_out:
            found.append(f"the disk was too slow for {self.n_left_out} samples of the recording")
        return found

    def _run(self) -> None:
        for sample in self._queue.items(_WAIT_S):
            with self._lock:
                self._n_waiting_bytes -= _size_bytes(sample)
            if self._failure is not None:
                continue
            try:
                self._writer.write(sample)
                self.n_written += 1
            except (SourceError, ValueError) as error:
                self._failure = error if isinstance(error, SourceError) else SourceError(str(error))


def _size_bytes(sample: Sample) -> int:
    arrays: tuple[np.ndarray | None, ...]
    if isinstance(sample, Image):
        arrays = (sample.pixels,)
    elif isinstance(sample, Scan):
        arrays = (sample.points, sample.intensity, sample.ring, sample.offset_ns)
    else:
        assert isinstance(sample, Events)
        arrays = (sample.t_ns, sample.x, sample.y, sample.polarity)
    return sum(array.nbytes for array in arrays if array is not None)
