"""Several cameras that share scans of one LiDAR, estimated as one: they share board poses and its errors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.calibrate.estimate import CalibrationEstimate
from lce_rig.calibrate.likelihood.calibrate_jointly import add_figures, describe, expand_joint
from lce_rig.calibrate.likelihood.levels import PoseLevels, what_is_known
from lce_rig.calibrate.likelihood.refine import inflate, refine
from lce_rig.calibrate.options import EstimateSettings
from lce_rig.calibrate.placements import group_shared_placements
from lce_rig.calibrate.shared_scans import scan_key
from lce_rig.core.board import Board
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.core.results import Observation


@dataclass(frozen=True, eq=False)
class TogetherEstimate:
    """Extrinsics of C cameras with one LiDAR.

    Attributes:
        cameras: their names, sorted.
        estimates: of each.
        cov: (6 C, 6 C) of all extrinsics, in the order of `cameras`; its diagonal blocks are those of the
            estimates.
    """

    cameras: tuple[str, ...]
    estimates: Mapping[str, CalibrationEstimate]
    cov: Array

    def covariance_of(self, first: str, second: str) -> Array:
        """Return the covariance (12, 12) of two cameras' extrinsics."""
        places = [np.arange(6) + 6 * self.cameras.index(name) for name in (first, second)]
        mine = np.concatenate(places)
        return self.cov[mine[:, None], mine]


def calibrate_together(
    alone: Mapping[str, CalibrationEstimate], board: Board, options: Mapping[str, EstimateSettings]
) -> TogetherEstimate:
    """Estimate the extrinsics of cameras that share scans of one LiDAR in one likelihood.

    Each camera's own estimate gives the start, and the size of its images' errors relative to the others'.
    Scans in which the cameras use different surfaces are rejected.

    Args:
        alone: by camera, its estimate by the joint likelihood without the others; boards stood still.
        board: its specification.
        options: by camera, with the tolerances of its lens; priors of the LiDAR are the same for all.
    """
    # The order of cameras must not change the last digit.
    names = tuple(sorted(alone))
    conflicts = _conflicts(alone)
    starts = [_without(alone[name], conflicts) for name in names]
    used = [[start.observations[capture] for capture in start.used] for start in starts]
    labelled = _label_scans(used)
    priors, usual = what_is_known(options[names[0]])
    priors = replace(priors, scale=tuple(_scale_of(options[name]) for name in names))
    T_start = [start.T_cam_lidar for start in starts]
    joint = refine(labelled, board, T_start, priors, usual, pose_ratios=_pose_ratios(starts))
    order = {name: k for k, name in enumerate(sorted({o.capture for own in labelled for o in own}))}
    placement = group_shared_placements(labelled, order)
    J = joint.to_extrinsics.reshape(-1, joint.to_extrinsics.shape[2])
    scales, estimates = [], {}
    for k, (name, start) in enumerate(zip(names, starts, strict=True)):
        n_seen = len(np.unique(placement[[order[o.capture] for o in labelled[k]]]))
        cov, inflation = inflate(joint, placement, k, n_seen)
        scales.append(np.full(6, np.sqrt(inflation)))
        figures = add_figures(start.diagnostics, joint, k, inflation)
        estimate = describe(joint, k, cov, start, used[k], board, options[name], figures)
        estimates[name] = replace(
            estimate,
            method=start.method,
            sensitivities=start.sensitivities,
            cost=expand_joint(joint, k, placement),
            estimated_with=tuple(other for other in names if other != name),
            same_scan=start.same_scan,
        )
    scale = np.concatenate(scales)
    cov = scale[:, None] * (J @ (joint.cov_scatter + joint.cov_constants) @ J.T) * scale
    return TogetherEstimate(names, estimates, cov)


def _scale_of(options: EstimateSettings) -> float:
    scale = what_is_known(options)[0].scale
    assert isinstance(scale, float)
    return scale


def _without(start: CalibrationEstimate, conflicts: Mapping[str, Refusal]) -> CalibrationEstimate:
    """Remove captures, and figures that apply to the camera alone."""
    singles = [start.captures_of([name]) for name in start.used]
    kept = [k for k, names in enumerate(singles) if not names & conflicts.keys()]
    mine = {name: why for name, why in conflicts.items() if name in set().union(*singles)}
    return replace(
        start,
        used=tuple(start.used[k] for k in kept),
        residuals=tuple(start.residuals[k] for k in kept),
        refused={**start.refused, **mine},
        diagnostics=replace(start.diagnostics, algorithm_1_offset_deg=np.nan, algorithm_1_offset_m=np.nan),
    )


def _conflicts(alone: Mapping[str, CalibrationEstimate]) -> dict[str, Refusal]:
    """Find captures in which cameras use different surfaces of the scan."""
    seen: dict[str, tuple[str, bytes]] = {}
    found = {}
    for camera, estimate in sorted(alone.items()):
        for observation in estimate.observations.values():
            key = scan_key(observation)
            for capture in sorted(estimate.captures_of([observation.capture])):
                other, held = seen.setdefault(capture, (camera, key))
                if held != key:
                    figures = {"first": other, "second": camera}
                    found[capture] = Refusal("pair.two_places", figures=figures)
    return found


def _label_scans(used: Sequence[Sequence[Observation]]) -> list[list[Observation]]:
    """Rename observations so that those of the same scan share a name, in any capture."""
    names: dict[bytes, str] = {}
    labelled = []
    for own in used:
        for observation in own:
            names.setdefault(scan_key(observation), f"{len(names):06d}")
        labelled.append([replace(o, capture=names[scan_key(o)]) for o in own])
    return labelled


def _pose_ratios(starts: Sequence[CalibrationEstimate]) -> list[PoseLevels]:
    """Compare cameras' pose errors, as each alone estimates them, with their geometric mean."""
    each = [start.diagnostics for start in starts]
    logs = np.log([[d.noise_tilt_deg, d.noise_spin_deg, d.noise_depth_m, d.noise_across_m] for d in each])
    ratios = np.exp(logs - logs.mean(axis=0))
    return [PoseLevels(*own) for own in ratios.tolist()]
