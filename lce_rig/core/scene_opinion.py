"""The scene's opinion on extrinsics: do depth edges of the scans fall on edges of the images."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

OpinionState = Literal["agrees", "contradicts", "unknown"]


@dataclass(frozen=True)
class AxisOpinion:
    """What the scene says about one axis, the others as estimated.

    Attributes:
        axis: "translation_x" to "rotation_z", axes of the camera.
        state: "unknown" where the scene cannot tell.
        unit: of the figures.
        change: from the extrinsics to where the scene's edges fit best.
        sigma: standard deviation of `change`, that of the extrinsics included.
        smallest: the smallest change that would contradict in 95 % of trials; None if none within reach.
    """

    axis: str
    state: OpinionState
    unit: Literal["deg", "m"]
    change: float
    sigma: float
    smallest: float | None


@dataclass(frozen=True)
class SceneOpinion:
    """The scene's opinion on the extrinsics of a camera and a LiDAR, without the edges at the board.

    Attributes:
        n_captures: compared; 0 if none has an image of the camera's frames and a scan.
        n_edges: depth edges in or near their images.
        axes: one opinion each, order of a tangent; empty if there are too few edges to compare.
    """

    n_captures: int
    n_edges: int
    axes: tuple[AxisOpinion, ...] = ()

    @property
    def state(self) -> OpinionState:
        """Contradicts if any axis does; agrees if at least one is known and none contradicts."""
        states = {axis.state for axis in self.axes}
        return "contradicts" if "contradicts" in states else "agrees" if "agrees" in states else "unknown"

    def of(self, state: OpinionState) -> tuple[AxisOpinion, ...]:
        """List the axes of a state."""
        return tuple(axis for axis in self.axes if axis.state == state)

    @property
    def strongest(self) -> AxisOpinion | None:
        """The axis that contradicts by most standard deviations; None if none does."""
        return max(self.of("contradicts"), key=lambda axis: abs(axis.change) / axis.sigma, default=None)

    def document(self) -> dict[str, Any]:
        """List everything as plain types for JSON."""
        return {
            "state": self.state,
            "n_captures": self.n_captures,
            "n_edges": self.n_edges,
            "axes": [asdict(axis) for axis in self.axes],
        }
