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
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, perturb
from lce_rig.extrinsics.likelihood.image_terms import StackedImages, image_rows
from lce_rig.extrinsics.likelihood.levels import Levels, PoseLevels, Priors
from lce_rig.residuals.along_rays import (
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
from lce_rig.residuals.quadratics import Quadratics

# Density, score and information of the distance between a ring's last return on the board and the edge.
#
# In units of the step to the next ray, let x be the distance of the last return inside the edge, less half a
# step, beam width included. Without noise x is uniform in -1/2..1/2: the edge lies between the last ray that
# hit the board and the first that did not. Three effects blur that:
#
#     p(x) = (1 - a - b) core + a lost + b stray                                                           (1)
#
# core   the uniform interval, its ends blurred by t (pattern, width of the beam); it determines the edge
# better        than a normal distribution of the same variance;
# lost   the last returns on the board are missing (weak, or merged with the person who holds it): an
#        exponential tail inwards, for few ring ends with a stand, for a fifth with a person behind the board;
# stray  anything else (the neighbouring ray hit an object just behind the board), a Cauchy distribution.

STRAY = 0.01
"""Fraction b of (1), from simulated and recorded captures; a is estimated."""
_LOST_STEPS = 1.1
# Range of blurs and lost fractions in the information table. Narrower ones count as the narrowest; wider
# ones leave a normal density.
_NARROWEST = 0.01
_BLURS = np.geomspace(_NARROWEST, 30.0, 60)
_SHARES = np.array([0.001, 0.02, 0.05, 0.1, 0.2, 0.35, 0.6])


def density(x: Array, blur: Array, lost_share: float) -> tuple[Array, Array]:
    """Compute (1) and its derivative.

    Args:
        x: (M,) steps.
        blur: (M,) t, steps.
        lost_share: a.

    Returns:
        p and dp/dx, (M,) each.
    """
    from scipy.special import ndtr

    t = np.maximum(blur, _NARROWEST)
    low, high = (x + 0.5) / t, (x - 0.5) / t
    core, core_slope = ndtr(low) - ndtr(high), (_normal(low) - _normal(high)) / t
    lost = _exponential_with_noise(x, t)
    lost_slope = (_normal(x / t) / t - lost) / _LOST_STEPS
    width = np.maximum(t, 1.0)
    stray = 1 / (np.pi * width * (1 + (x / width) ** 2))
    stray_slope = -2 * x * np.pi / width * stray**2
    shares = (1 - lost_share - STRAY, lost_share, STRAY)
    p, slope = (
        sum(share * part for share, part in zip(shares, parts, strict=True))
        for parts in ((core, lost, stray), (core_slope, lost_slope, stray_slope))
    )
    return np.asarray(p), np.asarray(slope)


def _exponential_with_noise(x: Array, t: Array) -> Array:
    """Compute the density of an exponential error of mean `_LOST_STEPS` plus a normal one of deviation t."""
    from scipy.special import erfcx, ndtr

    s = t / _LOST_STEPS
    z = x / t - s
    # Both forms are equal; each overflows where the other does not.
    below = np.exp(-0.5 * (x / t) ** 2) * erfcx(-np.minimum(z, 0.0) / np.sqrt(2)) / 2
    above = np.exp(np.minimum(s**2 / 2 - x / _LOST_STEPS, 0.0)) * ndtr(z)
    return np.asarray(np.where(z < 0, below, above) / _LOST_STEPS)


def information(blur: Array, lost_share: float) -> Array:
    """Compute Fisher's information (M,) of the edge's place, the mean of (d ln p / dx)^2, per step^2."""
    table = _log_informations()
    row = float(np.interp(lost_share, _SHARES, np.arange(len(_SHARES))))
    low = min(int(row), len(_SHARES) - 2)
    between = table[low] + (row - low) * (table[low + 1] - table[low])
    inside = np.exp(np.interp(np.log(np.maximum(blur, _NARROWEST)), np.log(_BLURS), between))
    return np.asarray(inside * np.minimum(_BLURS[-1] / np.maximum(blur, _NARROWEST), 1.0) ** 2)


def edge_system(
    edges: EdgeRows, edge_rad: float, backed_rad: float, lost_share: float, n_captures: int
) -> Array:
    """Expand -2 ln p of the ring ends to second order, by capture and ring: (F, L, 22, 22).

    With J a row without its residual: J J^T times the information, J times the score in the last column, and
    -2 ln p itself in the corner. The information is the mean over all ring ends of such a blur, as that of a
    single one is zero in the middle of its interval and unusable as a Hessian.
    """
    size = edges.rows.shape[1]
    system = np.zeros((n_captures * edges.n_rings, size, size))
    if len(edges.rows):
        weight, score, value = _expand_ends(edges, edge_rad, backed_rad, lost_share)
        J = edges.rows[:, :-1]
        weighted = np.concatenate([J * weight[:, None], score[:, None]], axis=1)
        bounds = np.flatnonzero(np.diff(edges.group, prepend=-1, append=-1))
        seen = edges.group[bounds[:-1]]
        system[seen, :-1] = [J[a:b].T @ weighted[a:b] for a, b in pairwise(bounds.tolist())]
        system[seen, -1, :-1] = system[seen, :-1, -1]
        system[seen, -1, -1] = np.add.reduceat(value, bounds[:-1])
    return system.reshape(n_captures, edges.n_rings, size, size)


def _expand_ends(
    edges: EdgeRows, edge_rad: float, backed_rad: float, lost_share: float
) -> tuple[Array, Array, Array]:
    """Compute the factors (M,) of J J^T and of J in `edge_system`, and -2 ln p."""
    D, blur = edges.step_m, edges.blur_m(edge_rad, backed_rad) / edges.step_m
    p, slope = density(edges.rows[:, -1] / D, blur, lost_share)
    return information(blur, lost_share) / D**2, -slope / p / D, -2 * np.log(p / D)


@lru_cache(maxsize=1)
def _log_informations() -> Array:
    """Tabulate ln of the information by lost share and blur."""
    x = np.linspace(-1.0, 1.0, 2001)[:, None]
    # Finest where the core rises and falls.
    at = np.sign(x) * np.abs(x) ** 2 * (12.0 + 8.0 * _BLURS)
    blurs = np.broadcast_to(_BLURS, at.shape)
    both = (density(at, blurs, float(share)) for share in _SHARES)
    return np.array([np.log(np.trapezoid(slope**2 / p, at, axis=0)) for p, slope in both])


def _normal(z: Array) -> Array:
    return np.asarray(np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi))


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
        minus_2_log_evidence: -2 ln p(data | levels) up to a constant, all unknowns integrated out.
    """

    cost: Quadratics
    own_steps: Array
    of_own: Array
    minus_2_log_evidence: float

    @cached_property
    def gradient(self) -> Array:
        """(G,) by z, of all captures and priors."""
        return np.asarray(self.cost.gradients.sum(axis=0) + self.cost.prior_gradient)

    def step(self) -> tuple[Array, Array]:
        """Solve for z (G,) and y (F, 7)."""
        # Priors of constants differ by many orders of magnitude, too many for `Quadratics.optimum`.
        z = np.asarray(-np.linalg.solve(self.cost.information, self.gradient))
        return z, -self.own_steps @ np.append(z, 1.0)

    def second_moments(self) -> Array:
        """Compute the mean (F, 7 + G + 1, 7 + G + 1) of v v^T, v = [y, z, 1], given the data."""
        z, y = self.step()
        F, G = len(y), len(z)
        by_z = np.concatenate([-self.own_steps[:, :, :G], np.broadcast_to(np.eye(G), (F, G, G))], axis=1)
        v = np.column_stack([y, np.broadcast_to(np.append(z, 1.0), (F, G + 1))])
        found = v[:, :, None] * v[:, None, :]
        found[:, :-1, :-1] += by_z @ np.linalg.inv(self.cost.information) @ np.swapaxes(by_z, 1, 2)
        found[:, :PER_CAPTURE, :PER_CAPTURE] += np.linalg.inv(self.of_own)
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

    A search for levels changes one at a time; the others' terms are cached.

    Args:
        terms: of F captures.
        priors: of the constants.
    """

    def __init__(self, terms: Terms, priors: Priors) -> None:
        self._terms, self._priors = terms, priors
        self._range_block = lru_cache(maxsize=2)(partial(_range_block, terms))
        self._edge_block = lru_cache(maxsize=2)(partial(_edge_block, terms))
        self._image_block = lru_cache(maxsize=2)(partial(_image_block, terms))

    def with_images(self, images: Sequence[StackedImages], state: State) -> "Assembly":
        """Replace the images of terms that were linearised at a state; the other terms stay cached."""
        other = copy(self)
        other._terms = replace(self._terms, images=tuple(images), image_rows=_rows_of_images(images, state))
        other._image_block = lru_cache(maxsize=2)(partial(_image_block, other._terms))
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
            range_volume + picture_volume + own_volume,
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
                return float(np.vdot(own, moved - block)) + volume - range_volume
            if name in PoseLevels._fields:
                moved, volume = _image_block(terms, there.pose)
                return float(np.vdot(own, moved - pictures)) + volume - picture_volume
            if name == "own_shift_m":
                moved, volume = _own_block(terms, there.own_shift_m)
                before, own_volume = _own_block(terms, levels.own_shift_m)
                return float(np.vdot(own, moved - before)) + volume - own_volume
            if name == "laser_m":
                moved, _, volume = _prior(terms, there, self._priors)
                return float(np.vdot(of_constants, moved - prior)) + volume - prior_volume
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
        weight, score, value = _expand_ends(edges, levels.edge_rad, levels.backed_rad, levels.lost_share)
        return float(weight @ squares + 2 * score @ firsts + value @ terms.trust[k])

    return cost


