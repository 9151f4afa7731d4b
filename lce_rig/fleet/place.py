"""A deployment folder, on this computer or on another one by OpenSSH's ssh and scp.

A target is a folder:

    current -> releases/20261123T021501Z-ab12cd34      read by robot software
    releases/20261123T021501Z-ab12cd34/                a set of files, never changed, and its record RECORD
    deployments.log                                    one JSON object per line, for people
    .pending                                           the release whose command has not succeeded yet

A set is written into a release of its own and becomes current by one rename of the link. An interruption
leaves `current` on the earlier set or the new one. Nothing is removed before that rename, and afterwards only
releases: folders named as above, with a record.

All steps at the target are POSIX shell scripts, the same for both kinds of target. Names and texts are
arguments of the scripts, never part of them. `current` and `releases` not created by lce-rig are refused and
left unchanged.
"""

import os
import shlex
import shutil
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryFile
from threading import Thread
from typing import IO, NamedTuple

from lce_rig.core.errors import TargetError
from lce_rig.fleet.target import TargetSettings

UNWRITABLE, NOT_OURS, LOCKED, CHANGED, NO_RELEASE = 73, 74, 75, 76, 77
"""Exit codes of the scripts."""
SAYS = "lce-rig "
"""Prefix of each line of their output; a login shell may print lines of its own."""
RECORD, USED = ".deployed.json", ".used"
"""Files of a release that are not of the set; USED marks one that has been current."""
MAX_OUTPUT = 1 << 24
"""Bytes of a program's output that are kept, the last ones."""
_RUN_OUTPUT = 1 << 16
# Longest time of a script, and of a copy, s; largest file and set that are copied, KiB.
_SCRIPT_S, _COPY_S = 120.0, 1800.0
_LARGEST_KB = 4 << 20
_LOST = 255
# ssh must not prompt, and unresponsive connections end.
_SSH = {"BatchMode": "yes", "ConnectTimeout": "10", "ServerAliveInterval": "5", "ServerAliveCountMax": "3"}
_HINTS = {
    LOCKED: "Wait for the other deployment to end.",
    NOT_OURS: "Move it away, or name another folder in `to`.",
    NO_RELEASE: "Another deployment has removed it. Run the same command again.",
}
_NAMED = "[0-9]" * 8 + "T" + "[0-9]" * 6 + "Z-" + "[0-9a-f]" * 8

_COMMON = rf"""
set -u
unset CDPATH
LC_ALL=C
p=$1
die() {{ echo "$2" >&2; exit "$1"; }}
enter() {{ cd -- "$p" || die {UNWRITABLE} "$p cannot be entered"; }}
flush() {{ sync -f "$1" 2>/dev/null || sync; }}
is_plain() {{ [ -f "$1" ] && ! [ -L "$1" ]; }}
is_named() {{ case $1 in {_NAMED}) return 0 ;; *) return 1 ;; esac; }}
is_release() {{
  is_named "$1" && [ -d "releases/$1" ] && ! [ -L "releases/$1" ] && is_plain "releases/$1/{RECORD}"
}}
# Sets c to the current release; ends where something is in place that lce-rig has not made.
check() {{
  c=
  for f in .lock .pending deployments.log; do
    if [ -L "$f" ] || {{ [ -e "$f" ] && ! [ -f "$f" ]; }}; then die {NOT_OURS} "$p/$f is no plain file"; fi
  done
  if [ -L current ]; then
    c=$(readlink current)
    is_release "${{c#releases/}}" && [ "$c" = "releases/${{c#releases/}}" ] ||
      die {NOT_OURS} "$p/current leads to $c, which lce-rig has not deployed or is damaged"
    c=${{c#releases/}}
  elif [ -e current ]; then die {NOT_OURS} "$p/current is no link"; fi
  if [ -L releases ]; then die {NOT_OURS} "$p/releases is a link"; fi
  if [ -e releases ]; then
    [ -d releases ] || die {NOT_OURS} "$p/releases is no folder"
    for r in releases/*; do
      if is_named "${{r#releases/}}" || ! [ -e "$r" ]; then return 0; fi
    done
    die {NOT_OURS} "$p/releases holds other things than releases of lce-rig"
  fi
}}
# The kernel drops the lock with its holder.
lock() {{
  command -v flock >/dev/null 2>&1 || return 0
  exec 9>.lock || die {UNWRITABLE} "$p cannot be written"
  flock -w 10 9 || die {LOCKED} "another deployment is at work"
}}
"""

STATE = rf"""{_COMMON}
main() {{
  [ -d "$p" ] || {{ echo '{SAYS}current '; return 0; }}
  enter
  check
  echo '{SAYS}current '"$c"
  if is_plain .pending; then echo '{SAYS}pending '"$(head -c 64 .pending)"; fi
  for r in releases/*; do
    r=${{r#releases/}}
    is_release "$r" || continue
    [ -e "releases/$r/{USED}" ] || [ "$r" = "$c" ] || continue
    printf '{SAYS}release %s ' "$r"
    head -c 1000000 "releases/$r/{RECORD}"
    echo
  done
}}
main
"""
"""Print the state of a target, and change nothing: PATH."""

