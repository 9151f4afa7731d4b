"""The network file: what it must offer, and one step of it."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.errors import ProfileError, SourceError
from lce_rig.core.interrupts import without_interrupt
from lce_rig.detect.reconstruct.voxels import FloatArray

States = tuple[FloatArray, ...]

_EXPECTED = (
    "expected the inputs voxels (1, bins, height, width) and states (1, channels, height_2, width_2) with "
    "height_2 meaning half of the height and so on, and the outputs picture (1, 1, height, width) and the "
    "next states in the same order; docs/model-card.md says how to export such a file"
)


@dataclass(frozen=True)
class StateSpec:
    """A recurrent state's channels and its size as a fraction of the picture's: 2 is half."""

    name: str
    n_channels: int
    divisor: int


class ReconstructionModel:
    """A recurrent event-to-image network in ONNX, its state explicit.

    Args:
        path: ONNX file; None takes the one shipped with the package.
        n_threads: threads of onnxruntime.

    Raises:
        ProfileError: the file cannot be loaded, or has other inputs or outputs than expected.
        SourceError: onnxruntime is not installed.
    """

    def __init__(self, path: Path | None = None, n_threads: int = 1) -> None:
        self.name = "the shipped model" if path is None else str(path)
        self._session = _load(path, self.name, n_threads)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        self._input_names = [item.name for item in inputs]
        self._output_names = [item.name for item in outputs]
        if len(inputs) < 1 or len(inputs) != len(outputs):
            raise self._refused(f"{len(inputs)} inputs and {len(outputs)} outputs")
        self.n_bins = self._check_voxels(inputs[0])
        self.states = tuple(self._read_state(item) for item in inputs[1:])
        # The picture is padded so that every state has a whole number of rows and columns.
        self.size_multiple = int(np.lcm.reduce([2, *(state.divisor for state in self.states)]))

    def initial_states(self, height_px: int, width_px: int) -> States:
        """Make the states before the first window for a sensor of this size: zeros."""
        height, width = self._padded(height_px), self._padded(width_px)
        return tuple(
            np.zeros((1, spec.n_channels, height // spec.divisor, width // spec.divisor), np.float32)
            for spec in self.states
        )

    def step(self, voxels: FloatArray, states: States) -> tuple[FloatArray, States]:
        """Reconstruct one window.

        Args:
            voxels: (bins, H, W) normalised voxel grid.
            states: as the last step or `initial_states` gave them.

        Returns:
            picture (H, W), arbitrary scale; next states.
        """
        _, height, width = voxels.shape
        rows, cols = self._padded(height) - height, self._padded(width) - width
        grid = np.pad(voxels, ((0, 0), (0, rows), (0, cols)))[None]
        feeds = dict(zip(self._input_names, (grid, *states), strict=True))
        try:
            picture, *following = self._session.run(self._output_names, feeds)
        except Exception as error:  # onnxruntime raises classes of its own, one for each status
            raise self._refused(f"a step of {width} x {height} px fails: {_first_line(error)}") from error
        expected = (1, 1, height + rows, width + cols)
        if picture.shape != expected or any(
            a.shape != b.shape for a, b in zip(states, following, strict=True)
        ):
            raise self._refused(f"a step of {width} x {height} px gives a picture of shape {picture.shape}")
        return picture[0, 0, :height, :width], tuple(following)

    def _padded(self, size_px: int) -> int:
        return -(-size_px // self.size_multiple) * self.size_multiple

    def _check_voxels(self, item: Any) -> int:
        shape = _shape(item)
        is_fixed = len(shape) == 4 and any(isinstance(size, int) for size in shape[2:])
        if len(shape) != 4 or not isinstance(shape[1], int) or shape[1] < 2 or is_fixed:
            raise self._refused(f"its first input {item.name} has the shape {tuple(shape)}")
        return int(shape[1])

    def _read_state(self, item: Any) -> StateSpec:
        shape = _shape(item)
        if len(shape) != 4 or not isinstance(shape[1], int):
            raise self._refused(f"its input {item.name} has the shape {tuple(shape)}")
        divisors = [re.fullmatch(r"(?:height|width)(?:_(\d+))?", str(size)) for size in shape[2:]]
        values = [int(match.group(1) or 1) if match else 0 for match in divisors]
        if values[0] == 0 or values[0] != values[1]:
            raise self._refused(f"its input {item.name} has the shape {tuple(shape)}")
        return StateSpec(item.name, shape[1], values[0])

    def _refused(self, what: str) -> ProfileError:
        return ProfileError(f"reconstruction model {self.name}: {what}", _EXPECTED)


def _shape(item: Any) -> Sequence[int | str | None]:
    return list(item.shape or [])


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


def model_bytes(path: Path | None) -> bytes:
    """Read a network's file; None takes the one shipped with the package.

    Raises:
        ProfileError: there is no such file.
    """
    if path is None:
        return (resources.files("lce_rig") / "models" / "reconstruction.onnx").read_bytes()
    _require_file(path)
    return path.read_bytes()


def _require_file(path: Path) -> None:
    if not path.is_file():
        raise ProfileError(
            f"reconstruction model {path}: no such file", "leave the key out for the shipped one"
        )


def _load(path: Path | None, name: str, n_threads: int) -> Any:
    try:
        with without_interrupt():
            import onnxruntime
    except ImportError as error:
        raise SourceError("onnxruntime is not installed", "pip install onnxruntime") from error
    if path is not None:
        _require_file(path)
    # A network whose weights lie in files beside it must be named, not read.
    path_or_bytes: Any = model_bytes(None) if path is None else str(path)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = n_threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(path_or_bytes, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # see step
        raise ProfileError(
            f"reconstruction model {name}: no ONNX file: {_first_line(error)}", _EXPECTED
        ) from error
