"""Likelihood of a rig: LiDARs and cameras with one pose each, and the boards that any of them saw.

The base is the first LiDAR; boards have their poses in its frame. The terms of each LiDAR (`model`) are those
of its own frame, in which the base has the pose T_m. With x the tangent of T_m and y that of a board's pose
T, the board's pose T_m T in the LiDAR's frame has the tangent

    B x + R y,    R the rotation of T_m, B = [I, -(R t)^; 0, I]                                          (1)

The LiDARs share the shape of the plate; each has its own constant errors of lasers, lens and ring ends.
Loops of poses close, as each sensor has one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.likelihood.fit import (
    BLURS_RAD,
    NEAR,
    SETTLED,
    STEPS,
    Optimum,
    by_influence,
    descend,
    extrinsics_by_unknowns,
    profiled,
    weigh_placements,
)
from lce_rig.calibrate.likelihood.images import StackedImages
from lce_rig.calibrate.likelihood.layout import OWN, Indices, State
from lce_rig.calibrate.likelihood.levels import Levels, Priors
from lce_rig.calibrate.likelihood.model import (
    Known,
    Reduced,
    Summed,
    Terms,
    eliminate,
    linearise,
    prior_of,
    sum_products,
)
from lce_rig.calibrate.likelihood.rays import StackedScans, lens_fields
from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, perturb, relative_pose, skew

# Maximum number of steps.
_STEPS = 20
_POSE = OWN["pose"].stop
# Standard deviation of a LiDAR's lens, lateral and vertical, m, from errors of the ring ends' model that all
# boards share: measured in simulated sessions of an OS1-64. The scatter does not contain them.
_LENS_ERROR_M = np.array([0.0025, 0.0015])


@dataclass(frozen=True, eq=False)
class RigTerms:
    """All residuals at one state.

    Attributes:
        parts: terms of each of the M LiDARs, over the same F captures. The first is the base; its terms
            include the images.
        T_lidar_base: (M, 4, 4) pose of the base in each LiDAR's frame.
    """

    parts: tuple[Terms, ...]
    T_lidar_base: Array

    @property
    def base(self) -> Terms:
        """The first LiDAR's."""
        return self.parts[0]

    @property
    def n_own(self) -> int:
        """Number of a capture's own unknowns: the board's pose, and a shift of ring ends for each LiDAR."""
        return int(_POSE + len(self.parts))

    @cached_property
    def places(self) -> list[Indices]:
        """Indices of each LiDAR's unknowns z (G_m,) among those of the rig.

        The base's come first, those of bow and plate are shared. Tangents of poses follow, see `pose`.
        """
        first, found = self.base.state.layout, []
        for part, start in zip(self.parts, self.starts, strict=True):
            layout = part.state.layout
            at = start + np.arange(layout.z.size)
            at[layout.shape] = first.shape
            found.append(at)
        return found

    @property
    def starts(self) -> list[int]:
        """First of each LiDAR's places, among them void ones of the shape."""
        sizes = [part.state.layout.z.size for part in self.parts]
        return [sum(sizes[:m]) for m in range(len(sizes))]

    @property
    def size(self) -> int:
        """Number G of the unknowns shared by all captures, with void ones for a shape that is the base's."""
        return sum(part.state.layout.z.size for part in self.parts) + 6 * (len(self.parts) - 1)

    def pose(self, m: int) -> Indices:
        """Indices of the tangent (6,) of the pose of a LiDAR other than the base."""
        return self.size - 6 * (len(self.parts) - m) + np.arange(6)

    def moved(self, z: Array, y: Array) -> "RigTerms":
        """Linearise after a step z (G,) and y (F, 6 + M)."""
        T = self.T_lidar_base.copy()
        parts: list[Terms] = []
        for m, part in enumerate(self.parts):
            own = np.column_stack([y[:, :_POSE], y[:, _POSE + m]])
            state = part.state.moved(z[self.places[m]], own)
            if m:
                T[m] = perturb(T[m], z[self.pose(m)])
                state = replace(state, T_lidar_board=T[m] @ parts[0].state.T_lidar_board)
            parts.append(linearise(part.scans, part.images, part.board, state, part.trust))
        return RigTerms(tuple(parts), T)

    def weighted(self, trust: Array) -> "RigTerms":
        """Return a copy with other weights (F,) of the captures."""
        return replace(self, parts=tuple(replace(part, trust=trust) for part in self.parts))