STAGE = rf"""{_COMMON}
main() {{
  mkdir -p -- "$p" || die {UNWRITABLE} "$p cannot be made"
  enter
  check
  mkdir -p releases && mkdir "releases/$name" && cat >"releases/$name/{RECORD}" ||
    die {UNWRITABLE} "$p cannot be written"
}}
name=$2
main
"""
"""Make a release that holds its record, from stdin: PATH, RELEASE."""

COMMIT = rf"""{_COMMON}
# Finish the switch even if the connection ends.
trap '' HUP INT TERM PIPE
main() {{
  enter
  lock
  check
  [ "$c" = "$expected" ] || die {CHANGED} "$c is current"
  is_release "$name" || die {NO_RELEASE} "there is no release $name"
  flush "releases/$name"
  if [ -n "$c" ]; then : >>"releases/$c/{USED}" || die {UNWRITABLE} "$p/releases cannot be written"; fi
  if [ -n "$pending" ]; then
    printf '%s\n' "$name" >.pending || die {UNWRITABLE} "$p cannot be written"
  fi
  ln -sfn "releases/$name" .current.new && mv -fT .current.new current ||
    die {UNWRITABLE} "$p cannot be written"
  : >>"releases/$name/{USED}"
  printf '%s\n' "$line" >>deployments.log
  flush .
  # From here on nothing is checked any more: the oldest releases go, and those that never became current.
  n=0
  for r in releases/*; do
    if is_release "${{r#releases/}}" && [ -e "$r/{USED}" ]; then n=$((n + 1)); fi
  done
  for r in releases/*; do
    if ! is_release "${{r#releases/}}" || [ "$r" = "releases/$name" ] || [ "$r" = "releases/$expected" ]; then
      continue
    fi
    if [ -e "$r/{USED}" ]; then
      [ "$n" -gt "$keep" ] || continue
      n=$((n - 1))
    fi
    # The record goes last, so that an interrupted removal is continued.
    rm -f -- "$r/{USED}"
    rm -rf -- "$r"/*
    rm -rf -- "$r"
  done
}}
name=$2 expected=$3 keep=$4 pending=$5 line=$6
main
"""
"""Make a release current: PATH, RELEASE, EXPECTED current one, KEEP, PENDING, LINE of the log."""

DISCARD = rf"""{_COMMON}
main() {{
  enter
  check
  if is_release "$2" && [ "$2" != "$c" ] && ! [ -e "releases/$2/{USED}" ]; then rm -rf -- "releases/$2"; fi
}}
main "$@"
"""
"""Remove a release that has not been current: PATH, RELEASE."""

RUN = rf"""{_COMMON}
main() {{
  enter
  check
  limit=timeout
  command -v timeout >/dev/null 2>&1 || limit=
  ( cd current && exec ${{limit:+timeout "$seconds"}} sh -c "$command" sh "$robot" ) </dev/null 2>&1
  code=$?
  if [ "$code" -eq 0 ] && [ "$(head -c 64 .pending 2>/dev/null)" = "$name" ]; then rm -f .pending; fi
  printf '{{"action": "run", "release": "%s", "exit": %s}}\n' "$name" "$code" >>deployments.log
  echo '{SAYS}exit '"$code"
}}
name=$2 seconds=$3 command=$4 robot=$5
main | tail -c {_RUN_OUTPUT}
"""
"""Run a command in the current set: PATH, RELEASE, SECONDS, COMMAND, ROBOT. Its exit code comes last."""

_ODD = rf"""{_COMMON}
main() {{
  enter
  cd -- "$2" || die {NO_RELEASE} "there is no $2"
  find . ! -type d ! -type f | head -n 20
  find . -type f -size +{_LARGEST_KB}k | head -n 20
  [ "$(du -sk . | cut -f 1)" -le {_LARGEST_KB} ] || echo .
}}
main "$@"
"""
"""Print the entries of a folder that are no plain files, or too large to be copied: PATH, FOLDER."""


class LostError(TargetError):
    """The connection was lost or never established."""


class Ran(NamedTuple):
    """An ended program: its exit code, and the last `MAX_OUTPUT` bytes of both outputs."""

    code: int
    out: str
    err: str


def run_bounded(words: Sequence[str], timeout_s: float, content: bytes = b"") -> Ran:
    """Run a program in its own process group, up to a time limit, and keep the end of its output.

    Args:
        words: the program and its arguments; no shell reads them.
        timeout_s: time limit.
        content: standard input of the program.

    Raises:
        OSError: the program cannot be started.
        subprocess.TimeoutExpired: it did not end in time.
    """
    with TemporaryFile() as given:
        given.write(content)
        given.seek(0)
        process = subprocess.Popen(
            words,
            stdin=given,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
            start_new_session=True,
        )

    def keep_end(pipe: IO[bytes], kept: bytearray) -> None:
        with pipe:
            while chunk := pipe.read(1 << 16):
                kept += chunk
                del kept[:-MAX_OUTPUT]

    kept = bytearray(), bytearray()
    assert process.stdout is not None and process.stderr is not None
    pipes = ((process.stdout, kept[0]), (process.stderr, kept[1]))
    threads = [Thread(target=keep_end, args=pipe, daemon=True) for pipe in pipes]
    for thread in threads:
        thread.start()
    deadline_s = time.monotonic() + timeout_s
    try:
        process.wait(timeout_s)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        for thread in threads:
            # A process in the background may hold the pipe open.
            thread.join(max(1.0, min(5.0, deadline_s - time.monotonic())))
    return Ran(process.returncode, *(bytes(each).decode(errors="replace") for each in kept))


