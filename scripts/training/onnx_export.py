"""Export of the network with its recurrent state as explicit inputs and outputs."""

import warnings
from pathlib import Path

import torch

from .network import N_BINS, ReconstructionNetwork

OPSET = 17


def export_onnx(network: ReconstructionNetwork, path: Path) -> None:
    """Write `network`: inputs voxels, state_0, state_1; outputs picture, next_state_0, next_state_1."""
    twin = ReconstructionNetwork(network.n_half, network.n_quarter)
    twin.load_state_dict({key: value.cpu() for key, value in network.state_dict().items()})
    height, width = 64, 96
    half, quarter = twin.initial_states(1, height, width)
    with warnings.catch_warnings():
        # The exporter by tracing is deprecated, yet it alone needs no further package.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            twin.eval(),
            (torch.zeros(1, N_BINS, height, width), half, quarter),
            str(path),
            input_names=["voxels", "state_0", "state_1"],
            output_names=["picture", "next_state_0", "next_state_1"],
            dynamic_axes={
                "voxels": {2: "height", 3: "width"},
                "picture": {2: "height", 3: "width"},
                "state_0": {2: "height_2", 3: "width_2"},
                "next_state_0": {2: "height_2", 3: "width_2"},
                "state_1": {2: "height_4", 3: "width_4"},
                "next_state_1": {2: "height_4", 3: "width_4"},
            },
            opset_version=OPSET,
            dynamo=False,
        )
