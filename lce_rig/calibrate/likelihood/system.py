"""All terms at one state, and their normal equations for any noise levels.

Unknowns are y_k (7) of each capture, the tangent of T_lidar_board and its own shift of ring ends, and z,
which all captures share:

    z = [tangent of T_cam_lidar (6) and scale of each camera, errors of each laser's range (L), azimuth (L)
         and elevation (L), fields (4), shifts of ring ends (8)]

They enter only the terms of their own capture: the matrix is an arrow head, and y_k is eliminated
capture by capture (Schur complement).
"""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.likelihood.along_rays import (
    N_BOW,
    N_FIELDS,
    N_LENS,
    N_OF_LASER,
    N_SHIFTS,
    EdgeRows,
    RangeSums,
    StackedScans,
    edge_rows,
    range_system,
    spread_rings,
    sum_ranges,
    weigh_ranges,
)
from lce_rig.calibrate.likelihood.end_density import edge_system, expand_ends
from lce_rig.calibrate.likelihood.image_terms import StackedImages, image_rows
from lce_rig.calibrate.likelihood.levels import Levels, PoseLevels, Priors
from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, perturb

PER_CAMERA = 7
PER_CAPTURE = 7
# Column of a capture's own shift of ring ends among its unknowns.
_OWN_SHIFT = 6
# Of the logarithm of a level, for differences.
_LOG_STEP = 1e-4
# The lasers' own errors have zero mean: that of ranges is the common offset, those of angles are part of the
# extrinsics. This much of it is left.
_MEAN_FLOOR = 1e-6


def scale_places(n_cameras: int) -> NDArray[np.intp]:
    """Return the place (C,) of each camera's scale in z."""
    return PER_CAMERA * np.arange(n_cameras) + 6


@dataclass(frozen=True, eq=False)
class State:
    """Values of all unknowns.

    Attributes:
        T_cam_lidar: (C, 4, 4).
        T_lidar_board: (F, 4, 4).
        own_shift_m: (F,) shift of each capture's ring ends beyond that of all, like `SHIFTS`' d_0.
        constants: (7 C + 3 L + 12,) z, zero in the places of the tangents.
    """

    T_cam_lidar: Array
    T_lidar_board: Array
    own_shift_m: Array
    constants: Array

    def moved(self, z: Array, y: Array) -> "State":
        """Apply a step."""
        tangents = np.arange(PER_CAMERA * len(self.T_cam_lidar)).reshape(-1, PER_CAMERA)[:, :6]
        constants = self.constants + z
        constants[tangents] = 0
        return State(
            perturb(self.T_cam_lidar, z[tangents]),
            perturb(self.T_lidar_board, y[:, :_OWN_SHIFT]),
            self.own_shift_m + y[:, _OWN_SHIFT],
            constants,
        )


def of_the_lidar(constants: Array) -> tuple[Array, Array, Array]:
    """Split the constants that follow the cameras': errors of the lasers (3, L), fields (4,), shifts (8,)."""
    lasers, fields, shifts = np.split(constants, [-N_FIELDS - N_SHIFTS, -N_SHIFTS])
    return lasers.reshape(N_OF_LASER, -1), fields, shifts


@dataclass(frozen=True, eq=False)
class Terms:
    """All residuals at one state, before they are weighted.

    Attributes:
        ranges: of points.
        edges: of ring ends.
        images: of each camera.
        image_rows: linearised, of each camera.
        constants: z of the state.
        own_shift_m: (F,) of the state.
        trust: (F,) weight of each capture.
        rings: (L,) ring numbers.
    """

    ranges: RangeSums
    edges: EdgeRows
    images: tuple[StackedImages, ...]
    image_rows: tuple[Array, ...]
    constants: Array
    own_shift_m: Array
    trust: Array
    rings: NDArray[np.int16]

    @property
    def n_rings(self) -> int:
        """L."""
        return int(self.ranges.sums.shape[1])