class Place:
    """A target's folder, local or remote; no connection is kept between calls.

    Attributes:
        path: path of the folder at the target.
        label: description of the target.
    """

    def __init__(self, target: TargetSettings) -> None:
        self.path, self.label, self._host = target.path, target.to, target.host
        options = _SSH | {name: str(value) for name, value in target.ssh.items()}
        self._options = [word for name, value in options.items() for word in ("-o", f"{name}={value}")]

    def command(self, script: str, *arguments: str) -> list[str]:
        """Return the command that runs a POSIX script at the place, with the folder as its first argument."""
        words = ["sh", "-c", script, "sh", self.path, *arguments]
        if self._host is None:
            return words
        # One word, quoted for any login shell, so that no part of it is executed.
        host = self._host.replace("[", "").replace("]", "")
        return ["ssh", *self._options, "-T", "--", host, shlex.join(words)]

    def run(self, script: str, *arguments: str, content: bytes = b"", timeout_s: float = _SCRIPT_S) -> Ran:
        """Run a script at the place; any exit code is accepted.

        Raises:
            LostError: the connection was lost, or there never was one; or the script does not end.
        """
        return self._call(self.command(script, *arguments), timeout_s, content)

    def must_run(self, script: str, *arguments: str, content: bytes = b"") -> str:
        """Run a script at the place and return its output; raise if it fails.

        Raises:
            LostError: see `run`.
            TargetError: the script failed.
        """
        return self.check(self.run(script, *arguments, content=content)).out

    def check(self, ran: Ran) -> Ran:
        """Return a script's outcome if it succeeded.

        Raises:
            TargetError: the script failed.
        """
        if ran.code:
            hint = _HINTS.get(ran.code, "Check space and permissions there.")
            raise TargetError(f"{self.label}: {_last_line(ran.err)}", hint)
        return ran

    def put(self, folder: Path, name: str) -> None:
        """Copy the content of a local folder into an existing folder at the place.

        Raises:
            TargetError: the target cannot be reached or written; a part may have been copied.
        """
        if self._host is None:
            self._copy(folder, Path(self.path) / name)
        else:
            files = sorted(map(str, folder.iterdir()))
            self._scp(*files, f"{self._host}:{self.path}/{name}/")

    def get(self, name: str, folder: Path) -> list[str]:
        """Copy the folder of this name, with plain files, to a new local folder.

        Returns:
            The first of its entries that are not plain files, or too large; then nothing is copied.

        Raises:
            TargetError: the target cannot be reached or read.
        """
        odd = [line.removeprefix("./") for line in self.must_run(_ODD, name).splitlines() if line[:1] == "."]
        if odd:
            folder.mkdir()
        elif self._host is None:
            self._copy(Path(self.path) / name, folder)
        else:
            self._scp(f"{self._host}:{self.path}/{name}", str(folder))
        return odd

    def _copy(self, source: Path, target: Path) -> None:
        try:
            shutil.copytree(source, target, dirs_exist_ok=True)
        except OSError as error:  # The arguments of shutil.Error are those of each file.
            what = error.args[0] if isinstance(error, shutil.Error) else error.strerror
            what = what[0][2] if isinstance(what, list) else what
            raise TargetError(
                f"{target}: cannot be written: {what}", "Check space and permissions."
            ) from error

    def _scp(self, *names: str) -> None:
        ran = self._call(["scp", *self._options, "-q", "-B", "-r", "--", *names], _COPY_S)
        if ran.code:
            raise TargetError(
                f"{self.label}: copying failed: {_last_line(ran.err)}", "Check space and permissions there."
            )

    def _call(self, words: list[str], timeout_s: float, content: bytes = b"") -> Ran:
        try:
            ran = run_bounded(words, timeout_s, content)
        except FileNotFoundError:
            raise TargetError(f"{words[0]} is not installed", "Install openssh-client.") from None
        except subprocess.TimeoutExpired:
            raise LostError(f"{self.label}: no end after {timeout_s:g} s", "Check the connection.") from None
        except OSError as error:
            raise TargetError(f"{self.label}: {error.strerror or error}") from error
        if ran.code == _LOST:
            raise LostError(
                f"{self.label}: no connection: {_last_line(ran.err)}",
                "Check that `ssh` reaches it without a prompt, with the same options (port, key, host).",
            )
        return ran


def _last_line(text: str) -> str:
    """Return the last non-empty line; ssh prints warnings before the cause."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "no message"
