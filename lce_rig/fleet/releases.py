"""Targets by name, and their releases: sets of files, each with a record of its origin."""

import getpass
import hashlib
import json
import socket
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lce_rig.core.calibration import MADE_BY, ResultFile
from lce_rig.core.errors import TargetError, UsageError
from lce_rig.fleet.place import RECORD, SAYS, STATE, USED, Place
from lce_rig.fleet.target import ROBOT_FIELD, TargetSettings
from lce_rig.rig.loading import explain, read_document, read_profile
from lce_rig.rig.settings import RobotName

TARGETS_FILE = "deploy.yaml"
_COMPACT = "%Y%m%dT%H%M%SZ"


class _TargetsFile(BaseModel):
    model_config = ConfigDict(extra="forbid")
    targets: Annotated[dict[RobotName, TargetSettings], Field(min_length=1)]


def read_targets(path: Path) -> dict[str, TargetSettings]:
    """Read the block `targets` of a file; local paths become absolute.

    Raises:
        ProfileError: no such file, or an invalid one; every problem with line and key.
    """
    hint = "List targets by name below `targets:`; see docs/robot.md."
    document = read_document(read_profile(path), str(path), "a list of targets", hint)
    try:
        content = _TargetsFile.model_validate(document.data)
    except ValidationError as error:
        raise explain(error, document, _TargetsFile) from error
    return {name: target.located(path.parent) for name, target in content.targets.items()}


def find_target(name: str, file: Path | None, session: Path, robot: str | None = None) -> TargetSettings:
    """Find a target in a file.

    Args:
        name: name of the target.
        file: file that lists targets; None for deploy.yaml beside the session.
        session: folder of the session.
        robot: the robot, for a target shared by several.

    Raises:
        ProfileError: the file is invalid.
        UsageError: the target is unknown, or is shared by several robots and none is named.
    """
    place = file or session.resolve().parent / TARGETS_FILE
    targets = read_targets(place) if file is not None or place.is_file() else {}
    target = targets.get(name)
    if target is not None and ROBOT_FIELD in target.to:
        with suppress(ValueError):
            return target.for_robot(robot or target.robot or "")
        raise UsageError(f"target {name!r} stands for many robots", "Add --robot NAME.")
    if target is not None:
        return target
    hint = f"Known targets: {', '.join(targets)}." if targets else f"List targets in {place}."
    raise UsageError(f"no target is called {name!r}", hint)


class ReleaseRecord(BaseModel):
    """The file .deployed.json of a release.

    Attributes:
        format_version: format version of this schema.
        name: name of the release: UTC time of deployment, and the beginning of `set_sha256`.
        time: time of deployment, by the clock of the computer that deployed it.
        by: user@computer that deployed it.
        made_by: the program that wrote the files.
        replaces: the release that was current before; "" for the first.
        reason: reason of a forced deployment; "" if it was not forced.
        forced: codes of the objections.
        files: SHA-256 of each file by its path.
        robot, serials, date, session_sha256: from the result's provenance.
        verdicts: verdicts by camera and LiDAR.
    """

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)

    format_version: int = 1
    name: Annotated[str, Field(pattern=r"^[0-9]{8}T[0-9]{6}Z-[0-9a-f]{8}$")]
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

    @classmethod
    def of(cls, saved: ResultFile, files: Mapping[str, str], state: "TargetState") -> "ReleaseRecord":
        """Describe the next release at a target, with the SHA-256 of its files."""
        now = datetime.now(timezone.utc)
        # Keep releases in order of time, even if this computer's clock is behind an earlier deployment's.
        newest = max((release.name[:16] for release in state.releases), default="")
        compact = f"{now:{_COMPACT}}"
        if compact <= newest:
            compact = f"{datetime.strptime(newest, _COMPACT) + timedelta(seconds=1):{_COMPACT}}"
        origin = saved.provenance
        return cls(
            name=f"{compact}-{set_sha256(files)[:8]}",
            time=f"{now:%Y-%m-%dT%H:%M:%SZ}",
            by=user_name(),
            made_by=MADE_BY,
            replaces="" if state.current is None else state.current.name,
            files=dict(files),
            robot=origin.robot,
            serials=dict(origin.serials),
            date=origin.date or "",
            session_sha256=origin.session_sha256,
            verdicts={f"{c.camera} and {c.lidar}": c.verdict for c in saved.pairs},
        )

    @property
    def set_sha256(self) -> str:
        """Fingerprint of all files with their names."""
        return set_sha256(self.files)

    def as_json(self) -> dict[str, Any]:
        """Return the content, and the fingerprint of its files, as plain types."""
        return self.model_dump() | {"set_sha256": self.set_sha256}

    def line(self) -> str:
        """Write it as one line."""
        return json.dumps(self.model_dump(), sort_keys=True, ensure_ascii=True) + "\n"


