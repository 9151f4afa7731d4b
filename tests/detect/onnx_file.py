"""ONNX files written by hand, without the onnx package: only what hostile networks need."""

from collections.abc import Sequence
from pathlib import Path

FLOAT = 1
Dims = Sequence[int | str]


def _varint(value: int) -> bytes:
    found = bytearray()
    while value > 127:
        found.append(value & 127 | 128)
        value >>= 7
    return bytes([*found, value])


def number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def text(field: int, value: str | bytes) -> bytes:
    content = value.encode() if isinstance(value, str) else value
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def external_tensor(name: str, dims: Sequence[int], location: str) -> bytes:
    entry = text(1, "location") + text(2, location)
    return (
        b"".join(number(1, n) for n in dims)
        + number(2, FLOAT)
        + text(8, name)
        + text(13, entry)
        + number(14, 1)
    )


def integers(name: str, values: Sequence[int]) -> bytes:
    return text(5, text(1, name) + b"".join(number(8, value) for value in values) + number(20, 7))


def integer(name: str, value: int) -> bytes:
    return text(5, text(1, name) + number(3, value) + number(20, 2))


def node(kind: str, inputs: Sequence[str], outputs: Sequence[str], attributes: bytes = b"") -> bytes:
    ports = b"".join(text(1, name) for name in inputs) + b"".join(text(2, name) for name in outputs)
    return ports + text(4, kind) + attributes


def value(name: str, dims: Dims) -> bytes:
    sizes = b"".join(text(1, text(2, n) if isinstance(n, str) else number(1, n)) for n in dims)
    return text(1, name) + text(2, text(1, number(1, FLOAT) + text(2, sizes)))


def graph(
    nodes: Sequence[bytes], inputs: Sequence[bytes], outputs: Sequence[bytes], tensors: Sequence[bytes] = ()
) -> bytes:
    parts = [(1, nodes), (5, tensors), (11, inputs), (12, outputs)]
    return text(2, "g") + b"".join(text(field, each) for field, items in parts for each in items)


def write(path: Path, content: bytes) -> Path:
    """Write a graph as a file of opset 17."""
    path.write_bytes(number(1, 8) + text(7, content) + text(8, text(1, "") + number(2, 17)))
    return path


VOXELS = value("v", [1, 5, "height", "width"])
PICTURE = value("p", [1, 1, "height", "width"])
MEAN = node("ReduceMean", ["v"], ["p"], integers("axes", [1]) + integer("keepdims", 1))


def recurrent_network(path: Path, dims: Dims) -> Path:
    """Carry one state on as it is."""
    nodes = [MEAN, node("Identity", ["s"], ["t"])]
    return write(path, graph(nodes, [VOXELS, value("s", dims)], [PICTURE, value("t", dims)]))


def network_with_weights_in(path: Path, location: str) -> Path:
    """Add a weight that lies in another file."""
    nodes = [
        node("ReduceMean", ["v"], ["q"], integers("axes", [1]) + integer("keepdims", 1)),
        node("Add", ["q", "w"], ["p"]),
    ]
    return write(path, graph(nodes, [VOXELS], [PICTURE], [external_tensor("w", [1], location)]))
