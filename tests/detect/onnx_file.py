"""ONNX files written by hand, without the onnx package: networks that copy their inputs."""

FLOAT = 1


def _varint(value):
    found = bytearray()
    while value > 127:
        found.append(value & 127 | 128)
        value >>= 7
    return bytes([*found, value])


def number(field, value):
    return _varint(field << 3) + _varint(value)


def text(field, value):
    content = value.encode() if isinstance(value, str) else value
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def integers(name, values):
    return text(5, text(1, name) + b"".join(number(8, value) for value in values) + number(20, 7))


def integer(name, value):
    return text(5, text(1, name) + number(3, value) + number(20, 2))


def node(kind, inputs, outputs, attributes=b""):
    ports = b"".join(text(1, name) for name in inputs) + b"".join(text(2, name) for name in outputs)
    return ports + text(4, kind) + attributes


def value(name, dims):
    sizes = b"".join(text(1, text(2, n) if isinstance(n, str) else number(1, n)) for n in dims)
    return text(1, name) + text(2, text(1, number(1, FLOAT) + text(2, sizes)))


def write_network(path, inputs, outputs, *, drops_rows=False):
    """Write a graph of opset 17: the first output is the mean over bins, the others copy inputs."""

    def mean(name, output, axis):
        return node("ReduceMean", [name], [output], integers("axes", [axis]) + integer("keepdims", 1))

    nodes = []
    for k in range(len(outputs)):
        source = inputs[min(k, len(inputs) - 1)][0]
        is_mean = k == 0 or (drops_rows and k == 1)
        nodes.append(
            mean(source, f"o{k}", 2 if k else 1) if is_mean else node("Identity", [source], [f"o{k}"])
        )
    parts = [
        (1, nodes),
        (11, [value(name, dims) for name, dims in inputs]),
        (12, [value(f"o{k}", dims) for k, dims in enumerate(outputs)]),
    ]
    graph = text(2, "g") + b"".join(text(field, item) for field, items in parts for item in items)
    path.write_bytes(number(1, 8) + text(7, graph) + text(8, text(1, "") + number(2, 17)))
    return path
