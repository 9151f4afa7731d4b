"""A sync board played by a thread at the other end of a pty: it drifts, resets, stalls, garbles, is gone."""

import errno
import os
import pty
import select
import threading
import time
import tty

from lce_rig.devices.lce1 import read_sentence, write_sentence

HELLO = "LCEHI,1,1.0,fake,1000000"


class FakeBoard:
    """Talks like a sync board while its block lasts."""

    def __init__(
        self,
        drift=40e-6,
        uptime_us=5_000_000,
        period_s=0.01,
        garbage_every=0,
        hello=HELLO,
        is_mute=False,
        knows_utc=False,
    ):
        """Prepare; with `knows_utc` pulses come at multiples of the period of UTC and name their seconds."""
        self.knows_utc = knows_utc
        self.drift, self.uptime_us, self.period_s = drift, uptime_us, period_s
        self.garbage_every, self.hello, self.is_mute = garbage_every, hello, is_mute
        self.commands, self.n_sent, self.n_pps = [], 0, 0
        self.started_ns = time.time_ns()
        self.n_to_lose = 0
        self.has_gone = self.is_stalled = False
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self):
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._thread.start()
        return self

    def __exit__(self, *_):
        if not self.has_gone:
            self.unplug()

    def board_us(self, host_ns=None):
        """Read the board's clock, now or at a moment of the host's."""
        elapsed_ns = (time.time_ns() if host_ns is None else host_ns) - self.started_ns
        return int(elapsed_ns * (1 + self.drift) / 1000) + self.uptime_us

    def host_ns(self, board_ns):
        """The exact time of day of a board time."""
        return self.started_ns + (board_ns - 1000 * self.uptime_us) / (1 + self.drift)

    def reset(self, says_hello=True):
        """Restart: time and numbers from 0."""
        with self._lock:
            self._say(b"$LCETG,0,12")
            self.started_ns, self.uptime_us, self.n_sent, self.n_pps = time.time_ns(), 0, 0, 0
            if says_hello:
                self._say(write_sentence(self.hello))

    def unplug(self):
        """Be gone: the thread ends first, since it uses the port."""
        self.has_gone = True
        self._thread.join()
        os.close(self._slave)
        os.close(self._master)

    def _run(self):
        period_ns, rest = round(self.period_s * 1e9), b""
        due_ns = (time.time_ns() // period_ns + 1) * period_ns
        while not self.has_gone:
            if select.select([self._master], [], [], 0.001)[0]:
                rest = self._answer(rest + self._read())
            if time.time_ns() >= due_ns and not self.is_mute:
                with self._lock:
                    self._pulse(due_ns)
                due_ns += period_ns

    def _read(self):
        try:
            return os.read(self._master, 4096)
        except OSError as error:
            assert error.errno == errno.EIO
            return b""

    def _answer(self, data):
        *lines, rest = data.split(b"\n")
        for line in lines:
            rx_us = self.board_us()
            words = read_sentence(line.strip()).split(b",")
            self.commands.append(b",".join(words).decode())
            with self._lock:
                if self.is_mute or self.is_stalled:
                    continue
                if words[0] == b"LCEHI?":
                    self._say(write_sentence(self.hello))
                elif words[0] == b"LCETM?":
                    self._say(write_sentence(f"LCETM,{words[1].decode()},{rx_us},{self.board_us()}"))
        return rest

    def _pulse(self, due_ns):
        if self.is_stalled:
            return
        self.n_sent += 1
        number, t_us = self.n_sent, self.board_us(due_ns if self.knows_utc else None)
        if self.n_to_lose:
            self.n_to_lose -= 1
            return
        if self.garbage_every and number % self.garbage_every == 0:
            self._say(b"\xff\x00\x80$LCETG,0,1,2,R*00\r\nnoise\xfe\n")
        self._say(write_sentence(f"LCETG,0,{number},{t_us},R"))
        self._say(write_sentence(f"LCETG,0,{number},{t_us + 100},F"))
        if due_ns % 10**9 == 0 if self.knows_utc else number % 10 == 1:
            self.n_pps += 1
            utc = f"{due_ns // 10**9},G" if self.knows_utc else ",I"
            self._say(write_sentence(f"LCEPP,{self.n_pps},{t_us},{utc}"))

    def _say(self, data):
        while data and not self.has_gone:
            if select.select([], [self._master], [], 0.01)[1]:
                data = data[os.write(self._master, data) :]
