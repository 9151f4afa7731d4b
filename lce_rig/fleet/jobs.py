"""Find sessions and recordings below a root, with their entries in a manifest."""

import hashlib
import re
from collections.abc import Iterable
from dataclasses import dataclass

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from lce_rig.core.errors import NotEnoughDataError, ProfileError, UsageError
from lce_rig.fleet.storage import Storage
from lce_rig.rig.loading import explain, find_profile, read_document
from lce_rig.session.identity import MARKER

MANIFEST = "fleet.yaml"
_ROBOT = "{robot}"
_SAFE = re.compile(r"[^A-Za-z0-9_.-]+")


@dataclass(frozen=True)
class Job:
    """One session or recording.

    Attributes:
        source: the source's path or address, absolute.
        robot: the robot's name in the manifest; "" without one.
        fallback_robot: its name if the profile does not name it either: the first folder below the root.
        rig: profile that replaces the session's, or that a recording needs; "" for the session's.
    """

    source: str
    robot: str = ""
    fallback_robot: str = ""
    rig: str = ""


class Entry(BaseModel):
    """One entry of a manifest: robot and rig of the sessions and recordings that match a pattern."""

    model_config = ConfigDict(frozen=True, extra="forbid", coerce_numbers_to_str=True)

    path: str = Field(min_length=1)
    robot: str = ""
    rig: str = ""

    @field_validator("path")
    @classmethod
    def _is_a_pattern(cls, path: str) -> str:
        parts = path.split("/")
        if path.startswith("/") or ".." in parts or "\0" in path:
            raise ValueError("not below the root")
        if any("**" in part and part != "**" for part in parts):
            raise ValueError("** beside other characters")
        if "{" in path.replace(_ROBOT, "", 1):
            raise ValueError("the only field is {robot}, once")
        return path

    @property
    def glob(self) -> str:
        """The pattern without {robot}."""
        return self.path.rstrip("/").replace(_ROBOT, "*")

    def robot_of(self, path: str) -> str:
        """Return the robot named in the entry, or read from a matching path; "" without either."""
        parts = re.split(r"(\{robot\}|\*\*/|\*\*|\*|\?)", self.path.rstrip("/"))
        rules = {_ROBOT: "([^/]+?)", "**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}
        match = re.fullmatch("".join(rules.get(part, re.escape(part)) for part in parts), path)
        return self.robot or (match[1] if match is not None and match.groups() else "")


class _Manifest(BaseModel):
    sessions: list[Entry]


def find_jobs(root: Storage, manifest: Storage | None = None) -> list[Job]:
    """List the sessions and recordings below a folder.

    A manifest, `fleet.yaml` in the folder unless another is given, names them by patterns.
    Without one, every session is used.

    Args:
        root: folder of the sessions and recordings.
        manifest: the manifest.

    Raises:
        UsageError: the manifest cannot be used.
        ProfileError: the manifest names a profile that does not exist.
        NotEnoughDataError: there is nothing to run.
    """
    if not root.exists():
        raise UsageError(f"{root.url} does not exist", "Give the folder that the sessions lie in.")
    place = manifest or root / MANIFEST
    text = place.read()
    if text is None and manifest is not None:
        raise UsageError(f"{manifest.url} does not exist", "Give a manifest such as fleet.yaml.")
    if text is None:
        paths = root.folders_with(MARKER)
        names = {path: path.partition("/")[0] or root.name for path in paths}
        jobs = [Job(f"{root.url}/{path}".rstrip("/"), fallback_robot=names[path]) for path in paths]
    else:
        jobs = _matches(root, place, _entries(place, text))
    if not jobs:
        raise NotEnoughDataError(
            f"{root.url} holds no session" + ("" if text is None else f" that {place.url} names"),
            "A session is a folder with session.json; recordings are named in a manifest (docs/fleets.md).",
        )
    return jobs


def _entries(manifest: Storage, content: bytes) -> list[Entry]:
    """Read a manifest."""
    text = content.decode(errors="replace")
    below = "List entries with `path` below `sessions:`; see docs/fleets.md."
    try:
        document = read_document(text, manifest.url, "a fleet's manifest", below)
        try:
            return _Manifest.model_validate(document.data).sessions
        except ValidationError as error:
            raise explain(error, document, _Manifest) from None
    except ProfileError as error:
        hint = f"Keys below `sessions:`: {', '.join(Entry.model_fields)}; see docs/fleets.md."
        raise UsageError(error.what, error.hint or hint) from None


def _matches(root: Storage, manifest: Storage, entries: Iterable[Entry]) -> list[Job]:
    """Find the paths that match the entries; the first matching entry counts.

    Raises:
        ProfileError: an entry's profile does not exist; its path starts at the manifest's folder.
    """
    jobs: dict[str, Job] = {}
    for entry in entries:
        rig = entry.rig
        if rig and "://" not in rig and not rig.startswith("/") and "." in rig:
            rig = f"{manifest.url.rpartition('/')[0]}/{rig}"
        if rig and "://" not in rig:
            find_profile(rig)
        elif rig and not Storage(rig).exists():
            raise ProfileError(f"{manifest.url}: rig: {rig} does not exist", "Name a profile's file.")
        for path in root.matching(entry.glob):
            if path not in jobs and path != MANIFEST:
                first, _, _ = path.partition("/")
                jobs[path] = Job(f"{root.url}/{path}", entry.robot_of(path), first, rig)
    return list(jobs.values())


def folder_name(text: str) -> str:
    """Build a folder name from any text; different texts have different names."""
    name = _SAFE.sub("_", text).strip(".")[:80]
    if name == text:
        return name
    return f"{name or 'unnamed'}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"
