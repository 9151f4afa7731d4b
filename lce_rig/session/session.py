"""A session folder: the copied rig profile, captures, a journal and a cache of detections.

Layout, every file plain: rig.yaml, session.json, journal.jsonl, detections/ and captures/000012/{meta.json,
cam.frames.png, lidar.pcd, cam.events.npz}. A capture is written to captures/.new-000012/, its files are
flushed, the folder is renamed and its parent flushed: it exists completely or not at all, even after a power
failure. The folder of a rejected capture is moved to rejected/.
"""

import json
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timezone
from itertools import count
from pathlib import Path
from typing import Any

from lce_rig import __version__
from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.errors import LceRigError, SessionError, reading
from lce_rig.rig import Rig, dump_rig, find_profile, load_rig, parse_rig, read_profile, shipped_profiles
from lce_rig.session.capture import Capture, check_samples, content_hash, write_capture
from lce_rig.session.durable import (
    WriterLock,
    append_line,
    flush_folder,
    recover,
    replace_file,
    write_atomically,
    writing,
)
from lce_rig.session.identity import (
    MARKER,
    DifferingKey,
    differing_keys,
    foreign_keys,
    keep_identity,
    marker_of,
    read_marker,
)

PROFILE, JOURNAL, LOCK = "rig.yaml", "journal.jsonl", ".lock"
PROFILE_TEXT = "profile.yaml"
"""The profile as its author wrote it, with comments; rig.yaml holds every value, and is what is read."""
CAPTURES, REJECTED, DETECTIONS, DRAFT_PREFIX = "captures", "rejected", "detections", ".new-"
CAPTURED = "captured"
"""The journal's event of a capture."""
# Keys of a profile that affect the reading of captures.
_OF_CAPTURES = ("name", "robot", "board", "cameras", "lidars")
CALIBRATION, RESULTS, INTRINSICS, DEBUG = "calibration", "results", "intrinsics", "debug"