def linearise(
    scans: StackedScans,
    images: Sequence[StackedImages],
    board: Board,
    state: State,
    trust: Array | None = None,
) -> Terms:
    """Linearise all terms; `trust` (F,) is 1 for each capture by default."""
    lasers, fields, shifts = of_the_lidar(state.constants[PER_CAMERA * len(images) :])
    T_lidar_board = state.T_lidar_board
    return Terms(
        sum_ranges(scans, T_lidar_board, lasers, fields),
        edge_rows(scans, T_lidar_board, board, lasers, fields, shifts, state.own_shift_m),
        tuple(images),
        _rows_of_images(images, state),
        state.constants,
        state.own_shift_m,
        np.ones(scans.n_captures) if trust is None else trust,
        scans.rings,
    )


def _rows_of_images(images: Sequence[StackedImages], state: State) -> tuple[Array, ...]:
    n = PER_CAMERA * len(images)
    per_camera = state.constants[:n].reshape(-1, PER_CAMERA)
    bow_m = of_the_lidar(state.constants[n:])[1][-N_BOW:]
    return tuple(
        image_rows(own, T, state.T_lidar_board, float(constants[-1]), bow_m)
        for own, T, constants in zip(images, state.T_cam_lidar, per_camera, strict=True)
    )


@dataclass(frozen=True, eq=False)
class Reduced:
    """Normal equations with the captures' own unknowns eliminated.

    Attributes:
        cost: of F captures in z, at the constants' present values.
        own_steps: (F, 7, G + 1), y = -own_steps [z; 1].
        of_own: (F, 7, 7) information of the captures' own unknowns alone.
        trust: (F,) weight of each capture.
        minus_2_log_evidence: -2 ln p(data | levels) up to a constant, all unknowns integrated out.
    """

    cost: Quadratics
    own_steps: Array
    of_own: Array
    trust: Array
    minus_2_log_evidence: float

    @cached_property
    def gradient(self) -> Array:
        """(G,) by z, of all captures and priors."""
        return np.asarray(self.cost.gradients.sum(axis=0) + self.cost.prior_gradient)

    @property
    def decrement(self) -> float:
        """Squared length of the step, in standard deviations of all unknowns."""
        z, _ = self.step
        y = self.own_steps[:, :, -1]
        return float(np.einsum("fi,fij,fj", y, self.of_own, y) - self.gradient @ z)

    @cached_property
    def step(self) -> tuple[Array, Array]:
        """Towards the optimum: z (G,) and y (F, 7)."""
        # Priors of constants differ by many orders of magnitude, too many for `Quadratics.optimum`.
        z = np.asarray(-np.linalg.solve(self.cost.information, self.gradient))
        return z, -self.own_steps @ np.append(z, 1.0)

    def second_moments(self) -> Array:
        """Compute the mean (F, 7 + G + 1, 7 + G + 1) of v v^T, v = [y, z, 1], given the data.

        A capture of weight w counts as w captures, each with the covariance of y that one of full weight has.
        """
        z, y = self.step
        F, G = len(y), len(z)
        by_z = np.concatenate([-self.own_steps[:, :, :G], np.broadcast_to(np.eye(G), (F, G, G))], axis=1)
        v = np.column_stack([y, np.broadcast_to(np.append(z, 1.0), (F, G + 1))])
        found = v[:, :, None] * v[:, None, :]
        found[:, :-1, :-1] += by_z @ np.linalg.inv(self.cost.information) @ np.swapaxes(by_z, 1, 2)
        found[:, :PER_CAPTURE, :PER_CAPTURE] += self.trust[:, None, None] * np.linalg.inv(self.of_own)
        return np.asarray(found)


def assemble(terms: Terms, levels: Levels, priors: Priors) -> Reduced:
    """Weight all terms and eliminate the captures' own unknowns.

    Args:
        terms: of F captures.
        levels: of their noise.
        priors: of the constants.
    """
    return Assembly(terms, priors).at(levels)


