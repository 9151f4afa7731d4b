"""A VLP-16 on the network: UDP packets in, scans of one revolution each out."""

import select
import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

from lce_rig.core import velodyne
from lce_rig.core.data import Scan
from lce_rig.core.errors import SourceError
from lce_rig.rig import LidarSettings
from lce_rig.sources.datagrams import Datagram
from lce_rig.sources.live.base import Mailbox, SourceStatus
from lce_rig.sources.live.vlp16_recorder import PcapRecorder
from lce_rig.sources.live.vlp16_silence import explain_silence
from lce_rig.sources.live.vlp16_socket import UdpPort
from lce_rig.sources.live.vlp16_status import Reception, to_status
from lce_rig.sources.velodyne_controls import read_controls
from lce_rig.sources.velodyne_stream import Vlp16Stream

SILENCE_S = 2.0
_WAIT_S = 0.1
# Half a second of scans: whoever is slower wants the newest.
N_SLOTS = 5
_N_RATED = 30
# A scan that is later than this lowers the rate.
_RATED_LATE_S = 0.5
_GATHER_S = 0.005


class Vlp16Source:
    """The scans of an attached VLP-16; open while its `with` block lasts.

    `driver.address` is whose packets are taken, those of the VLP-16 heard first where it is not set;
    `driver.port` is the port of data packets (2368); `driver.controls` may hold what `Vlp16Controls` does.

    Attributes:
        sensor: its name in the profile.
    """

    def __init__(
        self,
        sensor: str,
        settings: LidarSettings,
        *,
        silence_s: float = SILENCE_S,
        n_slots: int = N_SLOTS,
        record_to: Path | None = None,
        web_port: int = 80,
    ) -> None:
        """Take the settings; nothing is opened yet.

        Args:
            sensor: its name in the profile.
            settings: its block of the profile.
            silence_s: without packets for so long, it is taken to be gone.
            n_slots: scans that wait for a slow taker; the oldest are dropped.
            record_to: a pcap file for the raw packets; it must not exist.
            web_port: of the sensor's web server, which is asked when no packets come.
        """
        self.sensor = sensor
        self._settings = settings
        self._silence_s = silence_s
        self._n_slots = n_slots
        self._record_to = record_to
        self._web_port = web_port
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._has_begun = threading.Event()
        self._reset()

    def _reset(self) -> None:
        self._mailbox: Mailbox[Scan] = Mailbox(self._n_slots)
        self._reception = Reception()
        self._stream: Vlp16Stream | None = None
        self._recorder: PcapRecorder | None = None
        self._ports: tuple[UdpPort, ...] = ()
        self._thread: threading.Thread | None = None
        self._arrivals_s: deque[float] = deque(maxlen=_N_RATED)
        self._stop.clear()
        self._has_begun.clear()

    def __enter__(self) -> "Vlp16Source":
        """Open the ports and wait for the first packet.

        Raises:
            SourceError: no packets come, or those of another model; a port is held by another program;
                velodyne-decoder is not installed; the recording cannot be made.
        """
        self._reset()
        self._stream = Vlp16Stream(self.sensor, self._settings)
        try:
            self._open()
            self._has_begun.wait()
            if self._mailbox.is_ended:
                self._mailbox.take(0)  # Raises what the thread found.
        except BaseException:  # Ctrl-C while waiting, too.
            self._close()
            raise
        return self

    def _open(self) -> None:
        position_port = read_controls(self.sensor, self._settings).position_port
        data = UdpPort(self._settings.driver.port or velodyne.DATA_PORT, f"{self.sensor}: data packets")
        self._ports = (data,)
        self._ports = data, UdpPort(position_port, f"{self.sensor}: position packets")
        if self._record_to is not None:
            self._recorder = PcapRecorder(self._record_to)
        thread = threading.Thread(target=self._run, name=f"read {self.sensor}", daemon=True)
        thread.start()
        self._thread = thread  # Closing, which another thread may do meanwhile, waits for one that has begun.

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop reading and close the ports."""
        self._close()

    def samples(self) -> Iterator[Scan]:
        """Yield scans as they are completed, until the source is closed.

        Raises:
            SourceError: no packets came for `silence_s`; the hint says what to check.
        """
        yield from self._mailbox.items(_WAIT_S)

    def status(self) -> SourceStatus:
        """Say how the sensor does; may be called from any thread."""
        with self._lock:
            reception = self._reception
            reception.n_dropped = self._mailbox.n_dropped
            reception.rate_hz = self._rate_hz()
            reception.n_overflowed = sum(port.n_overflowed for port in self._ports)
            reception.granted_bytes = min((port.granted_bytes for port in self._ports), default=0)
            return to_status(self.sensor, self._settings, self._stream, reception, self._recorder)

    def _rate_hz(self) -> float:
        """Scans a second; falls to 0 as nothing comes."""
        arrivals_s = self._arrivals_s
        if len(arrivals_s) < 2:
            return 0.0
        until_s = max(arrivals_s[-1], time.monotonic() - _RATED_LATE_S)
        return (len(arrivals_s) - 1) / (until_s - arrivals_s[0])

    def _close(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        for port in self._ports:
            port.close()
        if self._recorder is not None:
            self._recorder.close()
        self._mailbox.close()

    def _run(self) -> None:
        error: SourceError | None = None
        try:
            self._read()
        except SourceError as failure:
            error = failure
        except OSError as failure:
            error = SourceError(f"{self.sensor}: the network failed: {failure.strerror}", "Check the cable.")
        except Exception as failure:  # A bug must not look like the end of the stream.
            error = SourceError(
                f"{self.sensor}: its packets could not be read: {failure!r}", "Please report it."
            )
            error.__cause__ = failure
        finally:
            self._mailbox.close(error)
            self._has_begun.set()

    def _read(self) -> None:
        """Take packets as they come, until told to stop.

        Raises:
            SourceError: no packet was taken for too long.
            OSError: the network failed.
        """
        assert self._stream is not None
        heard_s = time.monotonic()
        while not self._stop.is_set():
            ready, _, _ = select.select(self._ports, (), (), _WAIT_S)
            n_before = self._stream.counts.n_data
            for port in ready:
                is_data = port is self._ports[0]
                for datagram in port.receive_many():
                    self._take(datagram, self._stream, is_data=is_data)
            if self._stream.counts.n_data > n_before:
                heard_s = time.monotonic()
                self._has_begun.set()
                # The kernel has stamped what comes meanwhile: several packets cost hardly more than one.
                time.sleep(_GATHER_S)
            elif time.monotonic() - heard_s > self._silence_s:
                raise explain_silence(
                    self.sensor,
                    self._settings,
                    self._stream,
                    self._reception,
                    self._silence_s,
                    self._web_port,
                )

    def _take(self, datagram: Datagram, stream: Vlp16Stream, *, is_data: bool) -> None:
        address = self._settings.driver.address or self._reception.address
        if address and datagram.source != address:
            self._reception.see_stranger(datagram.source)
            return
        if self._recorder is not None:
            self._recorder.put(datagram)
        with self._lock:
            if not is_data:
                stream.push_position(datagram.payload, datagram.host_ns)
                return
            scan = stream.push_data(datagram.payload, datagram.host_ns)
            if stream.counts.n_data and not self._reception.address:
                self._reception.address = datagram.source
            if scan is not None:
                self._arrivals_s.append(time.monotonic())
        if scan is not None:
            self._mailbox.put(scan)