class Session:
    """A session, open for reading, or for writing by one process at a time.

    Made by `create`, `open` and `resume`. Use it in a `with` statement, or `close` it, to release the
    writer's lock.

    Attributes:
        path: the session's folder.
        rig: the profile frozen when the session was created.
    """

    def __init__(self, path: Path, rig: Rig, lock: WriterLock | None) -> None:
        self.path = path
        self.rig = rig
        self._lock = lock
        self._names_by_content: dict[str, str] | None = None
        # The text of the profile of `with_profile`; None for the session's own.
        self._other_profile: str | None = None

    @classmethod
    def create(cls, path: Path | str, rig: Rig) -> "Session":
        """Start a session in a new or empty folder and open it for writing.

        Raises:
            SessionError: the folder is not empty, or cannot be written.
        """
        path = Path(path)
        if (path / MARKER).exists():
            raise SessionError(
                f"{path} is a session already", "Choose another folder, or continue this session."
            )
        with writing(path):
            path.mkdir(parents=True, exist_ok=True)
            others = {entry.name for entry in path.iterdir()} - {PROFILE, LOCK, JOURNAL, CAPTURES}
            if any(not name.startswith((f".{PROFILE}.", f".{MARKER}.")) for name in others):
                raise SessionError(
                    f"{path} is not empty and not a session: it holds {sorted(others)[0]}",
                    "Choose another folder.",
                )
            lock = WriterLock(path / LOCK)
            (path / CAPTURES).mkdir(exist_ok=True)
            replace_file(path / PROFILE, dump_rig(rig).encode())
            # Last, because a folder with this file is a session.
            replace_file(path / MARKER, marker_of(rig))
        session = cls(path, rig, lock)
        session.journal("created", rig=rig.name, made_by=f"lce-rig {__version__}")
        return session

    @classmethod
    def open(cls, path: Path | str, *, writable: bool = False) -> "Session":
        """Open an existing session; opening for writing also clears the remains of a killed writer.

        Raises:
            SessionError: the folder is not a session, damaged, made by a newer version, or another process
                writes to it.
        """
        path = Path(path)
        named = read_marker(path)
        with suppress(OSError):  # without write permission there is nothing to recover
            recover(path)
        try:
            rig = load_rig(path / PROFILE)
        except LceRigError as error:
            raise SessionError(
                f"{path / PROFILE}: the session's profile cannot be used: {error.what}", error.hint
            ) from error
        if named != rig.name:
            raise SessionError(
                f"{path}: {MARKER} is of rig {named!r}, {PROFILE} of rig {rig.name!r}",
                "Restore the profile that the session was made with.",
            )
        if not writable:
            return cls(path, rig, None)
        with writing(path):
            lock = WriterLock(path / LOCK)
            (path / CAPTURES).mkdir(exist_ok=True)
            for draft in sorted((path / CAPTURES).glob(f"{DRAFT_PREFIX}*")):
                shutil.rmtree(draft)
        return cls(path, rig, lock)

    @classmethod
    def resume(cls, path: Path | str, rig: Rig) -> "Session":
        """Continue the session of this rig in a folder, or start one there.

        A session without captures adopts the profile, even with differences.

        Raises:
            SessionError: see `create` and `open`; or the session belongs to another rig.
        """
        path = Path(path)
        if not (path / MARKER).exists():
            return cls.create(path, rig)
        session = cls.open(path, writable=True)
        differing = differing_keys(session.rig, rig)
        is_replaced = bool(differing) and not session.captures and not session.rejected
        if differing and not is_replaced:
            session.close()
            hint = "Collect into another folder, or use the profile in the session (its rig.yaml)."
            raise _of_another_rig(session, rig, differing, hint)
        # Allowed differences: addresses of attached sensors, the robot, serial numbers.
        adopted = rig if is_replaced else keep_identity(session.rig, rig)
        if adopted != session.rig:
            try:
                write_atomically(path / PROFILE, dump_rig(adopted))
                write_atomically(path / MARKER, marker_of(adopted))
            except SessionError:
                session.close()
                raise
            session.rig = adopted
        return session

    def adopt(self, rig: Rig) -> str:
        """Replace the session's profile by another of the same rig; the earlier one stays beside it.

        Detections whose keys in the cache depend on the changes are computed again.

        Args:
            rig: profile of the same name and sensors; board, intrinsics, limits and the like may differ.

        Returns:
            The file of the earlier profile, such as "rig-1.yaml"; "" if both are the same.

        Raises:
            SessionError: the profile is of another rig, the session is open read-only, or the disk is full.
        """
        self._require_lock()
        adopted = self._same_rig(rig)
        if adopted == self.rig:
            return ""
        n = next(n for n in count(1) if not (self.path / f"rig-{n}.yaml").exists())
        # Write the earlier one first: if stopped here, the session is unchanged except for a copy of its
        # profile.
        for name, kept in ((PROFILE, f"rig-{n}.yaml"), (PROFILE_TEXT, f"profile-{n}.yaml")):
            if (self.path / name).exists():
                write_atomically(self.path / kept, (self.path / name).read_bytes())
        write_atomically(self.path / PROFILE, dump_rig(adopted))
        self.rig = adopted
        self.journal("profile", earlier=f"rig-{n}.yaml")
        return f"rig-{n}.yaml"

    def with_profile(self, rig: Rig) -> "Session":
        """Return the session, open for reading, with another profile of the same rig; files do not change.

        Args:
            rig: see `adopt`.

        Raises:
            SessionError: the profile is of another rig.
        """
        other = Session(self.path, self._same_rig(rig), None)
        if other.rig != self.rig:
            other._other_profile = dump_rig(other.rig)
        return other

    @property
    def other_profile(self) -> str | None:
        """Text of the profile of `with_profile`; None if the session uses its own."""
        return self._other_profile

    def profile_content(self) -> bytes:
        """Read the profile in use, as stored in rig.yaml."""
        other = self._other_profile
        return (self.path / PROFILE).read_bytes() if other is None else other.encode()

    def _same_rig(self, rig: Rig) -> Rig:
        """Fill in another profile's robot and serial numbers from this session.

        Raises:
            SessionError: the profile is of another rig.
        """
        foreign = foreign_keys(self.rig, rig)
        if foreign:
            raise _of_another_rig(self, rig, foreign, "Give a profile of the same rig.")
        return keep_identity(self.rig, rig)

    def keep_text(self, text: str) -> None:
        """Keep a profile's text with its comments, if it is equivalent to the session's profile.

        Raises:
            SessionError: the disk is full or read-only.
        """
        if self._says(text):
            write_atomically(self.path / PROFILE_TEXT, text)

    def profile_text(self) -> str:
        """Return the session's profile as its author wrote it, with comments; else all its values."""
        with suppress(OSError, ValueError):
            text = (self.path / PROFILE_TEXT).read_text(encoding="utf-8")
            if self._says(text):
                return text
        name = self.rig.name
        is_shipped = name in shipped_profiles() and load_rig(name) == self.rig
        return read_profile(find_profile(name)) if is_shipped else dump_rig(self.rig)

    def _says(self, text: str) -> bool:
        """Check whether a profile's text equals this session's, apart from the robot and serial numbers."""
        with suppress(LceRigError, KeyError):  # KeyError: it has other sensors
            return keep_identity(self.rig, parse_rig(text)) == self.rig
        return False

    def __enter__(self) -> "Session":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the lock for the next writer; reading continues to work."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    @property
    def captures(self) -> list[Capture]:
        """All complete captures, sorted by name.

        Raises:
            SessionError: their folder may not be read.
        """
        return _captures_in(self.path / CAPTURES)

    @property
    def rejected(self) -> list[Capture]:
        """All rejected captures, sorted by name; they are not used, and `restore` restores one.

        Raises:
            SessionError: their folder may not be read.
        """
        return _captures_in(self.path / REJECTED)

    def capture(self, name: str) -> Capture:
        """Find one capture.

        Raises:
            SessionError: there is no capture of that name.
        """
        for capture in self.captures:
            if capture.name == name:
                return capture
        if any(capture.name == name for capture in self.rejected):
            raise SessionError(
                f"{self.path}: capture {name} is rejected",
                f"Restore it: lce-rig captures {self.path} --restore {name}",
            )
        raise SessionError(f"{self.path} has no capture {name!r}; it has {len(self.captures)}")

    def scan(self, capture: Capture, lidar: str) -> Scan:
        """Read a capture's scan less the profile's range offset; `Capture.scan` reads it as recorded.

        Raises:
            SessionError: there is none, or it is damaged.
        """
        return self.rig.corrected(capture.scan(lidar))

    def reject(self, name: str, reason: str = "") -> None:
        """Reject a capture, so that it is neither used nor collected again.

        Args:
            name: name of the capture.
            reason: reason for the journal.

        Raises:
            SessionError: the capture does not exist, or the session or its disk is read-only.
        """
        self.capture(name)
        self._move(name, CAPTURES, REJECTED, "rejected", reason=reason)

    def restore(self, name: str) -> None:
        """Restore a rejected capture; raises like `reject`."""
        if all(capture.name != name for capture in self.rejected):
            names = ", ".join(capture.name for capture in self.rejected) or "none"
            raise SessionError(
                f"{self.path} has no rejected capture {name!r}", f"Rejected captures: {names}."
            )
        self._move(name, REJECTED, CAPTURES, "restored")

    def _move(self, name: str, source: str, target: str, event: str, **fields: str) -> None:
        """Move a capture's folder atomically."""
        self._require_lock()
        old, new = self.path / source / name, self.path / target / name
        if new.exists():
            raise SessionError(f"{new} blocks capture {name}", f"Move {new} out of the session.")
        # Write the journal first, so that the capture does not move if the disk is full.
        self.journal(event, capture=name, **fields)
        with writing(new):
            new.parent.mkdir(exist_ok=True)
            old.rename(new)
            flush_folder(new.parent)
            flush_folder(old.parent)

    def find_duplicate(
        self, images: Iterable[Image], scans: Iterable[Scan], events: Iterable[Events] = ()
    ) -> str | None:
        """Return the capture, even if rejected, that already holds exactly this data; None if it is new."""
        return self._contents().get(content_hash(images, scans, events))

    def add_capture(
        self,
        images: Iterable[Image],
        scans: Iterable[Scan],
        meta: Mapping[str, Any],
        events: Iterable[Events] = (),
    ) -> str:
        """Store one capture; after the return it survives a crash or power failure.

        Args:
            images: at most one for each camera channel.
            scans: at most one for each LiDAR.
            meta: JSON values to keep with it.
            events: at most one stretch for each camera that has a channel of events.

        Returns:
            The capture's name.

        Raises:
            SessionError: the session is open read-only, a sensor is not in the rig, events are out of
                order or outside their sensor, or the disk is full; earlier captures are not affected.
        """
        images, scans, events = list(images), list(scans), list(events)
        self._require_lock()
        check_samples(self.rig, images, scans, events)
        recorded = [(self.rig.cameras[e.sensor].first_channel("events") or "", e) for e in events]
        contents = self._contents()
        name = self.next_name
        folder = self.path / CAPTURES / name
        draft = folder.with_name(DRAFT_PREFIX + name)
        try:
            with writing(folder, len(self.captures)):
                draft.mkdir()
                write_capture(draft, images, scans, meta, recorded)
                draft.rename(folder)
                flush_folder(folder.parent)
        except ValueError as error:
            raise SessionError(f"capture {name} cannot be stored: {error}") from error
        finally:
            shutil.rmtree(draft, ignore_errors=True)
        contents.setdefault(Capture(folder).content_sha256, name)
        self.journal(CAPTURED, capture=name)
        return name

    def add_session(self, other: "Session") -> list[str]:
        """Copy the captures of another session of this rig, except those already held or rejected here.

        Args:
            other: a profile of the same board and sensors; limits and targets may differ.

        Returns:
            The names of the copies.

        Raises:
            SessionError: the session is of another rig, a capture is damaged, or as of `add_capture`.
        """
        foreign = [key for key in differing_keys(other.rig, self.rig) if key.path[0] in _OF_CAPTURES]
        if foreign:
            raise _of_another_rig(self, other.rig, foreign, "Correct the wrong rig.yaml.")
        return [
            self.add_capture(
                [each.image(*key) for key in each.image_keys],
                [each.scan(lidar) for lidar in each.lidars],
                each.meta,
                [each.events(camera) for camera in each.event_cameras],
            )
            for each in other.captures
            if each.content_sha256 not in self._contents()
        ]

    @property
    def next_name(self) -> str:
        """Name of the next capture; names of rejected ones are not reused."""
        return f"{max((int(each.name) for each in self.captures + self.rejected), default=-1) + 1:06d}"

    def _require_lock(self) -> None:
        if self._lock is None:
            raise SessionError(f"{self.path} is open for reading only")

    def journal(self, event: str, **fields: Any) -> None:
        """Append an entry with the time to journal.jsonl.

        Raises:
            SessionError: the disk is full or read-only.
        """
        now = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
        line = json.dumps({"time": now, "event": event, **fields}, sort_keys=True, default=str)
        with writing(self.path / JOURNAL, len(self.captures)):
            append_line(self.path / JOURNAL, line)

    def read_journal(self) -> list[dict[str, Any]]:
        """List the journal's entries; skip a line torn by a crash.

        Raises:
            SessionError: the journal cannot be read.
        """
        path = self.path / JOURNAL
        entries = []
        with reading(path, SessionError):
            for line in path.read_bytes().splitlines() if path.exists() else ():
                with suppress(ValueError):
                    entry = json.loads(line)
                    entries += [entry] if isinstance(entry, dict) else []
        return entries

    def cached(self, key: str) -> Path:
        """Return the path of the arrays cached under a key such as "3f9a1c/000012"."""
        return self.path / DETECTIONS / f"{key}.npz"

    def _contents(self) -> dict[str, str]:
        if self._names_by_content is None:
            self._names_by_content = {}
            for capture in self.captures + self.rejected:
                try:
                    self._names_by_content.setdefault(capture.content_sha256, capture.name)
                except SessionError:
                    # A damaged capture is reported when it is read, and has no duplicates.
                    continue
        return self._names_by_content


