"""Read and write profiles as YAML, by name or by path; errors name file, line and key."""

import difflib
import reprlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Any, get_args

import numpy as np
import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails
from yaml.constructor import ConstructorError

from lce_rig.core.board import Board
from lce_rig.core.bounds import MAX_TEXT_BYTES
from lce_rig.core.errors import ProfileError, reading
from lce_rig.rig.board_settings import BoardSettings
from lce_rig.rig.profile import Rig
from lce_rig.rig.settings import PATTERNS

KeyPath = tuple[str | int, ...]
BAD_SCALARS = (ValueError, ArithmeticError, LookupError, AttributeError, TypeError)
"""Errors of PyYAML for a scalar that contradicts its tag: `!!bool x`, `!!int ""`, `!!timestamp x`."""
_SUFFIXES = (".yaml", ".yml")
# Texts of pydantic's messages, and their replacements.
_REWORDED = (
    ("Input should", "must"),
    ("Tuple should", "must"),
    ("List should", "must"),
    ("a valid i", "an i"),
    ("a valid ", "a "),
    ("a tuple", "a list"),
    ("a dictionary", "a block of keys"),
    ("Value error, ", ""),
    (" after validation", ""),
)


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
    """Load the profile of a rig.

    Args:
        name_or_path: name of a shipped profile ("rlfs") or path of a YAML file.

    Raises:
        ProfileError: no such profile, or an invalid one; every problem with file, line and key.
    """
    path = find_profile(name_or_path)
    return parse_rig(read_profile(path), str(path))


def read_profile(path: Path) -> str:
    """Read the text of a profile's file.

    Raises:
        ProfileError: the file cannot be read, or is not text.
    """
    with reading(path, ProfileError, most_bytes=MAX_TEXT_BYTES):
        try:
            return path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            hint = "Give the YAML file of a rig; recordings are given with --from."
            raise ProfileError(f"{path}: not a profile: it is not text", hint) from None


def parse_rig(text: str, source: str = "profile") -> Rig:
    """Build a rig from YAML text.

    Args:
        text: the YAML.
        source: name of the text in errors, usually its file.

    Raises:
        ProfileError: the text is not a valid profile.
    """
    return rig_from_document(read_document(text, source))


def dump_rig(rig: Rig, *, is_whole: bool = True) -> str:
    """Write a rig as YAML, without comments; `parse_rig` returns an equal rig.

    Args:
        rig: the profile.
        is_whole: whether to write settings that have their default, too; models always are.
    """
    whole = rig.model_dump(mode="json", exclude_none=True)
    if is_whole:
        return dump_yaml(whole)
    return dump_yaml(_changed(whole, rig.model_dump(mode="json", exclude_none=True, exclude_defaults=True)))


def _changed(whole: Mapping[str, Any], changed: Mapping[str, Any]) -> dict[str, Any]:
    """Keep the models, and the keys that are in `changed`, which has the same blocks."""
    return {
        key: _changed(value, changed[key]) if isinstance(value, dict) and key in changed else value
        for key, value in whole.items()
        if key in changed or key == "model"
    }


def dump_yaml(data: Mapping[str, Any], width: float = 100) -> str:
    """Write plain data and arrays as YAML, blocks in the order given."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=width)


class _Dumper(yaml.SafeDumper):
    """Write block style, but lists of numbers or names on one line, and floats that read back as floats."""

    def ignore_aliases(self, data: Any) -> bool:
        """Return True: repeated values are written in full, without YAML aliases."""
        return True

    def represent_sequence(
        self, tag: str, sequence: Iterable[Any], flow_style: bool | None = None
    ) -> yaml.SequenceNode:
        is_flat = all(not isinstance(item, dict | list) for item in sequence)
        return super().represent_sequence(tag, sequence, flow_style=is_flat)

    def represent_str(self, text: str) -> yaml.ScalarNode:
        """Quote names such as 000008, which are numbers in YAML 1.2."""
        return self.represent_scalar("tag:yaml.org,2002:str", text, style='"' if text.isdecimal() else None)


_Dumper.add_representer(str, _Dumper.represent_str)
_Dumper.add_representer(np.ndarray, lambda dumper, array: dumper.represent_list((array + 0.0).tolist()))


class _Loader(yaml.SafeLoader):
    """Refuse keys given twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        data: dict[Any, Any] = {}
        for key, value in node.value:
            # As written: YAML 1.1 reads the keys `on` and `no` as truth values.
            if key.value in data:
                raise ConstructorError(None, None, f"{key.value} is given twice", key.start_mark)
            data[key.value] = self.construct_object(value, deep=True)
        return data


@dataclass(frozen=True, eq=False)
class Document:
    """Parsed YAML.

    Attributes:
        source: file the text came from.
        data: the plain data.
        root: the nodes, with their lines; None if errors are to name keys only.
    """

    source: str
    data: Any
    root: yaml.Node | None

    def line(self, path: KeyPath) -> int:
        """Find the line (from 1) of a key, or of the nearest block around it that exists."""
        node, line = self.root, 1
        for part in path:
            if isinstance(node, yaml.MappingNode):
                pairs = {key.value: (key, value) for key, value in node.value}
                key, node = pairs.get(part, (None, None))
            else:
                items = node.value if isinstance(node, yaml.SequenceNode) else []
                key = node = items[part] if isinstance(part, int) and part < len(items) else None
            if key is None:
                break
            line = key.start_mark.line + 1
        return line


