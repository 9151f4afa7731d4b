"""A network file loaded by onnxruntime: its inputs and outputs, and one run of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from lce_rig.core.interrupts import without_interrupt
from lce_rig.detect.events.reconstruct.voxels import FloatArray

Shape = tuple[int | str | None, ...]


class NetworkError(Exception):
    """An error of onnxruntime or of its process.

    Args:
        what: one line.
        hint: what to do about it; empty if the file is not what is expected.
    """

    def __init__(self, what: str, hint: str = "") -> None:
        super().__init__(what)
        self.hint = hint


@dataclass(frozen=True)
class Port:
    """An input or output: its name, and its shape with sizes, names of sizes, or None."""

    name: str
    shape: Shape


class NetworkSession(Protocol):
    """A loaded network."""

    @property
    def inputs(self) -> Sequence[Port]:
        """List the inputs in the file's order."""
        ...

    @property
    def outputs(self) -> Sequence[Port]:
        """List the outputs in the file's order."""
        ...

    def run(self, feeds: Sequence[FloatArray], expected: Sequence[tuple[int, ...]]) -> list[FloatArray]:
        """Compute the outputs.

        Args:
            feeds: one for each input.
            expected: shape of each output.

        Raises:
            NetworkError: it fails, or gives other shapes.
        """
        ...


class LocalSession:
    """A network in this process."""

    def __init__(self, content: bytes, n_threads: int) -> None:
        """Load.

        Args:
            content: of the file.
            n_threads: of onnxruntime.

        Raises:
            ImportError: onnxruntime is not installed.
            NetworkError: it is not an ONNX file, or cannot be run.
        """
        with without_interrupt():
            import onnxruntime
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = n_threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises classes of its own, one for each status
            raise NetworkError(_first_line(error)) from error
        self.inputs: Sequence[Port] = [_port(item) for item in self._session.get_inputs()]
        self.outputs: Sequence[Port] = [_port(item) for item in self._session.get_outputs()]

    def run(self, feeds: Sequence[FloatArray], expected: Sequence[tuple[int, ...]]) -> list[FloatArray]:
        """Compute the outputs."""
        names = [port.name for port in self.inputs]
        try:
            found = self._session.run(None, dict(zip(names, feeds, strict=True)))
        except Exception as error:  # see __init__
            raise NetworkError(_first_line(error)) from error
        shapes = [getattr(array, "shape", None) for array in found]
        for name, shape, wanted in zip((port.name for port in self.outputs), shapes, expected, strict=True):
            if shape != wanted:
                raise NetworkError(f"its output {name} has the shape {shape}, not {wanted}")
        return [np.asarray(array, np.float32) for array in found]


def _port(item: Any) -> Port:
    return Port(str(item.name), tuple(item.shape or ()))


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)
