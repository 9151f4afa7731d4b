"""Two ways from a window of events to a picture: the recurrent network and the event map."""

from pathlib import Path
from typing import Protocol

from lce_rig.core.data import Events
from lce_rig.detect.reconstruct.intensity import GreyScale, IntensityScale, SignedScale
from lce_rig.detect.reconstruct.model import ReconstructionModel, States
from lce_rig.detect.reconstruct.voxels import FloatArray, event_map, normalise_voxels, voxel_grid


class EventImager(Protocol):
    """What turns windows of events into pictures, one step a window."""

    @property
    def n_warm_up(self) -> int:
        """Steps before pictures can be trusted."""
        ...

    def initial_states(self, height_px: int, width_px: int) -> States:
        """Make the states before the first window."""
        ...

    def grey_scale(self) -> GreyScale:
        """Make what maps the pictures of one stream to 8 bits."""
        ...

    def picture(
        self, events: Events, start_ns: int, end_ns: int, states: States
    ) -> tuple[FloatArray, States]:
        """Make the picture (H, W) at end_ns from the window [start_ns, end_ns) and the states before it."""
        ...


class NetworkImager:
    """The recurrent network.

    Args:
        model: ONNX file; None takes the shipped one.
        n_warm_up: steps until the states have settled; 12 on a real DAVIS346 recording.
        n_threads: threads of onnxruntime.
    """

    def __init__(self, model: Path | None, n_warm_up: int, n_threads: int) -> None:
        self.model = ReconstructionModel(model, n_threads)
        self.n_warm_up = n_warm_up

    def initial_states(self, height_px: int, width_px: int) -> States:
        """Make zero states."""
        return self.model.initial_states(height_px, width_px)

    def grey_scale(self) -> GreyScale:
        """Follow the intensities' bounds."""
        return IntensityScale()

    def picture(
        self, events: Events, start_ns: int, end_ns: int, states: States
    ) -> tuple[FloatArray, States]:
        """Take one step of the network."""
        voxels = normalise_voxels(voxel_grid(events, self.model.n_bins, start_ns, end_ns))
        return self.model.step(voxels, states)


class MapImager:
    """The event map: polarity sums of the window alone, nothing carried over."""

    n_warm_up = 0

    def initial_states(self, height_px: int, width_px: int) -> States:
        """Nothing is carried over."""
        return ()

    def grey_scale(self) -> GreyScale:
        """Draw no events as grey."""
        return SignedScale()

    def picture(
        self, events: Events, start_ns: int, end_ns: int, states: States
    ) -> tuple[FloatArray, States]:
        """Sum the polarities."""
        return event_map(events), ()
