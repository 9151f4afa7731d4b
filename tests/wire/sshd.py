"""A private OpenSSH server on this computer, with its own keys, for deployments over a real connection."""

import getpass
import os
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path

SSHD = shutil.which("sshd", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")
_START_S = 60.0


class NoServerError(Exception):
    """sshd is missing or does not start."""


class Sshd:
    """A server on 127.0.0.1 that lets this user in by a key; a context manager."""

    def __init__(self, folder):
        """Make keys and start it."""
        if SSHD is None or shutil.which("ssh-keygen") is None:
            raise NoServerError("sshd or ssh-keygen is not installed")
        folder.mkdir(parents=True, exist_ok=True)
        for name in ("host_key", "user_key"):
            words = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(folder / name)]
            subprocess.run(words, check=True, stdin=subprocess.DEVNULL)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        (folder / "authorized_keys").write_bytes((folder / "user_key.pub").read_bytes())
        kind, key, *_ = (folder / "host_key.pub").read_text().split()
        (folder / "known_hosts").write_text(f"[127.0.0.1]:{port} {kind} {key}\n")
        lines = [
            *(f"Port {port}", "ListenAddress 127.0.0.1", f"HostKey {folder / 'host_key'}"),
            *(f"AuthorizedKeysFile {folder / 'authorized_keys'}", "PidFile none", "StrictModes no"),
            *("UsePAM no", "PasswordAuthentication no", "PermitRootLogin prohibit-password"),
            # A login shell's set-up is slow, and killing it could leave locks behind.
            f"SetEnv HOME={folder}",
            *("Subsystem sftp internal-sftp", "MaxStartups 100", "LogLevel ERROR"),
        ]
        (folder / "sshd_config").write_text("\n".join(lines) + "\n")
        if os.geteuid() == 0:
            Path("/run/sshd").mkdir(exist_ok=True)  # of privilege separation
        self.to = f"{getpass.getuser()}@127.0.0.1"
        self.options = {
            "Port": port,
            "IdentityFile": str(folder / "user_key"),
            "IdentitiesOnly": "yes",
            "UserKnownHostsFile": str(folder / "known_hosts"),
        }
        self._log = (folder / "sshd.log").open("wb")
        self._process = subprocess.Popen(
            [SSHD, "-D", "-e", "-f", str(folder / "sshd_config")],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
        )
        self._wait(folder, port)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.lose_connections()
        self._process.terminate()
        self._process.wait()
        self._log.close()

    def lose_connections(self):
        """Kill the connections' server processes and their children; return the number of processes."""
        found = _below(self._process.pid)
        for number in found:
            try:
                os.kill(number, signal.SIGKILL)
            except ProcessLookupError:
                continue
        return len(found)

    def _wait(self, folder, port):
        words = ["ssh", "-o", "BatchMode=yes", *self._words(), self.to, "true"]
        deadline_s = time.monotonic() + _START_S
        while time.monotonic() < deadline_s and self._process.poll() is None:
            done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, check=False)
            if done.returncode == 0:
                return
            time.sleep(0.1)
        self.__exit__()
        raise NoServerError((folder / "sshd.log").read_text(errors="replace")[-500:])

    def _words(self):
        return [word for name, value in self.options.items() for word in ("-o", f"{name}={value}")]


def _below(process):
    """List the processes that a process has started, and those that they have, by /proc."""
    parents = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(entry.read_text().rpartition(")")[2].split()[1])
        except (OSError, IndexError, ValueError):
            continue
        parents.setdefault(parent, []).append(int(entry.parent.name))
    found, left = [], [process]
    while left:
        children = parents.get(left.pop(), [])
        found += children
        left += children
    return found