def _of_another_rig(session: Session, rig: Rig, keys: Sequence[DifferingKey], hint: str) -> SessionError:
    shown = "; ".join(map(str, keys[:5])) + (f"; and {len(keys) - 5} more" if len(keys) > 5 else "")
    return SessionError(
        f"{session.path} is a session of rig {session.rig.name!r}, not of this rig {rig.name!r}: {shown}",
        hint,
    )


def discard_if_empty(path: Path) -> bool:
    """Remove a session's folder if it holds only the files of its creation.

    Args:
        path: the folder, without a writer.

    Returns:
        Whether it was removed. A folder with a capture or any other file is left unchanged.
    """
    made = {MARKER, PROFILE, PROFILE_TEXT, JOURNAL, LOCK, CAPTURES}
    is_empty = path.is_dir() and {entry.name for entry in path.iterdir()} <= made
    if is_empty and not any((path / CAPTURES).glob("*")):
        shutil.rmtree(path, ignore_errors=True)
        return True
    return False


def _captures_in(folder: Path) -> list[Capture]:
    with reading(folder, SessionError):
        names = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
    numbered = [name for name in names if re.fullmatch(r"[0-9]{6,}", name)]
    # By number: 1000000 follows 999999.
    return [Capture(folder / name) for name in sorted(numbered, key=lambda name: (len(name), name))]
