"""Cameras that share a LiDAR and captures: held against each other, and by method "ml" estimated together."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from lce_rig.calibrate.camera_pairs import CameraPair, doubt_cameras, relate
from lce_rig.calibrate.doubt import Doubt
from lce_rig.calibrate.likelihood.calibrate_together import TogetherEstimate, calibrate_together
from lce_rig.calibrate.relative_pose import relative_pose
from lce_rig.core.geometry import Array, invert, sigma_sizes, tangent_sizes
from lce_rig.core.results import OtherCamera
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.solving import Solved, examine_pairs
from lce_rig.rig import Rig


@dataclass(frozen=True, eq=False)
class InCompany:
    """A camera with a LiDAR, and what other cameras of the session say of it.

    Attributes:
        solved: the camera's extrinsic, from all cameras that it was estimated together with.
        doubts: where its pictures and another camera's contradict their extrinsics.
        others: where other cameras that saw the same boards sit to it.
    """

    solved: Solved
    doubts: tuple[Doubt, ...]
    others: tuple[OtherCamera, ...]


@dataclass(frozen=True, eq=False)
class _Link:
    """Two cameras that saw the same boards, by their place among all that were solved."""

    first: int
    second: int
    pair: CameraPair
    doubts: tuple[Doubt, ...]


def bring_cameras_together(
    rig: Rig, detections: Detections, solved: Sequence[Solved]
) -> tuple[InCompany, ...]:
    """Hold cameras of one LiDAR that saw the same boards held still against each other.

    With method "ml" those that agree are estimated together; one that contradicts another is not, or it would
    spoil the other's extrinsic.

    Args:
        rig: thresholds, targets and the board.
        detections: of the session.
        solved: the cameras, each by itself.

    Returns:
        All of them in the same order.
    """
    links = list(_links(rig, solved))
    members = list(solved)
    covs: dict[tuple[int, int], Array] = {}
    for group in _groups(len(solved), links):
        if solved[group[0]].options.method == "ml":
            own = {solved[k].camera: solved[k].result.estimate for k in group}
            together = calibrate_together(own, rig.board.to_board(), solved[group[0]].options)
            for k in group:
                members[k] = _examined(rig, detections, solved[k], together)
            covs |= {
                (i, j): _covariance(together, members[i], members[j]) for i in group for j in group if i != j
            }
    return tuple(
        InCompany(
            member,
            tuple(doubt for link in links if k in (link.first, link.second) for doubt in link.doubts),
            tuple(_other(members, k, link, covs) for link in links if k in (link.first, link.second)),
        )
        for k, member in enumerate(members)
    )


def _links(rig: Rig, solved: Sequence[Solved]) -> Iterator[_Link]:
    for i, j in combinations(range(len(solved)), 2):
        first, second = solved[i], solved[j]
        if first.lidar == second.lidar and first.is_still and second.is_still:
            # Captures that contradict each other widen what a method claims: that must not excuse them.
            pair = relate(first.result.estimate, second.result.estimate)
            if pair is not None:
                names = first.camera, second.camera
                yield _Link(i, j, pair, tuple(doubt_cameras(pair, names, rig.calibration, rig.verdict)))


def _groups(n: int, links: Sequence[_Link]) -> list[list[int]]:
    """List groups of two or more that sound links connect, without those in which a link is doubted."""
    group = list(range(n))
    for link in links:
        if not link.doubts:
            mine, other = group[link.first], group[link.second]
            group = [mine if number == other else number for number in group]
    doubted = {group[link.first] for link in links if link.doubts and group[link.first] == group[link.second]}
    found = [[k for k in range(n) if group[k] == number] for number in sorted(set(group) - doubted)]
    return [members for members in found if len(members) > 1]


def _examined(rig: Rig, detections: Detections, alone: Solved, together: TogetherEstimate) -> Solved:
    """Put the joint estimate in the place of a camera's own, and check it anew."""
    estimate = together.estimates[alone.camera]
    sigma_deg, sigma_m = sigma_sizes(alone.estimate.cov)
    figures = {"alone_sigma_rotation_deg": sigma_deg, "alone_sigma_translation_m": sigma_m}
    estimate = replace(estimate, diagnostics={**estimate.diagnostics, **figures})
    result = replace(alone.result, estimate=estimate)
    return replace(alone, result=result, examination=examine_pairs(rig, detections, alone.pairs, result))


def _covariance(together: TogetherEstimate, camera: Solved, other: Solved) -> Array:
    """Compute the covariance (6, 6) of where a camera sits to another, widened as both extrinsics were."""
    _, J = relative_pose(camera.estimate.T_cam_lidar, other.estimate.T_cam_lidar)
    J = J * np.repeat([camera.widened_by, other.widened_by], 6)
    return np.asarray(J @ together.covariance_of(camera.camera, other.camera) @ J.T)


def _other(members: Sequence[Solved], k: int, link: _Link, covs: dict[tuple[int, int], Array]) -> OtherCamera:
    """Say where the other camera of a link sits to member k."""
    pair, is_second = link.pair, k == link.second
    other = link.first if is_second else link.second
    T, _ = relative_pose(members[k].estimate.T_cam_lidar, members[other].estimate.T_cam_lidar)
    seen = None if pair.pictures is None else pair.pictures.T_second_first
    apart_deg, apart_m = (None, None) if pair.apart is None else tangent_sizes(pair.apart)
    return OtherCamera(
        camera=members[other].camera,
        n_captures=len(pair.captures),
        T_cam_other=T,
        cov=covs.get((k, other)),
        T_cam_other_pictures=seen if seen is None or is_second else invert(seen),
        apart_rotation_deg=apart_deg,
        apart_translation_m=apart_m,
        board_rms_m=pair.board_rms_m,
    )