def _range_block(terms: Terms, range_m: float, ring_m: float) -> tuple[Array, float]:
    """Weight the returns' terms, and sum the log determinants of their covariances."""
    block = _no_block(terms)
    weighted, log_volumes = weigh_ranges(terms.ranges, range_m, ring_m)
    place = np.r_[
        0:6, PER_CAPTURE + PER_CAMERA * len(terms.images) : block.shape[1] - 1 - N_SHIFTS, block.shape[1] - 1
    ]
    block[:, place[:, None], place] = range_system(terms.ranges, weighted)
    return block, float(log_volumes.sum())


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


def _own_block(terms: Terms, own_shift_m: float) -> tuple[Array, float]:
    """Build what is known of the captures' own shifts, and the log of its covariance's determinant."""
    block, precision = _no_block(terms), own_shift_m**-2
    block[:, _OWN_SHIFT, _OWN_SHIFT] = precision
    block[:, _OWN_SHIFT, -1] = block[:, -1, _OWN_SHIFT] = precision * terms.own_shift_m
    block[:, -1, -1] = precision * terms.own_shift_m**2
    return block, 2 * len(block) * float(np.log(own_shift_m))


def _image_block(terms: Terms, pose_levels: PoseLevels) -> tuple[Array, float]:
    """Weight the images' terms, and sum the log determinants of their covariances."""
    block, log_volume = _no_block(terms), 0.0
    for c, (images, rows) in enumerate(zip(terms.images, terms.image_rows, strict=True)):
        cov = images.total_cov(pose_levels)
        own = PER_CAPTURE + PER_CAMERA * c
        last = block.shape[1] - 1
        bows = last - N_SHIFTS - N_BOW + np.arange(N_BOW)
        place = np.r_[own : own + 6, 0:6, own + 6, bows, last]
        products = np.swapaxes(rows, 1, 2) @ np.linalg.solve(cov, rows)
        block[images.capture[:, None, None], place[:, None], place] += products
        log_volume += float(np.linalg.slogdet(cov)[1].sum())
    return block, log_volume


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
    log_volume += np.linalg.slogdet(of_own)[1].sum() + np.linalg.slogdet(information)[1]
    evidence = float(least + log_volume + log_prior_volume)
    return Reduced(summed, np.asarray(steps), of_own, evidence)


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
