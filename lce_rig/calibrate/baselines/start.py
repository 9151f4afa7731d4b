"""Where the baselines begin: features for the report, and the pose from the boards' planes alone."""

from collections.abc import Sequence

from lce_rig.calibrate.initial import solve_planes
from lce_rig.calibrate.observability import require_observable
from lce_rig.calibrate.options import CalibrateOptions
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.core.results import Observation
from lce_rig.residuals.features import CaptureFeatures, extract_features
from lce_rig.residuals.moments import Problem, Weights


def start_from_planes(
    observations: Sequence[Observation], board: Board, options: CalibrateOptions
) -> tuple[list[CaptureFeatures], Array]:
    """Solve point-to-plane, which needs no lines or corners to be told apart.

    Args:
        observations: one a capture.
        board: its specification.
        options: how features are extracted.

    Returns:
        The captures' features and T_cam_lidar (4, 4).

    Raises:
        NotEnoughDataError: the captures leave a direction undetermined, which is named.
    """
    features = [extract_features(observation, board, options.features) for observation in observations]
    problem = Problem(features, board, Weights(1.0, 0.0, None))
    T_planes = solve_planes(features, problem)
    require_observable(features, problem, T_planes)
    return features, T_planes