def read_document(
    text: str,
    source: str,
    kind: str = "a rig profile",
    hint: str = "Start from a shipped one: `lce-rig rigs new NAME --from rlfs`",
) -> Document:
    """Parse YAML text by the safe loader.

    Args:
        text: the YAML.
        source: name of the text in errors, usually its file.
        kind: kind of file, for the error of a text that is not a mapping.
        hint: hint of that error.

    Raises:
        ProfileError: not YAML, not a mapping, or a key given twice; with file and line.
    """
    try:
        loader = _Loader(text)
        root = loader.get_single_node()
        data: Any = None if root is None else loader.construct_document(root)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{source}:{mark.line + 1}" if mark else source
        raise ProfileError(f"{where}: not YAML: {error.problem or error.context}") from error
    except (yaml.YAMLError, RecursionError, *BAD_SCALARS) as error:
        raise ProfileError(f"{source}: not YAML: {str(error).splitlines()[0]}") from error
    if not isinstance(data, dict):
        raise ProfileError(f"{source}: is not {kind}: expected a mapping of keys", hint)
    return Document(source, data, root)


def rig_from_document(document: Document) -> Rig:
    """Validate a document; raise a ProfileError that lists every problem with its line."""
    try:
        return Rig.model_validate(document.data)
    except ValidationError as error:
        raise explain(error, document) from error


def board_of(values: Mapping[str, Any], source: str) -> Board:
    """Build a board from the keys of its block in a profile; raises a ProfileError as `rig_from_document`."""
    try:
        return BoardSettings.model_validate(values).to_board()
    except ValidationError as error:
        raise explain(error, Document(source, {}, root=None)) from error


def explain(error: ValidationError, document: Document, schema: type[BaseModel] = Rig) -> ProfileError:
    """Build the error for the user, with each problem once, in the order of the file's lines."""
    problems: dict[KeyPath, tuple[str, KeyPath | None]] = {}
    for detail in error.errors():
        path, what, meant = _problem(detail, schema)
        problems.setdefault(path, (what, meant))
    # A misspelt key is not reported as missing as well.
    all_meant = {meant for _, meant in problems.values()}
    lines = sorted(
        (document.line(path), f"{'.'.join(map(str, path))}: {what}" if path else what)
        for path, (what, _) in problems.items()
        if path not in all_meant
    )
    source = document.source
    sentences = [f"{source}{f':{line}' if document.root else ''}: {text}" for line, text in lines]
    if len(sentences) == 1:
        return ProfileError(sentences[0])
    return ProfileError(f"{source}: {len(sentences)} problems", "\n".join(sentences))


def _problem(detail: ErrorDetails, schema: type[BaseModel]) -> tuple[KeyPath, str, KeyPath | None]:
    """Return a problem's key, its text, and the valid key that an unknown one probably stands for."""
    path = tuple(part for part in detail["loc"] if part != "[key]")
    kind, context = detail["type"], detail.get("ctx", {})
    # Bounded: repr() would write nested aliases out.
    value = "nothing" if detail["input"] is None else reprlib.repr(detail["input"])
    if kind == "extra_forbidden":
        return path, *_unknown_key(path, schema)
    if kind == "missing" and isinstance(path[-1], int):
        return path[:-1], f"{value} has too few values", None
    if kind == "missing":
        return path, "is missing", None
    if kind == "profile":
        parts = (int(part) if part.isdigit() else part for part in context["key"].split(".") if part)
        return (*path, *parts), context["what"], None
    if kind == "string_pattern_mismatch":
        return path, f"{value}: {PATTERNS[context['pattern']]}", None
    if "controls" in path[:-2]:
        # The last part names the member of the union that validation tried.
        return path[:-1], "must be a text, a number, true or false", None
    what = detail["msg"]
    for old, new in _REWORDED:
        what = what.replace(old, new)
    if kind == "less_than_equal" and any(str(part).endswith("_m") for part in path):
        return path, f"{what} m; {value} given: write metres", None
    return path, f"{what}; {value} given", None


def _unknown_key(path: KeyPath, schema: type[BaseModel]) -> tuple[str, KeyPath | None]:
    key, place = str(path[-1]), [str(part) for part in path[:-1]]
    blocks = [(block.split(".") if block else [], name) for block, name in all_keys(schema)]
    valid = [
        name
        for block, name in blocks
        if len(block) == len(place) and all(a in ("*", b) for a, b in zip(block, place, strict=True))
    ]
    # A missing unit is the most likely error: for difflib, fx is as close to fy_px as to fx_px.
    nearest = [name for name in valid if name.startswith(f"{key}_")]
    elsewhere = [block for block, name in all_keys(schema) if name == key]
    if elsewhere and not nearest:
        return f"unknown key here; move it to {elsewhere[0] or 'the top level'}", None
    nearest = nearest or difflib.get_close_matches(key, valid, n=1)
    if nearest:
        return f"unknown key; the nearest is {nearest[0]}", (*path[:-1], nearest[0])
    return f"unknown key; choose one of: {', '.join(valid)}", None


def all_keys(model: type[BaseModel] = Rig, block: str = "") -> Iterator[tuple[str, str]]:
    """List every key of the schema as (block, key), names of sensors and list indices shown as *."""
    for key, field in model.model_fields.items():
        yield block, key
        for inner, name in _models_within(field.annotation):
            yield from all_keys(inner, f"{block}.{key}{name}".removeprefix("."))


def _models_within(annotation: Any, name: str = "") -> Iterator[tuple[type[BaseModel], str]]:
    """List the settings classes in an annotation such as dict[Name, CameraSettings], with ".*" if named."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation, name
        return
    for argument in get_args(annotation):
        yield from _models_within(argument, name if isinstance(annotation, UnionType) else ".*")
