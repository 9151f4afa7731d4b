"""Read and write profiles as YAML, by name or by path."""

import difflib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Any, get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from lce_rig.core.errors import ProfileError, reading
from lce_rig.core.limits import MAX_DOCUMENT_BYTES, read_file
from lce_rig.rig.document import Document, KeyPath, read_document
from lce_rig.rig.profile import Rig
from lce_rig.rig.settings import PATTERNS

# Validation errors with file, line, key and the nearest valid key.

# The search for the nearest key takes 1 ms per problem.
_MOST_SHOWN = 100


@dataclass(frozen=True)
class _InvalidKey:
    path: KeyPath
    what: str
    # The valid key nearest to an unknown one; it need not be reported as missing as well.
    meant: KeyPath | None = None


def explain(error: ValidationError, document: Document) -> ProfileError:
    """Build the error for the user, with each problem once, in the order of the file's lines."""
    details = error.errors()
    problems = {
        problem.path: problem for problem in reversed([_problem(detail) for detail in details[:_MOST_SHOWN]])
    }
    meant = {problem.meant for problem in problems.values()}
    lines = [
        (document.line(path), f"{'.'.join(map(str, path))}: {problem.what}" if path else problem.what)
        for path, problem in problems.items()
        if path not in meant
    ]
    places = {line: f"{document.source}:{line}" if document.lines else document.source for line, _ in lines}
    sentences = [f"{places[line]}: {text}" for line, text in sorted(lines)]
    if len(sentences) == 1:
        return ProfileError(sentences[0])
    n_more = max(len(details) - _MOST_SHOWN, 0)
    what = f"{document.source}: {len(sentences) + n_more} problems"
    return ProfileError(what, "\n".join([*sentences, *([f"and {n_more} more"] if n_more else [])]))


def _problem(detail: ErrorDetails) -> _InvalidKey:
    path = tuple(part for part in detail["loc"] if part != "[key]")
    kind, given, context = detail["type"], detail["input"], detail.get("ctx", {})
    if kind == "extra_forbidden":
        return _unknown_key(path)
    if kind == "missing" and isinstance(path[-1], int):
        return _InvalidKey(path[:-1], f"{_shown(given)} has too few values")
    if kind == "missing":
        return _InvalidKey(path, "is missing")
    if kind == "profile":
        return _InvalidKey((*path, *_parts(context["key"])), context["what"])
    if kind == "string_pattern_mismatch":
        return _InvalidKey(path, f"{_shown(given)}: {PATTERNS[context['pattern']]}")
    if "controls" in path[:-2]:
        # The last part names the member of the union that validation tried.
        return _InvalidKey(path[:-1], "must be a text, a number, true or false")
    what = detail["msg"].replace("Input should", "must").replace("Tuple should", "must")
    what = (
        what.replace("a valid i", "an i")
        .replace("a valid ", "a ")
        .replace("List should", "must")
        .replace("a tuple", "a list")
        .replace("a dictionary", "a block of keys")
        .replace(" after validation", "")
    )
    return _InvalidKey(path, f"{what}; {_shown(given)} given")


def _parts(key: str) -> KeyPath:
    return tuple(int(part) if part.isdigit() else part for part in key.split(".") if part)


def _shown(value: Any) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _unknown_key(path: KeyPath) -> _InvalidKey:
    key = str(path[-1])
    valid = valid_keys(path[:-1])
    # A missing unit is the most likely error: for difflib, fx is as close to fy_px as to fx_px.
    nearest = [name for name in valid if name.startswith(f"{key}_")]
    elsewhere = [block for block, name in all_keys() if name == key]
    if elsewhere and not nearest:
        return _InvalidKey(path, f"unknown key here; move it to {elsewhere[0] or 'the top level'}")
    nearest = nearest or difflib.get_close_matches(key, valid, n=1)
    if nearest:
        return _InvalidKey(path, f"unknown key; the nearest is {nearest[0]}", (*path[:-1], nearest[0]))
    return _InvalidKey(path, f"unknown key; choose one of: {', '.join(valid)}")


