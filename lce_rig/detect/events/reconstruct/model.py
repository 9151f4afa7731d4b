"""The network file: its required inputs and outputs, and one step of it."""

import math
import re
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np

from lce_rig.core.errors import ProfileError, SourceError
from lce_rig.core.limits import MAX_NETWORK_BYTES, check_size, read_file
from lce_rig.detect.events.reconstruct.model_process import ProcessSession
from lce_rig.detect.events.reconstruct.onnx_session import LocalSession, NetworkError, NetworkSession, Port
from lce_rig.detect.events.reconstruct.voxels import FloatArray

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
        self._session = _load(path, self.name, n_threads)
        inputs, outputs = self._session.inputs, self._session.outputs
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
            ProfileError: they are larger than any network needs.
        """
        height, width = self._padded(height_px), self._padded(width_px)
        n_state = sum(s.n_channels * (height // s.divisor) * (width // s.divisor) for s in self.states)
        try:
            check_size(4 * (n_state + self.n_bins * height * width), "a step", MAX_NETWORK_BYTES)
        except ValueError as error:
            raise self._refused(f"{error}") from error
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
            image (H, W), arbitrary scale; next states.
        """
        _, height, width = voxels.shape
        rows, cols = self._padded(height) - height, self._padded(width) - width
        grid = np.pad(voxels, ((0, 0), (0, rows), (0, cols)))[None]
        expected = [(1, 1, height + rows, width + cols), *(state.shape for state in states)]
        try:
            picture, *following = self._session.run((grid, *states), expected)
        except NetworkError as error:
            raise self._refused(f"a step of {width} x {height} px fails: {error}", error.hint) from error
        return picture[0, 0, :height, :width], tuple(following)

    def _padded(self, size_px: int) -> int:
        return -(-size_px // self.size_multiple) * self.size_multiple

    def _check_voxels(self, item: Port) -> int:
        shape = item.shape
        is_fixed = len(shape) == 4 and any(isinstance(size, int) for size in shape[2:])
        if len(shape) != 4 or not isinstance(shape[1], int) or shape[1] < 2 or is_fixed:
            raise self._refused(f"its first input {item.name} has the shape {shape}")
        return int(shape[1])

    def _read_state(self, item: Port) -> StateSpec:
        shape = item.shape
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
        ProfileError: there is no such file, or it cannot be one.
    """
    if path is None:
        return (resources.files("lce_rig") / "models" / "reconstruction.onnx").read_bytes()
    hint = "Omit the key to use the shipped one."
    try:
        return read_file(path)
    except FileNotFoundError as error:
        raise ProfileError(f"reconstruction model {path}: no such file", hint) from error
    except OSError as error:
        raise ProfileError(f"reconstruction model {path}: {error.strerror}", hint) from error
    except ValueError as error:
        raise ProfileError(f"reconstruction model {path}: {error}", hint) from error


def _load(path: Path | None, name: str, n_threads: int) -> NetworkSession:
    """Load a network: the shipped one into this process, others into one that can be stopped."""
    content = model_bytes(path)
    try:
        return LocalSession(content, n_threads) if path is None else ProcessSession(content, n_threads)
    except ImportError as error:
        raise SourceError("onnxruntime is not installed", "Run: pip install onnxruntime") from error
    except NetworkError as error:
        hint = error.hint or _EXPECTED
        raise ProfileError(f"reconstruction model {name}: cannot be loaded: {error}", hint) from error