@dataclass(frozen=True)
class TargetState:
    """The state of a target.

    Attributes:
        current: release read by robot software; None before the first deployment.
        releases: all kept releases, newest first.
        pending: the release whose command has not succeeded yet, or "".
        changed: current files that differ from the deployed ones, and how they differ; empty if not checked.
    """

    current: ReleaseRecord | None = None
    releases: tuple[ReleaseRecord, ...] = ()
    pending: str = ""
    changed: Mapping[str, str] = field(default_factory=dict)

    def named(self, name: str) -> ReleaseRecord | None:
        """Find a release."""
        return next((release for release in self.releases if release.name == name), None)

    @property
    def is_pending(self) -> bool:
        """Whether the command after the current release has not succeeded yet."""
        return self.current is not None and self.pending == self.current.name


def read_state(place: Place) -> TargetState:
    """Query the state of a target, without changing it.

    Raises:
        TargetError: the target cannot be reached, or `current` or `releases` is not by lce-rig.
    """
    current, pending, releases = "", "", []
    for line in place.must_run(STATE).splitlines():
        kind, _, rest = line.removeprefix(SAYS).partition(" ") if line.startswith(SAYS) else ("", "", "")
        if kind == "current":
            current = rest
        elif kind == "pending":
            pending = rest.strip()
        elif kind == "release":
            name, _, text = rest.partition(" ")
            try:
                record = ReleaseRecord.model_validate_json(text)
            except ValidationError:
                continue
            if record.name == name:
                releases.append(record)
    releases.sort(key=lambda release: release.name, reverse=True)
    state = TargetState(None, tuple(releases), pending)
    if not current:
        return state
    if state.named(current) is None:
        raise TargetError(
            f"{place.label}: the record of the current release {current} is damaged",
            f"Remove the link {place.path}/current there to start again.",
        )
    return TargetState(state.named(current), state.releases, pending)


def fetch(place: Place, release: ReleaseRecord, folder: Path) -> dict[str, str]:
    """Copy a release to a new local folder.

    Returns:
        The files that differ from those deployed: "changed", "missing", "added" or "no plain file" by
        path. With links, devices or very large files among them nothing is copied.

    Raises:
        TargetError: the target cannot be reached, or has no such release.
    """
    odd = place.get(f"releases/{release.name}", folder)
    return dict.fromkeys(odd, "no plain file") if odd else differences(content_of(folder), release.files)


def user_name() -> str:
    """Return user@computer; "" if the system does not report them."""
    with suppress(OSError, KeyError):
        return f"{getpass.getuser()}@{socket.gethostname()}"
    return ""


def content_of(folder: Path) -> dict[str, str]:
    """Fingerprint the files of a set by path, without the record and mark of a release.

    Raises:
        TargetError: a file cannot be read, or is a link.
    """
    content = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name in (RECORD, USED) or (path.is_dir() and not path.is_symlink()):
            continue
        if path.is_symlink():
            raise TargetError(f"{path} is a link, not a file of the set", "Deploy plain files only.")
        try:
            content[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        except OSError as error:
            raise TargetError(f"{path} cannot be read: {error.strerror or error}") from error
    return content


def set_sha256(files: Mapping[str, str]) -> str:
    """Fingerprint a set of files: hash the lines that `sha256sum` prints, sorted by name."""
    lines = "".join(f"{digest}  {name}\n" for name, digest in sorted(files.items()))
    return hashlib.sha256(lines.encode()).hexdigest()


def differences(files: Mapping[str, str], expected: Mapping[str, str]) -> dict[str, str]:
    """Compare the files of a set with the expected ones: "changed", "missing" or "added" by path."""
    names = sorted(name for name in files.keys() | expected.keys() if files.get(name) != expected.get(name))
    return {
        name: "missing" if name not in files else "added" if name not in expected else "changed"
        for name in names
    }


def differences_in_words(changes: Mapping[str, str]) -> str:
    """List the result of `differences` in one line."""
    return ", ".join(f"{name} {how}" for name, how in changes.items())