def valid_keys(path: KeyPath) -> list[str]:
    """List the keys that a block may have.

    Args:
        path: the block's path; () for the whole profile.
    """
    model: type[BaseModel] | None = Rig
    parts = list(path)
    while parts and model is not None:
        key = str(parts.pop(0))
        annotation = model.model_fields[key].annotation if key in model.model_fields else None
        model = _model_within(annotation)
        # Names of sensors and list indices lie between a block and its settings.
        if parts and not _is_block(annotation):
            parts.pop(0)
    return list(model.model_fields) if model is not None else []


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _is_block(annotation: Any) -> bool:
    """Return whether an annotation is one settings block, optional or not, not a dict or list of them."""
    return _is_model(annotation) or any(_is_model(argument) for argument in _members(annotation))


def _members(annotation: Any) -> tuple[Any, ...]:
    return get_args(annotation) if isinstance(annotation, UnionType) else ()


def _model_within(annotation: Any) -> type[BaseModel] | None:
    """Find the settings class in an annotation such as dict[Name, CameraSettings]."""
    if _is_model(annotation):
        found: type[BaseModel] = annotation
        return found
    inner = (_model_within(argument) for argument in get_args(annotation))
    return next((model for model in inner if model is not None), None)


def all_keys(model: type[BaseModel] = Rig, block: str = "") -> Iterator[tuple[str, str]]:
    """List every key of the schema as (block, key), names of sensors and list indices shown as *."""
    for key, field in model.model_fields.items():
        yield block, key
        inner = _model_within(field.annotation)
        if inner is not None:
            name = "" if _is_block(field.annotation) else ".*"
            yield from all_keys(inner, f"{block}.{key}{name}".removeprefix("."))


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
        ProfileError: neither exists; the hint lists the shipped names.
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
    nearest_name = f"The nearest is {nearest[0]}. " if nearest else ""
    hint = f"{nearest_name}Choose one of: {', '.join(shipped)}, or give the path of a file."
    raise ProfileError(f"no rig profile is called {text}", hint)


def load_rig(name_or_path: str | Path) -> Rig:
    """Load the profile of a rig; paths in it become absolute.

    Args:
        name_or_path: name of a shipped profile ("rlfs") or path of a YAML file.

    Raises:
        ProfileError: no such profile, or an invalid one; every problem with file, line and key.
    """
    path = find_profile(name_or_path)
    return parse_rig(read_profile(path), str(path)).located(path.parent)


def read_profile(path: Path) -> str:
    """Read the text of a profile's file.

    Raises:
        ProfileError: it cannot be read, is not text, or is too large.
    """
    with reading(path, ProfileError):
        try:
            return read_file(path, MAX_DOCUMENT_BYTES).decode()
        except UnicodeDecodeError as error:
            raise ProfileError(f"{path}: is not UTF-8 text (byte {error.start})") from error


def parse_rig(text: str, source: str = "profile") -> Rig:
    """Build a rig from YAML text.

    Args:
        text: the YAML.
        source: name of the text in errors, usually its file.

    Raises:
        ProfileError: the text is not a valid profile.
    """
    return rig_from_document(read_document(text, source))


def rig_from_document(document: Document) -> Rig:
    """Validate a document; raise a ProfileError that lists every problem with its line."""
    try:
        return Rig.model_validate(document.data)
    except ValidationError as error:
        raise explain(error, document) from error


def dump_rig(rig: Rig) -> str:
    """Write a rig as YAML, without comments; `parse_rig` returns an equal rig."""
    data = rig.model_dump(mode="json", exclude_none=True)
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100)


class _Dumper(yaml.SafeDumper):
    """Write block style, but short lists of numbers on one line, and floats that read back as floats."""

    def represent_sequence(
        self, tag: str, sequence: Iterable[Any], flow_style: bool | None = None
    ) -> yaml.SequenceNode:
        is_flat = all(not isinstance(item, dict) for item in sequence)
        return super().represent_sequence(tag, sequence, flow_style=is_flat)