class Assembly:
    """The normal equations of terms at one level of noise after another.

    The terms of the last levels stay: the derivative of the evidence needs them again.

    Args:
        terms: of F captures.
        priors: of the constants.
    """

    def __init__(self, terms: Terms, priors: Priors) -> None:
        self._terms, self._priors = terms, priors
        self._range_block = lru_cache(maxsize=1)(partial(_range_block, terms))
        self._edge_block = lru_cache(maxsize=1)(partial(_edge_block, terms))
        self._image_block = lru_cache(maxsize=1)(partial(_image_block, terms))

    def with_images(self, images: Sequence[StackedImages], state: State) -> "Assembly":
        """Replace the images of terms that were linearised at a state; the other terms stay cached."""
        other = copy(self)
        other._terms = replace(self._terms, images=tuple(images), image_rows=_rows_of_images(images, state))
        other._image_block = lru_cache(maxsize=1)(partial(_image_block, other._terms))
        return other

    def at(self, levels: Levels) -> Reduced:
        """Weight all terms and eliminate the captures' own unknowns."""
        of_ranges, range_volume = self._range_block(levels.range_m, levels.ring_m)
        of_edges = self._edge_block(levels.edge_rad, levels.backed_rad, levels.lost_share)
        of_own, own_volume = _own_block(self._terms, levels.own_shift_m)
        of_pictures, picture_volume = self._image_block(levels.pose)
        return _eliminate(
            (of_ranges + of_edges + of_pictures + of_own) * self._terms.trust[:, None, None],
            self._terms,
            levels,
            self._priors,
            float(self._terms.trust @ (range_volume + picture_volume + own_volume)),
        )

    def evidence(self, levels: Levels, names: Sequence[str]) -> tuple[float, Array]:
        """Compute -2 ln p(data | levels) and its derivative by the logarithms of some levels.

        By a level, it is the mean of v^T dM v over all unknowns given the data, with M the products of
        [y, z, 1] and their priors, and the change of the covariances' log determinants. Only M is
        differentiated by differences.
        """
        terms, reduced = self._terms, self.at(levels)
        moments = reduced.second_moments()
        own = moments * terms.trust[:, None, None]
        block, range_volume = self._range_block(levels.range_m, levels.ring_m)
        pictures, picture_volume = self._image_block(levels.pose)
        of_ends = lru_cache(_end_costs(terms, own))
        prior, mean, prior_volume = _prior(terms, levels, self._priors)
        # All captures have the same z; the mean of the square of its distance from that of the prior.
        z = terms.constants - mean
        shift = moments[0, PER_CAPTURE:-1, -1]
        of_constants = (
            moments[0, PER_CAPTURE:-1, PER_CAPTURE:-1]
            + np.outer(z, z)
            + np.outer(z, shift)
            + np.outer(shift, z)
        )

        def change(name: str) -> float:
            there = replace(levels, **{name: getattr(levels, name) * np.exp(_LOG_STEP)})
            if name in ("range_m", "ring_m"):
                moved, volume = _range_block(terms, there.range_m, there.ring_m)
                return float(np.vdot(own, moved - block) + terms.trust @ (volume - range_volume))
            if name in PoseLevels._fields:
                moved, volume = _image_block(terms, there.pose)
                return float(np.vdot(own, moved - pictures) + terms.trust @ (volume - picture_volume))
            if name == "own_shift_m":
                moved, volume = _own_block(terms, there.own_shift_m)
                before, own_volume = _own_block(terms, levels.own_shift_m)
                return float(np.vdot(own, moved - before) + terms.trust @ (volume - own_volume))
            if name == "laser_m":
                moved, _, log_volume = _prior(terms, there, self._priors)
                return float(np.vdot(of_constants, moved - prior)) + log_volume - prior_volume
            return of_ends(there) - of_ends(levels)

        slopes = np.array([change(name) for name in names]) / _LOG_STEP
        return reduced.minus_2_log_evidence, slopes


