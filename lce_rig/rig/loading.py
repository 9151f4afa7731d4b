"""Profiles from and to YAML, found by name or by path."""

import difflib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from lce_rig.core.errors import ProfileError
from lce_rig.core.limits import MAX_DOCUMENT_BYTES, read_file
from lce_rig.rig.document import Document, read_document
from lce_rig.rig.explaining import explain
from lce_rig.rig.profile import Rig

_SUFFIXES = (".yaml", ".yml")


def profile_folder() -> Path:
    """Find the folder of the shipped profiles: inside the wheel, or beside the package in a checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "rigs"
    return installed if installed.is_dir() else package.parent / "rigs"


def shipped_profiles() -> dict[str, Path]:
    """List the shipped profiles by name, sorted."""
    return {path.stem: path for path in sorted(profile_folder().glob("*.yaml"))}


def find_profile(name_or_path: str | Path) -> Path:
    """Find a profile's file from the name of a shipped one or from a path.

    Raises:
        ProfileError: neither fits; known names and the nearest are listed.
    """
    text = str(name_or_path)
    path = Path(name_or_path)
    shipped = shipped_profiles()
    if text in shipped:
        return shipped[text]
    if path.is_file():
        return path
    if len(path.parts) > 1 or path.suffix in _SUFFIXES:
        state = "is a folder, not a file" if path.is_dir() else "there is no such file"
        raise ProfileError(f"{text}: {state}", f"shipped profiles: {', '.join(shipped)}")
    nearest = difflib.get_close_matches(text, shipped, n=1)
    question = f"did you mean {nearest[0]}? " if nearest else ""
    hint = f"{question}shipped profiles: {', '.join(shipped)}; a file is given by its path"
    raise ProfileError(f"no rig profile is called {text}", hint)


def load_rig(name_or_path: str | Path) -> Rig:
    """Load the profile of a rig; paths in it become absolute.

    Args:
        name_or_path: name of a shipped profile ("rlfs") or path of a YAML file.

    Raises:
        ProfileError: no such profile, or one that cannot be used; every problem with file, line and key.
    """
    path = find_profile(name_or_path)
    return parse_rig(read_profile(path), str(path)).located(path.parent)


def read_profile(path: Path) -> str:
    """Read the text of a profile's file.

    Raises:
        ProfileError: it cannot be read, or is not a text of a profile's size.
    """
    try:
        return read_file(path, MAX_DOCUMENT_BYTES).decode()
    except OSError as error:
        raise ProfileError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ProfileError(f"{path}: is not UTF-8 text (byte {error.start})") from error
    except ValueError as error:
        raise ProfileError(f"{path}: {error}") from error


def parse_rig(text: str, source: str = "profile") -> Rig:
    """Build a rig from YAML text.

    Args:
        text: the YAML.
        source: what to call the text in errors, as a rule its file.

    Raises:
        ProfileError: the text is not a profile.
    """
    return rig_from_document(read_document(text, source))


def rig_from_document(document: Document) -> Rig:
    """Validate a document; raise a ProfileError that lists every problem with its line."""
    try:
        return Rig.model_validate(document.data)
    except ValidationError as error:
        raise explain(error, document) from error


def dump_rig(rig: Rig) -> str:
    """Write a rig as YAML, without comments; `parse_rig` gives back an equal rig."""
    data = rig.model_dump(mode="json", exclude_none=True)
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100)


class _Dumper(yaml.SafeDumper):
    """Block style, but short lists of numbers on one line; floats that read back as floats."""

    def represent_sequence(
        self, tag: str, sequence: Iterable[Any], flow_style: bool | None = None
    ) -> yaml.SequenceNode:
        is_flat = all(not isinstance(item, dict) for item in sequence)
        return super().represent_sequence(tag, sequence, flow_style=is_flat)
