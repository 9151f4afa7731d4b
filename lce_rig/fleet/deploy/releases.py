"""What lies at a target: releases, each a set of files with a record of where it comes from."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lce_rig.core.documents import parse_json
from lce_rig.core.errors import TargetError
from lce_rig.core.limits import read_file
from lce_rig.fleet.deploy.place import Place, Ran, last_line
from lce_rig.fleet.deploy.shell import LOCKED, NO_LINK, NO_RELEASE, RECORD, SAYS, STATE, USED

_NAME = r"^[0-9]{8}T[0-9]{6}Z-[0-9a-f]{8}$"
_HINTS = {
    LOCKED: "Wait for the other deployment to end.",
    NO_LINK: "Move what is in its place away.",
    NO_RELEASE: "`--status` lists the releases.",
}


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)


class ReleaseRecord(_Record):
    """The file .deployed.json of a release.

    Attributes:
        format_version: of this schema.
        name: of the release: when it was deployed, UTC, and the begin of `set_sha256`.
        time: when it was deployed, by the clock of the computer that did.
        by: who did, user@computer.
        made_by: the program that wrote the files.
        replaces: the release that was current before; "" for the first.
        reason: why it was forced; "" where it was not.
        forced: codes of what spoke against it.
        files: SHA-256 of each file by its path.
        robot, serials, date, session_sha256: as of the result's provenance.
        verdicts: by camera and LiDAR.
    """

    format_version: int = 1
    name: Annotated[str, Field(pattern=_NAME)]
    time: str
    by: str = ""
    made_by: str = ""
    replaces: str = ""
    reason: str = ""
    forced: list[str] = Field(default_factory=list)
    files: dict[str, str]
    robot: str = ""
    serials: dict[str, str] = Field(default_factory=dict)
    date: str = ""
    session_sha256: str = ""
    verdicts: dict[str, str] = Field(default_factory=dict)

    @property
    def set_sha256(self) -> str:
        """Fingerprint of all files with their names."""
        return set_sha256(self.files)

    def line(self) -> str:
        """Write it as one line."""
        return json.dumps(self.model_dump(), sort_keys=True, ensure_ascii=True) + "\n"


@dataclass(frozen=True)
class TargetState:
    """What lies at a target.

    Attributes:
        current: what robot software reads; None before the first deployment.
        releases: all that are kept, the newest first.
        pending: the release whose command has not succeeded yet; "" where none is pending.
    """

    current: ReleaseRecord | None = None
    releases: tuple[ReleaseRecord, ...] = ()
    pending: str = ""

    def named(self, name: str) -> ReleaseRecord | None:
        """Find a release."""
        return next((each for each in self.releases if each.name == name), None)

    @property
    def is_pending(self) -> bool:
        """Whether the command after the current release has not succeeded yet."""
        return self.current is not None and self.pending == self.current.name


@dataclass(frozen=True)
class Standing:
    """A target's state, and whether its current files are those that were deployed.

    Attributes:
        state: of the target.
        changed: current files that are not as they were deployed, by what is wrong: "changed", "missing",
            "added".
    """

    state: TargetState
    changed: Mapping[str, str] = field(default_factory=dict)


def content_of(folder: Path) -> dict[str, str]:
    """Fingerprint the files of a set by their path; the record and marks of a release are not part of it.

    Raises:
        TargetError: a file cannot be read, or is a link or no plain file.
    """
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name in (RECORD, USED) or (path.is_dir() and not path.is_symlink()):
            continue
        if path.is_symlink():
            raise TargetError(f"{path} is a link, not a file of the set", "Deploy plain files only.")
        try:
            found[name] = hashlib.sha256(read_file(path)).hexdigest()
        except (OSError, ValueError) as error:
            raise TargetError(f"{path} cannot be read: {error}") from error
    return found


def set_sha256(files: Mapping[str, str]) -> str:
    """Fingerprint a set of files: of the lines that `sha256sum` prints, by name."""
    lines = "".join(f"{digest}  {name}\n" for name, digest in sorted(files.items()))
    return hashlib.sha256(lines.encode()).hexdigest()


def differences(files: Mapping[str, str], expected: Mapping[str, str]) -> dict[str, str]:
    """Say which files of a set are not as expected."""
    names = sorted(name for name in files.keys() | expected.keys() if files.get(name) != expected.get(name))
    return {
        name: "missing" if name not in files else "added" if name not in expected else "changed"
        for name in names
    }


def read_state(place: Place) -> TargetState:
    """Ask what lies at a target; nothing is changed there.

    Raises:
        TargetError: it cannot be reached, or its current release is not one that lce-rig made.
    """
    return to_state(place, succeed(place, place.run(STATE)))


def succeed(place: Place, ran: Ran) -> Ran:
    """Pass on what a script did.

    Raises:
        TargetError: it failed.
    """
    if ran.code:
        what = last_line(ran.err)
        raise TargetError(
            f"{place.label}: {what}", _HINTS.get(ran.code, "Check space and permissions there.")
        )
    return ran


def to_state(place: Place, ran: Ran) -> TargetState:
    """Understand what a script printed; see `read_state`."""
    current, pending, releases = "", "", []
    for line in ran.out.splitlines():
        kind, _, rest = line.removeprefix(SAYS).partition(" ") if line.startswith(SAYS) else ("", "", "")
        if kind == "current":
            current = rest
        elif kind == "pending":
            pending = rest
        elif kind == "release":
            name, _, record = rest.partition(" ")
            found = _parse(record)
            if found is not None and found.name == name:
                releases.append(found)
    releases.sort(key=lambda each: each.name, reverse=True)
    state = TargetState(None, tuple(releases), pending)
    if not current:
        return state
    named = state.named(current)
    if named is None:
        raise TargetError(
            f"{place.label}: current is {current}, which lce-rig has not deployed or is damaged",
            f"Look at {place.path}/current there, and remove this link to begin anew.",
        )
    return TargetState(named, state.releases, pending)


def _parse(text: str) -> ReleaseRecord | None:
    try:
        return ReleaseRecord.model_validate(parse_json(text.encode()))
    except (ValueError, ValidationError):
        return None
