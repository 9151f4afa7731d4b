"""`lce-rig collect` in a separate process, observed by its output and files."""

import signal
import subprocess
import sys
import time

from lce_rig.session import Session
from wire.rig import ENVIRONMENT

_MAIN = "from lce_rig.cli.main import main; main()"


class Collecting:
    """A running `lce-rig collect --plain`; it is killed where the `with` block ends before it does."""

    def __init__(self, profile, session, *options, prelude=""):
        """Prepare."""
        self.session = session
        self._log = session.with_name(f"{session.name}.{time.monotonic_ns()}.log")
        words = ["collect", "--rig", str(profile), str(session), "--plain", *options]
        self._command = [sys.executable, "-c", f"{prelude}\n{_MAIN}", *words]

    def __enter__(self):
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.DEVNULL, stderr=log, stdout=log, env=ENVIRONMENT
            )
        return self

    def __exit__(self, kind, error, trace):
        self._process.kill()
        self._process.wait()

    @property
    def pid(self):
        """Of the process."""
        return self._process.pid

    @property
    def said(self):
        """Output to the terminal so far."""
        return self._log.read_text(errors="replace")

    @property
    def n_captures(self):
        """Captures that are listed in the session."""
        marker = self.session / "session.json"
        return len(Session.open(self.session).captures) if marker.exists() else 0

    def wait_for(self, text, within_s=180.0, times=1):
        """Wait until the output contains a text a given number of times."""
        self._wait(lambda: self.said.count(text) >= times, f"{text!r} was not said", within_s)

    def wait_for_captures(self, n, within_s=180.0):
        """Wait until the session has a given number of captures."""
        self._wait(lambda: self.n_captures >= n, f"there are not {n} captures", within_s)

    def wait(self, within_s=180.0):
        """Wait for its end, and give its exit code."""
        return self._process.wait(within_s)

    def end(self, number=signal.SIGTERM):
        """Send it a signal, and give its exit code."""
        self._process.send_signal(number)
        return self.wait()

    def _wait(self, is_so, otherwise, within_s):
        deadline_s = time.monotonic() + within_s
        while not is_so():
            code = self._process.poll()
            assert code is None or is_so(), f"{otherwise}; it ended with {code}:\n{self.said}"
            assert time.monotonic() < deadline_s, f"{otherwise} in {within_s} s:\n{self.said}"
            time.sleep(0.02)
