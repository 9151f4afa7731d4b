"""Whether extrinsics still hold, axis by axis, from the scene's edges alone."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.core.calibration import MOTIONS, AxisDrift, State
from lce_rig.core.camera import Intrinsics
from lce_rig.core.findings import KINDS, Finding
from lce_rig.core.geometry import Array, perturb
from lce_rig.scene.alignment import IS_ROTATION, Alignment, Curve, SceneView
from lce_rig.scene.findings import (
    AXIS_CHANGED,
    AXIS_UNCHANGED,
    CHANGED,
    FEW_EDGES,
    FLAT,
    LARGE_SCATTER,
    NO_PEAK,
    UNCHANGED,
    UNKNOWN,
)

# Tuned on rlfs01 (docs/drift.md); the other recordings were only measured.
THRESHOLD_SIGMAS = 3.0
POWER_SIGMAS = 1.645
"""At the smallest change, 95 % of the trials exceed the threshold."""
LARGEST = np.where(IS_ROTATION, np.radians(1.5), 0.10)
"""A witness that sees only larger changes cannot tell, rad and m, order of MOTIONS."""
_BIAS = np.array([0.005, 0.005, 0.010, *np.radians([0.10, 0.05, 0.15])])
"""What one scene's maximum is off by beyond the scatter of its parts: sigmas in the order of MOTIONS."""
NEARLY = 0.1
"""What scores so much less alone, as a share, may be what changed."""
_MIN_EDGES = 60
_MIN_PARTS = 6  # of the image, that carry edges
_MIN_SCORE = 0.10  # mean log-likelihood ratio of a depth edge; 0 where edges do not belong together
# Upright outlines hardly show pitch: without a slanted one the curve is nearly flat, its peak meaningless.
_MIN_CONTRAST = 0.3  # of a peak above its curve's median, as a share of the peak
_MIN_GAIN = 2.0  # significance of the score at a change above that of the deployed extrinsics
_GAIN_MARGIN = 0.2  # At the smallest change, the parts agree by so much more.
_MIN_SIGNIFICANCE = 1.5  # of a peak above the rest of its curve


def overall(states: Iterable[State]) -> State:
    """Judge all axes: changed if any is; unchanged only if none is unknown."""
    found = set(states)
    return "changed" if "changed" in found else "unknown" if "unknown" in found else "unchanged"


@dataclass(frozen=True, eq=False)
class Drift:
    """Deployed extrinsics compared with the edges of a scene.

    Attributes:
        axes: one verdict each, order of MOTIONS; all "unknown" where nothing could be compared.
        findings: the summary first, then one of each axis.
        T_cam_lidar: (4, 4) deployed.
        n_captures, n_edges: compared.
        is_compared: whether there were edges enough.
    """

    axes: tuple[AxisDrift, ...]
    findings: tuple[Finding, ...]
    T_cam_lidar: Array
    n_captures: int
    n_edges: int
    is_compared: bool = True

    @property
    def state(self) -> State:
        """The verdict on all axes."""
        return overall(axis.state for axis in self.axes)

    @property
    def T_changed(self) -> Array:
        """(4, 4) the deployed extrinsics, moved along the axes that changed and no other."""
        moved = [axis.change if axis.state == "changed" else 0.0 for axis in self.axes]
        return perturb(self.T_cam_lidar, np.where(IS_ROTATION, np.radians(moved), moved))


