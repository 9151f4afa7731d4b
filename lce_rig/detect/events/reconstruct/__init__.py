"""Images from events: voxel grids, the recurrent network, the event map, and images at any timestamp."""

from lce_rig.detect.events.reconstruct.model import ReconstructionModel, model_bytes
from lce_rig.detect.events.reconstruct.reconstructor import ReconstructionOptions, Reconstructor
from lce_rig.detect.events.reconstruct.windows import WindowOptions, event_map, normalise_voxels, voxel_grid

__all__ = [
    "ReconstructionModel",
    "ReconstructionOptions",
    "Reconstructor",
    "WindowOptions",
    "event_map",
    "model_bytes",
    "normalise_voxels",
    "voxel_grid",
]