def _end_costs(terms: Terms, moments: Array) -> Callable[[Levels], float]:
    """Return the ring ends' part of -2 ln p for moments (F, n, n) of all unknowns, by level."""
    edges, n_cameras, n_rings = terms.edges, len(terms.images), terms.n_rings
    lasers = PER_CAPTURE + PER_CAMERA * n_cameras + n_rings * np.arange(N_OF_LASER)
    shared = np.arange(lasers[0] + N_OF_LASER * n_rings, moments.shape[1] - 1)
    M = len(edges.rows)
    place = np.column_stack(
        [
            np.broadcast_to(np.arange(6), (M, 6)),
            edges.ring[:, None] + lasers,
            np.broadcast_to(shared, (M, len(shared))),
            np.full((M, 1), _OWN_SHIFT),
        ]
    )
    J, k = np.column_stack([edges.rows[:, :-1], edges.rows[:, -1 - N_SHIFTS]]), edges.capture
    squares = np.einsum("mi,mij,mj->m", J, moments[k[:, None, None], place[:, :, None], place[:, None, :]], J)
    firsts = np.sum(J * moments[k[:, None], place, -1], axis=1)

    def cost(levels: Levels) -> float:
        weight, score, value = expand_ends(edges, levels.edge_rad, levels.backed_rad, levels.lost_share)
        return float(weight @ squares + 2 * score @ firsts + value @ terms.trust[k])

    return cost


def _range_block(terms: Terms, range_m: float, ring_m: float) -> tuple[Array, Array]:
    """Weight the returns' terms; also the log determinants (F,) of their covariances."""
    block = _no_block(terms)
    weighted, log_volumes = weigh_ranges(terms.ranges, range_m, ring_m)
    place = np.r_[
        0:6, PER_CAPTURE + PER_CAMERA * len(terms.images) : block.shape[1] - 1 - N_SHIFTS, block.shape[1] - 1
    ]
    block[:, place[:, None], place] = range_system(terms.ranges, weighted)
    return block, log_volumes


def _edge_block(terms: Terms, edge_rad: float, backed_rad: float, lost_share: float) -> Array:
    """Weight the ring ends' terms."""
    block = _no_block(terms)
    place = np.r_[0:6, PER_CAPTURE + PER_CAMERA * len(terms.images) : block.shape[1]]
    by_ring = edge_system(terms.edges, edge_rad, backed_rad, lost_share, len(block))
    block[:, place[:, None], place] = spread_rings(by_ring)
    # A capture's own shift acts as that of all captures does.
    block[:, _OWN_SHIFT] = block[:, -1 - N_SHIFTS]
    block[:, :, _OWN_SHIFT] = block[:, :, -1 - N_SHIFTS]
    return block


def _own_block(terms: Terms, own_shift_m: float) -> tuple[Array, Array]:
    """Build what is known of the captures' own shifts; also the logs (F,) of its covariances."""
    block, precision = _no_block(terms), own_shift_m**-2
    block[:, _OWN_SHIFT, _OWN_SHIFT] = precision
    block[:, _OWN_SHIFT, -1] = block[:, -1, _OWN_SHIFT] = precision * terms.own_shift_m
    block[:, -1, -1] = precision * terms.own_shift_m**2
    return block, np.full(len(block), 2 * np.log(own_shift_m))


def _image_block(terms: Terms, pose_levels: PoseLevels) -> tuple[Array, Array]:
    """Weight the images' terms; also the log determinants (F,) of their covariances."""
    block, log_volumes = _no_block(terms), np.zeros_like(terms.trust)
    for c, (images, rows) in enumerate(zip(terms.images, terms.image_rows, strict=True)):
        cov = images.total_cov(pose_levels)
        own = PER_CAPTURE + PER_CAMERA * c
        last = block.shape[1] - 1
        bows = last - N_SHIFTS - N_BOW + np.arange(N_BOW)
        place = np.r_[own : own + 6, 0:6, own + 6, bows, last]
        products = np.swapaxes(rows, 1, 2) @ np.linalg.solve(cov, rows)
        block[images.capture[:, None, None], place[:, None], place] += products
        log_volumes[images.capture] += np.linalg.slogdet(cov)[1]
    return block, log_volumes