def assemble_rig(terms: RigTerms, levels: Sequence[Levels], priors: Sequence[Priors]) -> Reduced:
    """Weight all terms, eliminate the captures' own unknowns and add the priors; one of each for a LiDAR."""
    F, G, n = len(terms.base.trust), terms.size, terms.n_own
    products, log_volume = np.zeros((F, n + G + 1, n + G + 1)), 0.0
    information, off = np.zeros((G, G)), np.zeros(G)
    for m, (part, level, prior) in enumerate(zip(terms.parts, levels, priors, strict=True)):
        summed, known, at = sum_products(part, level), prior_of(part, level, prior), terms.places[m]
        _add(products, summed.products, terms, m)
        log_volume += summed.log_volume
        of_own = known.information.copy()
        if m:
            shape = part.state.layout.shape
            of_own[shape], of_own[:, shape] = 0.0, 0.0
            # Places that the base's shape fills.
            void = terms.starts[m] + shape
            information[void, void] = 1.0
        information[np.ix_(at, at)] += of_own
        off[at] = known.off
    return eliminate(Summed(products, log_volume), terms.base.trust, n, Known(information, off, 0.0))


def _add(total: Array, products: Array, terms: RigTerms, m: int) -> None:
    """Add a LiDAR's products (F, n, n) to those of the rig, with the derivatives (1) of its boards' poses."""
    n = terms.n_own
    rest = np.r_[_POSE + m, n + terms.places[m], total.shape[1] - 1]
    at, slopes = np.arange(_POSE), np.eye(_POSE)[None]
    if m:
        R = terms.T_lidar_base[m, :3, :3]
        slopes = np.zeros((len(products), _POSE, 2 * _POSE))
        slopes[:, :, :_POSE] = np.kron(np.eye(2), R)
        slopes[:, :, _POSE:] = np.eye(_POSE)
        slopes[:, :3, _POSE + 3 :] = -skew(terms.base.state.T_lidar_board[:, :3, 3] @ R.T)
        at = np.r_[at, n + terms.pose(m)]
    back = np.swapaxes(slopes, 1, 2)
    cross = back @ products[:, :_POSE, _POSE:]
    total[:, at[:, None], at] += back @ products[:, :_POSE, :_POSE] @ slopes
    total[:, at[:, None], rest] += cross
    total[:, rest[:, None], at] += np.swapaxes(cross, 1, 2)
    total[:, rest[:, None], rest] += products[:, _POSE:, _POSE:]