def watch(views: Sequence[SceneView], intrinsics: Intrinsics, T_cam_lidar: Array, cov: Array) -> Drift:
    """Compare deployed extrinsics with the scene of some captures.

    Each axis is searched alone within 3 deg or 30 cm. The change with the highest score is applied and the
    other axes are searched again, until none is significant: one changed axis is not reported as several.

    Args:
        views: the captures.
        intrinsics: of the camera.
        T_cam_lidar: (4, 4) deployed.
        cov: (6, 6) of the deployed extrinsics' tangent.
    """
    n_edges = 0
    if views and any(len(view.edges) for view in views):
        alignment = Alignment(views, intrinsics, T_cam_lidar)
        n_edges = len(alignment)
    # The parts of the image that carry edges.
    n_parts = int(np.count_nonzero(alignment.weight_of_parts)) if n_edges else 0
    if n_edges < _MIN_EDGES * max(len(views), 1) ** 0.5 or n_parts < _MIN_PARTS:
        few = FEW_EDGES(n_edges=n_edges, n_captures=len(views))
        axes = tuple(AxisDrift(axis, "unknown", 0.0, np.inf, np.inf, few.code) for axis in MOTIONS)
        return Drift(axes, (few,), T_cam_lidar, len(views), n_edges, is_compared=False)

    sigma_deployed = np.sqrt(np.diag(cov))
    curves = [alignment.curve(axis, np.zeros(6)) for axis in range(6)]
    axes = _decide(alignment, curves, sigma_deployed)
    changed, unknown = (
        tuple(axis.axis for axis in axes if axis.state == state) for state in ("changed", "unknown")
    )
    kind = CHANGED if changed else UNKNOWN if unknown else UNCHANGED
    findings = [kind(n_captures=len(views), changed=changed, unknown=unknown)]
    for axis in axes:
        if axis.state == "changed":
            findings.append(AXIS_CHANGED(axis.axis, instead=axis.instead, **axis.figures))
        else:
            findings.append(KINDS[axis.reason or AXIS_UNCHANGED.code](axis.axis, **axis.figures))
    return Drift(axes, tuple(findings), T_cam_lidar, len(views), n_edges)


def _decide(alignment: Alignment, curves: list[Curve], sigma_deployed: Array) -> tuple[AxisDrift, ...]:
    """Judge each axis: changes are taken one by one, the most rewarding first."""
    tangent, changed = np.zeros(6), {}
    while True:
        verdicts = {
            axis: _judge(axis, curves[axis], sigma_deployed[axis], alignment)
            for axis in range(6)
            if axis not in changed
        }
        moved = [axis for axis, verdict in verdicts.items() if verdict.state == "changed"]
        if not moved:
            break
        axis = max(moved, key=lambda each: curves[each].total.max())
        least = (1 - NEARLY) * curves[axis].total.max()
        instead = tuple(MOTIONS[each] for each in moved if each != axis and curves[each].total.max() > least)
        tangent[axis] += curves[axis].peak
        changed[axis] = replace(verdicts[axis], instead=instead)
        curves = [alignment.curve(each, tangent) for each in range(6)]
    return tuple((verdicts | changed)[axis] for axis in range(6))


def _judge(axis: int, curve: Curve, sigma_deployed: float, alignment: Alignment) -> AxisDrift:
    """Decide one axis from the score along it."""
    unit = float(np.degrees(1.0)) if IS_ROTATION[axis] else 1.0
    peak, scatter = curve.peak, curve.sigma()
    sigma = float(np.sqrt(scatter**2 + sigma_deployed**2 + _BIAS[axis] ** 2))
    smallest = max(
        (THRESHOLD_SIGMAS + POWER_SIGMAS) * sigma, curve.smallest_significant(_MIN_GAIN + _GAIN_MARGIN)
    )
    mean_score = float(curve.total.max() / alignment.weight_of_parts.sum() * alignment.n_captures)
    reason = ""
    if abs(peak) > 0.95 * curve.offsets[-1]:
        reason = NO_PEAK.code
    elif (
        mean_score < _MIN_SCORE
        or curve.significance(peak) < _MIN_SIGNIFICANCE
        or np.median(curve.total) > (1 - _MIN_CONTRAST) * curve.total.max()
    ):
        reason = FLAT.code
    is_beyond = abs(peak) > THRESHOLD_SIGMAS * sigma
    is_changed = is_beyond and not reason and curve.significance(peak, 0.0) > _MIN_GAIN
    if not reason and (smallest > LARGEST[axis] or is_beyond):
        reason = LARGE_SCATTER.code
    state: State = "changed" if is_changed else "unknown" if reason else "unchanged"
    figures = (unit * peak, unit * sigma, unit * smallest)
    return AxisDrift(MOTIONS[axis], state, *figures, "" if is_changed else reason)
