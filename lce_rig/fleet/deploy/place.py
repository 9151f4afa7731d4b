"""A folder where results are deployed to: on this computer, or on another one by OpenSSH's ssh and scp."""

import shlex
import shutil
import subprocess
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

from lce_rig.core.errors import TargetError
from lce_rig.rig.target_settings import TargetSettings

_SCRIPT_S, _COPY_S = 120.0, 1800.0
_LOST = 255
# Nobody is there to answer questions; a connection without an answer ends.
_SSH = {"BatchMode": "yes", "ConnectTimeout": "10", "ServerAliveInterval": "5", "ServerAliveCountMax": "3"}


class LostError(TargetError):
    """The connection was lost, or there never was one."""


@dataclass(frozen=True)
class Ran:
    """What a script did.

    Attributes:
        code: its exit code.
        out, err: what it printed.
    """

    code: int
    out: str
    err: str


class Place(ABC):
    """A folder somewhere.

    Attributes:
        path: of the folder, there.
        label: the target in words.
    """

    path: str
    label: str

    @abstractmethod
    def command(self, script: str, *arguments: str) -> list[str]:
        """Give the words that run a POSIX script there, with the folder's path as its first argument."""

    @abstractmethod
    def put(self, folder: Path, name: str) -> None:
        """Copy a folder to a new one of this name there.

        Raises:
            TargetError: it cannot be reached or written; part of it may be there.
        """

    @abstractmethod
    def get(self, name: str, folder: Path) -> None:
        """Copy a folder of this name there to a new one here.

        Raises:
            TargetError: it cannot be reached or read.
        """

    def run(self, script: str, *arguments: str, timeout_s: float = _SCRIPT_S) -> Ran:
        """Run a script there.

        Raises:
            LostError: the connection was lost, or there never was one; or the script does not end.
        """
        ran = _call(self.command(script, *arguments), self.label, timeout_s)
        if ran.code == _LOST:
            raise _lost(self.label, ran.err)
        return ran


class LocalPlace(Place):
    """A folder on this computer."""

    def __init__(self, path: str) -> None:
        self.path = self.label = path

    def command(self, script: str, *arguments: str) -> list[str]:
        """Run it by sh."""
        return ["sh", "-c", script, "sh", self.path, *arguments]

    def put(self, folder: Path, name: str) -> None:
        """Copy a folder; see `Place`."""
        self._copy(folder, Path(self.path) / name)

    def get(self, name: str, folder: Path) -> None:
        """Copy a folder; see `Place`."""
        self._copy(Path(self.path) / name, folder)

    def _copy(self, source: Path, target: Path) -> None:
        try:
            shutil.copytree(source, target)
        except OSError as error:  # shutil.Error, too, whose arguments are those of each file.
            what = error.args[0] if isinstance(error, shutil.Error) else error.strerror
            what = what[0][2] if isinstance(what, list) else what
            raise TargetError(
                f"{target}: cannot be written: {what}", "Free space, or see to its permissions."
            ) from error


class SshPlace(Place):
    """A folder on another computer."""

    def __init__(self, target: TargetSettings) -> None:
        assert target.host is not None
        self.path, self.label, self._host = target.path, target.to, target.host
        options = _SSH | {name: str(value) for name, value in target.ssh.items()}
        self._options = [word for name, value in options.items() for word in ("-o", f"{name}={value}")]

    def command(self, script: str, *arguments: str) -> list[str]:
        """Run it by sh there, whatever the login shell is: one word, so that no part of it runs alone."""
        words = shlex.join(["sh", "-c", script, "sh", self.path, *arguments])
        return ["ssh", *self._options, "-T", "--", self._host.replace("[", "").replace("]", ""), words]

    def put(self, folder: Path, name: str) -> None:
        """Copy a folder; see `Place`."""
        self._copy(str(folder), f"{self._host}:{self.path}/{name}")

    def get(self, name: str, folder: Path) -> None:
        """Copy a folder; see `Place`."""
        self._copy(f"{self._host}:{self.path}/{name}", str(folder))

    def _copy(self, source: str, target: str) -> None:
        ran = _call(["scp", *self._options, "-q", "-B", "-r", "--", source, target], self.label, _COPY_S)
        if ran.code == _LOST:
            raise _lost(self.label, ran.err)
        if ran.code:
            raise TargetError(
                f"{self.label}: copying failed: {last_line(ran.err)}", "Check space and rights."
            )


def open_place(target: TargetSettings) -> Place:
    """Give the place of a target; nothing is connected yet."""
    return LocalPlace(target.to) if target.host is None else SshPlace(target)


def last_line(text: str) -> str:
    """Give the last line that says anything; ssh prints warnings before the cause."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "no message"


def _call(words: list[str], label: str, timeout_s: float) -> Ran:
    try:
        done = subprocess.run(
            words, stdin=subprocess.DEVNULL, capture_output=True, timeout=timeout_s, check=False
        )
    except FileNotFoundError:
        raise TargetError(f"{words[0]} is not installed", "Install openssh-client.") from None
    except subprocess.TimeoutExpired as error:
        said = (error.stdout or b"").decode(errors="replace") if isinstance(error.stdout, bytes) else ""
        raise LostError(f"{label}: no end after {timeout_s:g} s", last_line(said) if said else "") from None
    return Ran(done.returncode, done.stdout.decode(errors="replace"), done.stderr.decode(errors="replace"))


def _lost(label: str, said: str) -> LostError:
    hint = "Check that `ssh` reaches it without a question, with the same options (port, key, known host)."
    return LostError(f"{label}: no connection: {last_line(said)}", hint)
