"""Edits of a profile's text that keep comments and layout."""

import json
from collections.abc import Sequence

import yaml

from lce_rig.core.errors import UsageError
from lce_rig.rig.document import BAD_SCALARS, read_document
from lce_rig.rig.loading import rig_from_document


def derive_text(
    text: str,
    name: str,
    settings: Sequence[tuple[str, str]],
    source: str,
    origin: str,
    removed: Sequence[str] = (),
) -> str:
    """Derive a profile's text from another's.

    Args:
        text: the other profile.
        name: name of the new rig.
        settings: (key path, YAML value) to set, such as ("board.square_m", "0.08").
        source: name of the new text in errors, usually its file.
        origin: name of the other profile.
        removed: key paths to remove, such as "nominal_extrinsics".

    Returns:
        The new profile, which is valid.

    Raises:
        ProfileError: the new profile would not be valid.
        UsageError: a value that is not YAML, or a path into something that has no keys.
    """
    head = f"# {name}: made from {origin} by `lce-rig rigs new`; the comments below are from {origin}.\n"
    # What the other profile says of itself above its first key does not hold for this one.
    text = text[_begin(text) :]
    # A name such as 346 is a text only in quotes.
    text = head + set_value(text, "name", name if is_plain(name) else json.dumps(name))
    if "description" not in [key for key, _ in settings]:
        text = remove_key(text, "description", must_exist=False)
    return edit_text(text, settings, removed, source)


def edit_text(text: str, settings: Sequence[tuple[str, str]], removed: Sequence[str], source: str) -> str:
    """Remove and set keys of a profile's text; arguments, result and errors as of `derive_text`."""
    for path in removed:
        text = remove_key(text, path)
    for path, value in settings:
        text = set_value(text, path, value)
    rig_from_document(read_document(text, source))
    return text


def set_value(text: str, path: str, value: str) -> str:
    """Set one key in YAML text; a key that is missing is added at the end of its block.

    Args:
        text: valid YAML.
        path: keys and list indices joined by dots: "nominal_extrinsics.0.tolerance_m".
        value: the value as YAML on one line: "0.1", "[1, 2]".

    Raises:
        UsageError: a value that is not YAML on one line, or a path into something that has no keys.
    """
    wanted = _parsed(path, value)
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    if root is None:
        raise UsageError(f"--set {path}: no block for this key")
    keys = path.split(".")
    node, depth = _descend(root, keys)
    if depth == len(keys):
        new = text[: node.start_mark.index] + value + text[_end(node) :]
    elif isinstance(node, yaml.MappingNode):
        new = _insert(text, node, keys[depth:], value)
    else:
        raise UsageError(f"--set {path}: {'.'.join(keys[:depth])} has no key {keys[depth]}")
    if _value_at(new, keys) != wanted:
        raise UsageError(f"--set {path}: {value!r} is not allowed there", "quote a text that holds : or #")
    return new


def remove_key(text: str, path: str, *, must_exist: bool = True) -> str:
    """Remove one key with its value and the comments directly above it.

    Args:
        text: valid YAML.
        path: keys and places in lists joined by dots: "nominal_extrinsics", "cameras.cam.driver".
        must_exist: whether a key that is missing is an error.

    Raises:
        UsageError: there is no such key, or it cannot be removed.
    """
    keys = path.split(".")
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    node, depth = (root, 0) if root is None else _descend(root, keys[:-1])
    entry = None
    if depth == len(keys) - 1 and isinstance(node, yaml.MappingNode):
        entry = next(((key, value) for key, value in node.value if key.value == keys[-1]), None)
    if entry is None or not isinstance(node, yaml.MappingNode):
        if must_exist:
            raise UsageError(f"--unset {path}: the profile has no such key")
        return text
    key, value = entry
    if node.flow_style:
        raise UsageError(f"--unset {path}: remove it with --set {'.'.join(keys[:-1])}=VALUE")
    begin = text.rfind("\n", 0, key.start_mark.index) + 1
    indent = key.start_mark.column
    while begin > 0:
        above = text.rfind("\n", 0, begin - 1) + 1
        line = text[above : begin - 1]
        if not (line.lstrip().startswith("#") and len(line) - len(line.lstrip()) == indent):
            break
        begin = above
    end = text.find("\n", _end(value))
    new = text[:begin] + ("" if end < 0 else text[end + 1 :])
    if _value_at(new, keys) is not _ABSENT:
        raise UsageError(f"--unset {path}: it cannot be removed there")
    return new


def _begin(text: str) -> int:
    """Find where the first key stands, behind the comments above it."""
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    return 0 if root is None else int(root.start_mark.index)


_ABSENT = object()


def _value_at(text: str, keys: Sequence[str]) -> object:
    """Read the value of a key; `_ABSENT` if there is none, or the text is not YAML."""
    try:
        data = yaml.safe_load(text)
        for key in keys:
            data = data[int(key)] if isinstance(data, list) else data[key]
    except (yaml.YAMLError, RecursionError, *BAD_SCALARS):
        return _ABSENT
    return data


def is_plain(name: str) -> bool:
    """Return whether a text is read as that text without quotes."""
    try:
        return bool(yaml.safe_load(name) == name)
    except (yaml.YAMLError, RecursionError, *BAD_SCALARS):
        return False


def _parsed(path: str, value: str) -> object:
    try:
        parsed: object = yaml.safe_load(value)
    except (yaml.YAMLError, RecursionError, *BAD_SCALARS) as error:
        raise UsageError(f"--set {path}: {value!r} is not a YAML value") from error
    if "\n" in value or not value.strip() or not all(path.split(".")):
        raise UsageError(f"--set {path}={value}: expected KEY=VALUE, such as board.square_m=0.08")
    return parsed


def _descend(node: yaml.Node, keys: Sequence[str]) -> tuple[yaml.Node, int]:
    """Follow keys as far as they lead; return the node and how many keys were followed."""
    for depth, key in enumerate(keys):
        below = _child(node, key)
        if below is None:
            return node, depth
        node = below
    return node, len(keys)


def _child(node: yaml.Node, key: str) -> yaml.Node | None:
    if isinstance(node, yaml.MappingNode):
        return next((value for name, value in node.value if name.value == key), None)
    if isinstance(node, yaml.SequenceNode) and key.isdigit() and int(key) < len(node.value):
        child: yaml.Node = node.value[int(key)]
        return child
    return None


def _end(node: yaml.Node) -> int:
    """Find where a node's text ends; a block's own mark is after the comments that follow it."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    end: int = node.end_mark.index
    return end


def _insert(text: str, block: yaml.MappingNode, keys: Sequence[str], value: str) -> str:
    for key in reversed(keys[1:]):
        value = f"{{{key}: {value}}}"
    entry = f"{keys[0]}: {value}"
    if block.flow_style:
        at = block.end_mark.index - 1
        return f"{text[:at]}{', ' if block.value else ''}{entry}{text[at:]}"
    at = text.find("\n", _end(block))
    at = len(text) if at < 0 else at
    indent = " " * block.start_mark.column
    return f"{text[:at]}\n{indent}{entry}{text[at:]}"
