"""The network file: its required inputs and outputs, and one step of it."""

import math
import re
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.errors import ProfileError, SourceError, reason_of
from lce_rig.core.interrupts import without_interrupt
from lce_rig.detect.events.reconstruct.windows import FloatArray

States = tuple[FloatArray, ...]
_MAX_MULTIPLE = 256

_EXPECTED = (
    "expected the inputs voxels (1, bins, height, width) and states (1, channels, height_2, width_2) with "
    "height_2 meaning half of the height and so on, and the outputs image (1, 1, height, width) and the "
    "next states in the same order; docs/model-card.md says how to export such a file"
)


@dataclass(frozen=True)
class StateSpec:
    """A recurrent state's channels and its size as a fraction of the image's: 2 is half."""

    name: str
    n_channels: int
    divisor: int


class ReconstructionModel:
    """A recurrent event-to-image network in ONNX, its state explicit.

    Args:
        path: ONNX file; None for the one shipped with the package.
        n_threads: threads of onnxruntime.

    Raises:
        ProfileError: the file cannot be loaded, or has other inputs or outputs than expected.
        SourceError: onnxruntime is not installed.
    """

    def __init__(self, path: Path | None = None, n_threads: int = 1) -> None:
        self.name = "the shipped model" if path is None else str(path)
        content = model_bytes(path)
        try:
            with without_interrupt():
                import onnxruntime
        except ImportError as error:
            raise SourceError("onnxruntime is not installed", "Run: pip install onnxruntime") from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = n_threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises classes of its own, one for each status
            raise self._refused(f"cannot be loaded: {reason_of(error)}") from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) < 1 or len(inputs) != len(outputs):
            raise self._refused(f"{len(inputs)} inputs and {len(outputs)} outputs")
        self.n_bins = self._check_voxels(inputs[0])
        self.states = tuple(self._read_state(item) for item in inputs[1:])
        # The image is padded so that every state has a whole number of rows and columns.
        self.size_multiple = math.lcm(2, *(state.divisor for state in self.states))
        if self.size_multiple > _MAX_MULTIPLE:
            raise self._refused(f"images would be padded to multiples of {self.size_multiple} px")

    def initial_states(self, height_px: int, width_px: int) -> States:
        """Make the states before the first window for a sensor of this size: zeros.

        Raises:
            ProfileError: they do not fit into memory.
        """
        height, width = self._padded(height_px), self._padded(width_px)
        try:
            return tuple(
                np.zeros((1, spec.n_channels, height // spec.divisor, width // spec.divisor), np.float32)
                for spec in self.states
            )
        except (MemoryError, ValueError) as error:  # ValueError: beyond what an array can hold
            raise self._refused("its states do not fit into memory") from error

    def step(self, voxels: FloatArray, states: States) -> tuple[FloatArray, States]:
        """Reconstruct one window.

        Args:
            voxels: (bins, H, W) normalised voxel grid.
            states: as the last step or `initial_states` gave them.

        Returns:
            image (H, W), arbitrary scale; next states.
        """
        _, height, width = voxels.shape
        rows, cols = self._padded(height) - height, self._padded(width) - width
        grid = np.pad(voxels, ((0, 0), (0, rows), (0, cols)))[None]
        names = (item.name for item in self._session.get_inputs())
        try:
            outputs = self._session.run(None, dict(zip(names, (grid, *states), strict=True)))
        except Exception as error:  # see __init__
            raise self._refused(f"a step of {width} x {height} px fails: {reason_of(error)}") from error
        expected = [(1, 1, height + rows, width + cols), *(state.shape for state in states)]
        shapes = [getattr(array, "shape", None) for array in outputs]
        if shapes != expected:
            raise self._refused(f"its outputs have the shapes {shapes}, not {expected}")
        image, *following = (np.asarray(array, np.float32) for array in outputs)
        return image[0, 0, :height, :width], tuple(following)

    def _padded(self, size_px: int) -> int:
        return -(-size_px // self.size_multiple) * self.size_multiple

    def _check_voxels(self, item: Any) -> int:
        shape = tuple(item.shape or ())
        is_fixed = len(shape) == 4 and any(isinstance(size, int) for size in shape[2:])
        if len(shape) != 4 or not isinstance(shape[1], int) or shape[1] < 2 or is_fixed:
            raise self._refused(f"its first input {item.name} has the shape {shape}")
        return int(shape[1])

    def _read_state(self, item: Any) -> StateSpec:
        shape = tuple(item.shape or ())
        if len(shape) != 4 or not isinstance(shape[1], int) or shape[1] < 1:
            raise self._refused(f"its input {item.name} has the shape {shape}")
        divisors = [re.fullmatch(r"(?:height|width)(?:_(\d{1,4}))?", str(size)) for size in shape[2:]]
        values = [int(match.group(1) or 1) if match else 0 for match in divisors]
        if values[0] == 0 or values[0] != values[1]:
            raise self._refused(f"its input {item.name} has the shape {shape}")
        return StateSpec(item.name, shape[1], values[0])

    def _refused(self, what: str, hint: str = "") -> ProfileError:
        return ProfileError(f"reconstruction model {self.name}: {what}", hint or _EXPECTED)


def model_bytes(path: Path | None) -> bytes:
    """Read a network's file; None takes the one shipped with the package.

    Raises:
        ProfileError: there is no such file, or it cannot be read.
    """
    if path is None:
        return (resources.files("lce_rig") / "models" / "reconstruction.onnx").read_bytes()
    try:
        return path.read_bytes()
    except (OSError, MemoryError) as error:
        hint = "Omit the key to use the shipped one."
        raise ProfileError(f"reconstruction model {path}: {reason_of(error)}", hint) from error
