"""Edits of a profile's text that keep comments and layout.

PyYAML's marks give the start and end of a key's text. ruamel.yaml would keep comments, too, but it ties each
comment to the key above it: a key added to or removed from a block takes the next block's comments along.
"""

import math
from collections.abc import Sequence
from typing import Any

import yaml

from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import UsageError
from lce_rig.rig.loading import BAD_SCALARS, read_document, rig_from_document
from lce_rig.rig.sensors import lens_block


def derive_text(
    text: str,
    name: str,
    settings: Sequence[tuple[str, str]],
    source: str,
    origin: str,
) -> str:
    """Derive a profile's text from another's.

    Args:
        text: the other profile.
        name: name of the new rig.
        settings: (key path, YAML value) to set, such as ("board.square_m", "0.08").
        source: name of the new text in errors, usually its file.
        origin: name of the other profile.

    Returns:
        The new profile, which is valid.

    Raises:
        ProfileError: the new profile would not be valid.
        UsageError: a value that is not YAML, or a path into something that has no keys.
    """
    head = f"# {name}: made from {origin} by `rigs new`; the comments below are from {origin}.\n"
    # The comments above the first key describe the other profile.
    text = head + set_value(text[_compose(text).start_mark.index :], "name", as_yaml(name))
    if "description" in read_document(text, origin).data:
        text = set_value(text, "description", "''")
    return edit_text(text, settings, source)


def edit_text(text: str, settings: Sequence[tuple[str, str]], source: str) -> str:
    """Set keys of a profile's text; arguments, result and errors as in `derive_text`."""
    for path, value in settings:
        text = set_value(text, path, value)
    rig_from_document(read_document(text, source))
    return text


def lens_settings(camera: str, lens: Intrinsics, **others: float) -> list[tuple[str, str]]:
    """List the keys and values that `edit_text` sets for a camera's intrinsics.

    Args:
        camera: the camera's name.
        lens: intrinsics, with the image size.
        others: further keys of the block `intrinsics`.
    """
    block = {f"cameras.{camera}.intrinsics.{key}": v for key, v in (lens_block(lens) | others).items()}
    values = {f"cameras.{camera}.resolution_px": [lens.width_px, lens.height_px], **block}
    return [(key, as_yaml(value)) for key, value in values.items()]


def as_yaml(value: Any) -> str:
    """Write plain data as YAML on one line."""
    return yaml.safe_dump([value], default_flow_style=True, sort_keys=False, width=math.inf).strip()[1:-1]


def set_value(text: str, path: str, value: str) -> str:
    """Set one key in YAML text; a key that is missing is added at the end of its block.

    Args:
        text: valid YAML.
        path: keys and list indices joined by dots: "nominal_extrinsics.0.tolerance_m".
        value: the value as YAML on one line: "0.1", "[1, 2]".

    Raises:
        UsageError: a value that is not YAML on one line, or a path into something that has no keys.
    """
    keys = path.split(".")
    try:
        wanted = _load(value)
    except UsageError:
        raise UsageError(f"--set {path}: {value!r} is not a YAML value") from None
    if "\n" in value or not value.strip() or not all(keys):
        raise UsageError(f"--set {path}={value}: expected KEY=VALUE, such as board.square_m=0.08")
    node, depth = _descend(_compose(text), keys)
    if depth == len(keys):
        new = text[: node.start_mark.index] + value + text[_end(node) :]
    elif not isinstance(node, yaml.MappingNode):
        raise UsageError(f"--set {path}: {'.'.join(keys[:depth])} has no key {keys[depth]}")
    else:
        entry = value
        for key in reversed(keys[depth + 1 :]):
            entry = f"{{{key}: {entry}}}"
        entry = f"{keys[depth]}: {entry}"
        if node.flow_style:
            at = node.end_mark.index - 1
            new = f"{text[:at]}{', ' if node.value else ''}{entry}{text[at:]}"
        else:
            at = text.find("\n", _end(node))
            at = len(text) if at < 0 else at
            new = f"{text[:at]}\n{' ' * node.start_mark.column}{entry}{text[at:]}"
    data = _load(new)
    for key in keys:
        data = data[int(key)] if isinstance(data, list) else data.get(key) if isinstance(data, dict) else None
    if data != wanted:
        raise UsageError(f"--set {path}: {value!r} is not allowed there", "quote a text that holds : or #")
    return new


def _load(text: str) -> object:
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, *BAD_SCALARS) as error:
        raise UsageError(f"this is not YAML: {text[:60]!r}") from error


def _compose(text: str) -> yaml.Node:
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    if root is None:
        raise UsageError("the profile is empty")
    return root


def _descend(node: yaml.Node, keys: Sequence[str]) -> tuple[yaml.Node, int]:
    """Follow keys as far as they exist; return the node and the number of keys followed."""
    for depth, key in enumerate(keys):
        below = None
        if isinstance(node, yaml.MappingNode):
            below = next((value for name, value in node.value if name.value == key), None)
        elif isinstance(node, yaml.SequenceNode) and key.isdigit() and int(key) < len(node.value):
            below = node.value[int(key)]
        if below is None:
            return node, depth
        node = below
    return node, len(keys)


def _end(node: yaml.Node) -> int:
    """Find the end of a node's text; a block's own end mark follows its trailing comments."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    end: int = node.end_mark.index
    return end
