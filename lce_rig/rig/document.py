"""YAML text as plain data with the line number of each key."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import yaml

from lce_rig.core.documents import is_printable
from lce_rig.core.errors import ProfileError
from lce_rig.core.limits import describe

BAD_SCALARS = (ValueError, ArithmeticError, LookupError, AttributeError, TypeError)
"""Errors of PyYAML for a scalar that contradicts its tag: `!!bool x`, `!!int ""`, `!!timestamp x`."""
_MAX_INTEGER = 1 << 53
KeyPath = tuple[str | int, ...]

# A profile has a page or two; more is the wrong file, or an attack with nested aliases.
# Parsing 100 kB of YAML takes a second.
_MAX_BYTES = 1 << 18
_MAX_NODES = 20_000
_MAX_DEPTH = 20
_PLAIN_TAGS = ("tag:yaml.org,2002:map", "tag:yaml.org,2002:seq")


@dataclass(frozen=True, eq=False)
class Document:
    """Parsed YAML.

    Attributes:
        source: file the text came from.
        data: the plain data.
        lines: line (from 1) of each key's path.
    """

    source: str
    data: Any
    lines: Mapping[KeyPath, int]

    def line(self, path: KeyPath) -> int:
        """Find the line of a key, or of the nearest block around it that exists."""
        for length in range(len(path), 0, -1):
            if path[:length] in self.lines:
                return self.lines[path[:length]]
        return 1


def read_document(text: str, source: str) -> Document:
    """Parse YAML text by the safe loader.

    Raises:
        ProfileError: not YAML, not a mapping, or a key given twice; with file and line.
    """
    if len(text) > _MAX_BYTES:
        raise ProfileError(f"{source}: is too large to be a rig profile: {len(text)} characters")
    try:
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
        if node is None:
            raise ProfileError(
                f"{source}: is empty", "Start from a shipped one: `lce-rig rigs new NAME --from rlfs`"
            )
        reader = _Reader(loader, source)
        data = reader.read(node, ())
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{source}:{mark.line + 1}" if mark else source
        raise ProfileError(f"{where}: not YAML: {error.problem or error.context}") from error
    except yaml.YAMLError as error:
        raise ProfileError(f"{source}: not YAML: {str(error).splitlines()[0]}") from error
    except RecursionError as error:
        raise ProfileError(f"{source}: is too deeply nested to be a rig profile") from error
    if not isinstance(data, dict):
        raise ProfileError(f"{source}: is not a rig profile: expected a mapping of keys, found {_kind(data)}")
    return Document(source, data, reader.lines)


class _Reader:
    def __init__(self, loader: yaml.SafeLoader, source: str) -> None:
        self.lines: dict[KeyPath, int] = {}
        self._loader = loader
        self._source = source
        self._n_nodes = 0

    def read(self, node: yaml.Node, path: KeyPath) -> Any:
        self._n_nodes += 1
        if self._n_nodes > _MAX_NODES or len(path) > _MAX_DEPTH:
            raise ProfileError(f"{self._source}: is too large or too deeply nested to be a rig profile")
        if isinstance(node, yaml.CollectionNode) and node.tag not in _PLAIN_TAGS:
            raise ProfileError(
                f"{self._source}:{node.start_mark.line + 1}: the tag {node.tag} is not allowed in a profile"
            )
        if isinstance(node, yaml.MappingNode):
            return self._read_mapping(node, path)
        if isinstance(node, yaml.SequenceNode):
            for index, item in enumerate(node.value):
                place = (*path, index)
                self.lines[place] = item.start_mark.line + 1
            return [self.read(item, (*path, index)) for index, item in enumerate(node.value)]
        return self._construct(node)

    def _read_mapping(self, node: yaml.MappingNode, path: KeyPath) -> dict[str, Any]:
        data: dict[str, Any] = {}
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            key = self._construct(key_node) if isinstance(key_node, yaml.ScalarNode) else None
            # YAML 1.1 reads the keys `on`, `no` and `y` as booleans; use the text as written.
            key = (
                str(key_node.value)
                if isinstance(key_node, yaml.ScalarNode) and key != key_node.value
                else key
            )
            if not isinstance(key, str):
                raise ProfileError(f"{self._source}:{line}: a key must be a word")
            here = (*path, key)
            if key in data:
                where = ".".join(str(part) for part in here)
                first = self.lines[here]
                raise ProfileError(f"{self._source}:{line}: {where} is given twice, first on line {first}")
            self.lines[here] = line
            data[key] = self.read(value_node, here)
        return data

    def _construct(self, node: yaml.Node) -> Any:
        try:
            value = self._loader.construct_object(node, deep=True)
        except BAD_SCALARS as error:
            line = node.start_mark.line + 1
            raise ProfileError(
                f"{self._source}:{line}: {describe(node.value)} cannot be read: {error}"
            ) from error
        is_large = isinstance(value, int) and abs(value) > _MAX_INTEGER
        if is_large or (isinstance(value, str) and not is_printable(value)):
            line = node.start_mark.line + 1
            what = "is too large a number" if is_large else "holds half a character"
            raise ProfileError(f"{self._source}:{line}: {describe(node.value)} {what}")
        return value


def _kind(data: Any) -> str:
    return {list: "a list", str: "a text", type(None): "nothing"}.get(type(data), f"a {type(data).__name__}")