@dataclass(frozen=True, eq=False)
class RigEstimate(Optimum):
    """The optimum of a rig of M LiDARs and C cameras.

    Attributes:
        terms: linearised there.
        levels, priors: noise levels and priors of each LiDAR; those of the images are the first one's.
        placement: (F,) number of the placement that each capture shows.
    """

    terms: RigTerms
    levels: tuple[Levels, ...]
    priors: tuple[Priors, ...]
    placement: NDArray[np.intp]

    @cached_property
    def cost(self) -> Quadratics:
        """Quadratic cost of the F captures in z."""
        held = [each.held for each in self.priors]
        return replace(assemble_rig(self.terms, self.levels, held).cost, placement=self.placement)

    @cached_property
    def left_out(self) -> Array:
        """Shifts (P, G) of z when a placement is left out."""
        return self.cost.moves()

    @property
    def profiled(self) -> dict[str, tuple[Indices, float]]:
        """Index in z and standard deviation of each error of lens and board, by name."""
        return profiled(self.terms.base.state.layout, self.priors[0])

    @cached_property
    def z(self) -> Array:
        """(G,) values of the constants."""
        z = np.zeros(self.terms.size)
        for part, at in zip(self.terms.parts, self.terms.places, strict=True):
            z[at] = part.state.z
        return z

    def camera(self, c: int) -> tuple[Array, Array]:
        """Pose of the base in a camera's frame: T_cam_base (4, 4) as reported, and its derivative by z."""
        base = self.terms.base
        J = np.zeros((6, self.terms.size))
        J[:, : base.state.layout.z.size] = extrinsics_by_unknowns(base)[c]
        T = base.state.T_cam_lidar[c]
        if len(self.terms.parts) > 1:
            J[:3, self.terms.places[0][base.state.layout.z["lens"]]] = T[:3, :3] @ self._beside(0)
        return perturb(T, J @ self.z), J

    def lidar(self, m: int) -> tuple[Array, Array]:
        """Pose of the base in a LiDAR's frame: T_lidar_base (4, 4) as reported, and its derivative by z.

        Both apply to points from the drivers, which the lens displaces from the true ones.
        """
        J = np.zeros((6, self.terms.size))
        T = self.terms.T_lidar_base[m]
        if m:
            J[:, self.terms.pose(m)] = np.eye(6)
            J[:3, self._lens(0)] = T[:3, :3] @ self._beside(0)
            J[:3, self._lens(m)] = -self._beside(m)
        return perturb(T, J @ self.z), J

    def of_model(self, J: Array) -> Array:
        """Compute the covariance (6, 6) due to errors of the ring end model, for poses with derivative J."""
        moves = [J[:, self._lens(m)] * _LENS_ERROR_M for m in range(len(self.terms.parts))]
        return np.asarray(np.sum([each @ each.T for each in moves], axis=0))

    def _lens(self, m: int) -> Indices:
        return self.terms.places[m][self.terms.parts[m].state.layout.z["lens"]]

    def _beside(self, m: int) -> Array:
        """Displacement (3, 2) of points in the mean direction of a LiDAR's boards, per unit of its lens."""
        part = self.terms.parts[m]
        middles = part.state.T_lidar_board[np.unique(part.scans.capture), :3, 3]
        return np.asarray(lens_fields(middles.mean(axis=0, keepdims=True))[0])


def relate(second: tuple[Array, Array], first: tuple[Array, Array]) -> tuple[Array, Array]:
    """Compose the pose of the first sensor in the frame of the second, and its derivative by z.

    Args:
        second, first: pose (4, 4) of the base in each one's frame, and its derivative (6, G).
    """
    T, J = relative_pose(second[0], first[0])
    return T, np.asarray(J[:, :6] @ second[1] + J[:, 6:] @ first[1])


def maximise_rig(
    scans: Sequence[StackedScans],
    images: Sequence[StackedImages],
    board: Board,
    states: Sequence[State],
    T_lidar_base: Array,
    levels: Sequence[Levels],
    priors: Sequence[Priors],
    placement: NDArray[np.intp],
) -> RigEstimate:
    """Estimate the poses of M LiDARs and of cameras, from estimates of pairs of them.

    Args:
        scans: scans of each LiDAR, of F captures; the first is the base.
        images: images of each camera, of the same captures.
        board: the board.
        states: initial state of each LiDAR; the first includes the cameras' extrinsics.
        T_lidar_base: (M, 4, 4) initial poses.
        levels, priors: noise levels and priors of each LiDAR; the noise is not estimated again.
        placement: (F,) number of the placement that each capture shows.
    """
    once = weigh_placements(placement, images)
    held = [each.held for each in priors]
    parts = [
        linearise(of_lidar, () if m else images, board, state, once)
        for m, (of_lidar, state) in enumerate(zip(scans, states, strict=True))
    ]
    terms = RigTerms(tuple(parts), T_lidar_base)

    def settle(here: RigTerms, blur_rad: float, n_steps: int, short: float) -> RigTerms:
        blurred = [each.blurred(blur_rad) for each in levels]
        return descend(here, lambda each: assemble_rig(each, blurred, held), RigTerms.moved, n_steps, short)

    for blur_rad in BLURS_RAD:
        terms = settle(terms, blur_rad, STEPS, NEAR)
    terms = settle(terms, 0.0, _STEPS, NEAR)
    estimate = RigEstimate(terms, tuple(levels), tuple(priors), placement)
    J = np.concatenate(
        [estimate.camera(c)[1] for c in range(len(images)) if c != states[0].layout.base]
        + [estimate.lidar(m)[1] for m in range(1, len(scans))]
    )
    trust = once * by_influence(estimate.cost, J)
    return replace(estimate, terms=settle(terms.weighted(trust), 0.0, _STEPS, SETTLED))
