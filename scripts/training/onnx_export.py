"""Export of recurrent networks with their states as explicit inputs and outputs."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import nn

from .network import N_BINS, ReconstructionNetwork

OPSET = 17
_EXAMPLE_HEIGHT_PX, _EXAMPLE_WIDTH_PX = 64, 96


def export_onnx(network: ReconstructionNetwork, path: Path) -> None:
    """Write our network."""
    twin = ReconstructionNetwork(network.n_half, network.n_quarter)
    twin.load_state_dict({key: value.cpu() for key, value in network.state_dict().items()})
    export_recurrent(twin, [(network.n_half, 2), (network.n_quarter, 4)], path)


def export_recurrent(
    network: nn.Module, states: Sequence[tuple[int, int]], path: Path, n_bins: int = N_BINS
) -> None:
    """Write any network as lce-rig expects it: voxels, state_0, ... to picture, next_state_0, ...

    Args:
        network: called as network(voxels, *states), gives (picture, *next states).
        states: channels and divisor of each: (48, 4) is 48 channels at a quarter of the height and width.
        path: ONNX file.
        n_bins: temporal bins of the voxel grid.
    """
    height, width = _EXAMPLE_HEIGHT_PX, _EXAMPLE_WIDTH_PX
    zeros = [torch.zeros(1, channels, height // divisor, width // divisor) for channels, divisor in states]
    axes = {"voxels": {2: "height", 3: "width"}, "picture": {2: "height", 3: "width"}}
    for index, (_, divisor) in enumerate(states):
        suffix = f"_{divisor}" if divisor > 1 else ""
        axes[f"state_{index}"] = {2: f"height{suffix}", 3: f"width{suffix}"}
        axes[f"next_state_{index}"] = axes[f"state_{index}"]
    names = [f"state_{index}" for index in range(len(states))]
    with warnings.catch_warnings():
        # The exporter by tracing is deprecated, yet the only one that needs no further package.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network.eval(),
            (torch.zeros(1, n_bins, height, width), *zeros),
            str(path),
            input_names=["voxels", *names],
            output_names=["picture", *(f"next_{name}" for name in names)],
            dynamic_axes=axes,
            opset_version=OPSET,
            dynamo=False,
        )
