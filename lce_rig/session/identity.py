"""Recognise session folders and their rig."""

import json
import re
from pathlib import Path
from typing import Any, NamedTuple

from lce_rig import __version__
from lce_rig.core.errors import SessionError, reading
from lce_rig.core.files import read_json
from lce_rig.rig import Rig

FORMAT_VERSION = 1
_MAY_DIFFER = re.compile(
    r"description|nominal_extrinsics|exports|(lidars|cameras)\.[^.]+\.driver(\..*)?|sync\.(device|baud)"
).fullmatch
# Keys that may be filled in after the first capture; a changed value means another rig.
_IS_IDENTITY = re.compile(r"robot|(lidars|cameras)\.[^.]+\.serial").fullmatch
# Keys whose change means another rig, even if all others agree: samples were read by them.
_OF_THE_RIG = re.compile(
    r"name|robot|(lidars|cameras)\.[^.]+\.(serial|model)|cameras\.[^.]+\.channels\.[^.]+\.kind"
).fullmatch
_OF_EXTRINSICS = frozenset({"intrinsics", "resolution_px", "model"})
_ABSENT = "absent"
MARKER = "session.json"


def marker_of(rig: Rig) -> bytes:
    """Write the content of session.json."""
    marker = {"format_version": FORMAT_VERSION, "rig": rig.name, "made_by": f"lce-rig {__version__}"}
    return (json.dumps(marker, indent=1) + "\n").encode()


def read_marker(path: Path) -> str:
    """Read the name of the rig in session.json.

    Raises:
        SessionError: the folder is not a session, it is damaged, or was made by a newer version.
    """
    if path.is_file():
        hint = "Give the session's folder. `lce-rig collect --rig RIG --from FILE` makes one of a recording."
        raise SessionError(f"{path} is a file, but a session is a folder", hint)
    with reading(path / MARKER, SessionError):
        if not (path / MARKER).exists():
            hint = (
                f"Make one with `lce-rig collect --rig RIG {path}` or `lce-rig simulate --rig rlfs {path}`."
            )
            raise SessionError(f"{path} is not a session: it has no {MARKER}", hint)
        marker = read_json(path / MARKER)
        version, rig = marker["format_version"], marker["rig"]
        if version > FORMAT_VERSION:
            raise SessionError(f"{path} was made by a newer lce-rig (format {version})", "Update lce-rig.")
    return str(rig)


class DifferingKey(NamedTuple):
    """A key that differs between two profiles.

    Attributes:
        path: path of the key, such as ("cameras", "davis", "frame").
        theirs, ours: values of the key; "absent" if missing in a profile.
    """

    path: tuple[str, ...]
    theirs: Any
    ours: Any

    @property
    def name(self) -> str:
        """Its path as one word."""
        return ".".join(self.path)

    @property
    def is_of_lens_or_model(self) -> bool:
        """Whether extrinsics depend on it: another lens is another camera."""
        return self.path[0] in ("cameras", "lidars") and not _OF_EXTRINSICS.isdisjoint(self.path[1:])

    def __str__(self) -> str:
        return f"{self.name} {self.theirs} there, {self.ours} here"


def differing_keys(theirs: Rig, ours: Rig) -> list[DifferingKey]:
    """List the keys that differ between two profiles, with both values.

    The description, the nominal extrinsics, and the addresses of attached sensors may
    differ, as no capture depends on them. The robot and serial numbers may be absent in either.
    """
    a, b = (_flatten(rig.model_dump(mode="json", exclude_none=True)) for rig in (theirs, ours))
    keys = []
    for path in sorted(a.keys() | b.keys()):
        name, values = ".".join(path), (a.get(path, _ABSENT), b.get(path, _ABSENT))
        may_differ = _MAY_DIFFER(name) or (_IS_IDENTITY(name) and _ABSENT in values)
        if values[0] != values[1] and not may_differ:
            keys.append(DifferingKey(path, *values))
    return keys


def foreign_keys(theirs: Rig, ours: Rig) -> list[DifferingKey]:
    """List the keys that show that two profiles are of different rigs: name, robot, sensors, channels.

    Board, intrinsics, limits and other measured or chosen values may differ.
    """
    # A sensor or channel missing from one profile is reported as a difference in model or kind.
    return [key for key in differing_keys(theirs, ours) if _OF_THE_RIG(key.name)]


def keep_identity(earlier: Rig, rig: Rig) -> Rig:
    """Fill in a profile's robot and serial numbers from an earlier profile of the same rig."""
    lidars = {
        name: each.model_copy(update={"serial": each.serial or earlier.lidars[name].serial})
        for name, each in rig.lidars.items()
    }
    cameras = {
        name: each.model_copy(update={"serial": each.serial or earlier.cameras[name].serial})
        for name, each in rig.cameras.items()
    }
    kept = {"robot": rig.robot or earlier.robot, "lidars": lidars, "cameras": cameras}
    return rig.model_copy(update=kept)


def _flatten(value: Any, path: tuple[str, ...] = ()) -> dict[tuple[str, ...], Any]:
    if not isinstance(value, dict):
        return {path: value}
    return {k: v for key, inner in value.items() for k, v in _flatten(inner, (*path, str(key))).items()}