def _no_block(terms: Terms) -> Array:
    """Allocate products of [y (7), z (G), residual] by capture."""
    size = PER_CAPTURE + len(terms.constants) + 1
    return np.zeros((len(terms.ranges.sums), size, size))


def _eliminate(M: Array, terms: Terms, levels: Levels, priors: Priors, log_volume: float) -> Reduced:
    """Eliminate the captures' own unknowns from M (F, 7 + G + 1, 7 + G + 1) and add the priors."""
    p = PER_CAPTURE
    of_own, rest = M[:, :p, :p], M[:, :p, p:]
    steps = np.linalg.solve(of_own, rest)
    reduced = M[:, p:, p:] - np.swapaxes(rest, 1, 2) @ steps
    hessians, gradients, costs = reduced[:, :-1, :-1], reduced[:, :-1, -1], reduced[:, -1, -1]
    prior, mean, log_prior_volume = _prior(terms, levels, priors)
    off = terms.constants - mean
    summed = Quadratics(gradients, hessians, prior, prior @ off, np.arange(len(M)))
    information, gradient = summed.information, gradients.sum(axis=0) + summed.prior_gradient
    least = costs.sum() + off @ summed.prior_gradient
    least -= gradient @ np.linalg.solve(information, gradient)
    log_volume += float(terms.trust @ np.linalg.slogdet(of_own)[1] + np.linalg.slogdet(information)[1])
    evidence = float(least + log_volume + log_prior_volume)
    return Reduced(summed, np.asarray(steps), of_own, terms.trust, evidence)


def _prior(terms: Terms, levels: Levels, priors: Priors) -> tuple[Array, Array, float]:
    """Build the priors' information (G, G), their mean (G,) and the log of their covariance's determinant.

    Range offsets of L rings have the covariance sigma_laser^2 (I - 1 1^T / L) + sigma_offset^2 1 1^T.
    """
    L, C = terms.n_rings, len(terms.images)
    prior, mean = np.zeros((len(terms.constants), len(terms.constants))), np.zeros(len(terms.constants))
    scale = scale_places(C)
    prior[scale, scale] = 1 / np.square(priors.scale)
    ring = PER_CAMERA * C + np.arange(L)
    log_volume = 0.0
    of_lasers = (
        (levels.laser_m, priors.offset_m),
        (priors.azimuth_rad, 0.0),
        (priors.elevation_rad, 0.0),
    )
    fields_sigma = priors.fields
    known = priors.known
    for k, (own, common) in enumerate(of_lasers):
        cov = own**2 * (np.eye(L) - 1 / L)
        if known is not None:
            at, which = _places(terms.rings, known.rings)
            cov = own**2 * np.eye(L)
            cov[at, at] = known.lasers_sigma[k, which] ** 2
            mean[ring[at] + k * L] = known.lasers[k, which]
        cov = cov + common**2 + _MEAN_FLOOR**2 * np.eye(L)
        prior[(ring + k * L)[:, None], ring + k * L] = np.linalg.inv(cov)
        log_volume += float(np.linalg.slogdet(cov)[1])
    last = np.arange(PER_CAMERA * C + N_OF_LASER * L, len(prior))
    if known is not None:
        mean[last[:N_LENS]], fields_sigma[:N_LENS] = known.lens, known.lens_sigma
    prior[last, last] = np.concatenate([fields_sigma, priors.shifts]) ** -2.0
    return prior, mean, log_volume


def _places(rings: NDArray[np.int16], known: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Find the rings that are known: their indices among those seen, and among those known."""
    _, seen, which = np.intersect1d(rings, known, return_indices=True)
    return seen, which
