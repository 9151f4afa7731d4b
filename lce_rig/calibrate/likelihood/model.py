"""All terms at one state, and their normal equations for any noise levels.

A capture's own unknowns y enter only its own terms: the matrix is an arrow head, and y is eliminated capture
by capture (Schur complement). `layout` names the unknowns.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.likelihood.end_density import edge_system, expand_ends
from lce_rig.calibrate.likelihood.images import StackedImages, image_rows
from lce_rig.calibrate.likelihood.layout import END, LASER, OWN, RING, Columns, Indices, Layout, State
from lce_rig.calibrate.likelihood.levels import Levels, PoseLevels, Priors
from lce_rig.calibrate.likelihood.rays import (
    EdgeRows,
    RangeSums,
    StackedScans,
    edge_rows,
    ring_systems,
    sum_ranges,
    weigh_ranges,
)
from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array

# Of the logarithm of a level, for differences.
_LOG_STEP = 1e-4
# The lasers' own errors have zero mean: that of ranges is the common offset, those of angles are part of the
# extrinsics. This much of it is left.
_MEAN_FLOOR = 1e-6


@dataclass(frozen=True, eq=False)
class Terms:
    """All residuals at one state, before they are weighted.

    Attributes:
        state: values of the unknowns.
        ranges: of points.
        edges: of ring ends.
        images: of each camera.
        image_rows: linearised, of each camera.
        trust: (F,) weight of each capture.
        rings: (L,) ring numbers.
    """

    state: State
    ranges: RangeSums
    edges: EdgeRows
    images: tuple[StackedImages, ...]
    image_rows: tuple[Array, ...]
    trust: Array
    rings: NDArray[np.int16]

    def gradients_by_pose_moves(self, levels: Levels, moves: Array) -> Array:
        """Differentiate the gradients of the first camera's captures by moves of its image poses.

        Args:
            levels: of the noise.
            moves: (V, P, 6) tangents of T_cam_board.

        Returns:
            (F, 7 + G, V) change of the gradients by [y, z].
        """
        images, rows, layout = self.images[0], self.image_rows[0], self.state.layout
        weighted = -np.linalg.solve(images.total_cov(levels.pose), np.moveaxis(moves, 0, -1))
        changes = np.zeros((len(self.trust), layout.row.size - 1, len(moves)))
        products = np.swapaxes(rows[:, :, :-1], 1, 2) @ weighted
        changes[images.capture[:, None], layout.image_row(0)[:-1]] = products
        return np.asarray(changes * self.trust[:, None, None])


def linearise(
    scans: StackedScans,
    images: Sequence[StackedImages],
    board: Board,
    state: State,
    trust: Array | None = None,
) -> Terms:
    """Linearise all terms; `trust` (F,) is 1 for each capture by default."""
    return Terms(
        state,
        sum_ranges(scans, state),
        edge_rows(scans, board, state),
        tuple(images),
        tuple(
            image_rows(of_camera, T, state.T_lidar_board, scale)
            for of_camera, T, scale in zip(images, state.T_cam_lidar, state.scale.tolist(), strict=True)
        ),
        np.ones(scans.n_captures) if trust is None else trust,
        scans.rings,
    )


@dataclass(frozen=True, eq=False)
class Reduced:
    """Normal equations with the captures' own unknowns eliminated.

    Attributes:
        cost: of F captures in z, at its present value.
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
        own, common, by_z = slice(0, OWN.size), slice(OWN.size, -1), -self.own_steps[:, :, :G]
        v = np.column_stack([y, np.broadcast_to(np.append(z, 1.0), (F, G + 1))])
        moments = v[:, :, None] * v[:, None, :]
        cov = np.linalg.inv(self.cost.information)
        cross = by_z @ cov
        moments[:, common, common] += cov
        moments[:, own, common] += cross
        moments[:, common, own] += np.swapaxes(cross, 1, 2)
        moments[:, own, own] += cross @ np.swapaxes(by_z, 1, 2)
        moments[:, own, own] += self.trust[:, None, None] * np.linalg.inv(self.of_own)
        return np.asarray(moments)


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

    def at(self, levels: Levels) -> Reduced:
        """Weight all terms, eliminate the captures' own unknowns and add the priors."""
        terms, state = self._terms, self._terms.state
        of_ranges, range_volume = self._range_block(levels.range_m, levels.ring_m)
        of_edges = self._edge_block(levels.edge_rad, levels.backed_rad, levels.lost_share)
        own_shift, own_volume = _own_shift_block(terms, levels.own_shift_m)
        of_images, image_volume = self._image_block(levels.pose)
        M = (of_ranges + of_edges + of_images + own_shift) * terms.trust[:, None, None]
        own, common = slice(0, OWN.size), slice(OWN.size, None)
        of_own, cross = M[:, own, own], M[:, own, common]
        steps = np.linalg.solve(of_own, cross)
        reduced = M[:, common, common] - np.swapaxes(cross, 1, 2) @ steps
        hessians, gradients, costs = reduced[:, :-1, :-1], reduced[:, :-1, -1], reduced[:, -1, -1]
        prior, mean, prior_volume = _prior(terms, levels, self._priors)
        off = state.z - mean
        summed = Quadratics(gradients, hessians, prior, prior @ off, np.arange(len(M)))
        information, gradient = summed.information, gradients.sum(axis=0) + summed.prior_gradient
        least = costs.sum() + off @ summed.prior_gradient
        least -= gradient @ np.linalg.solve(information, gradient)
        log_volume = float(terms.trust @ (range_volume + image_volume + own_volume))
        log_volume += float(terms.trust @ np.linalg.slogdet(of_own)[1] + np.linalg.slogdet(information)[1])
        evidence = float(least + log_volume + prior_volume)
        return Reduced(summed, np.asarray(steps), of_own, terms.trust, evidence)

    def evidence(self, levels: Levels, names: Sequence[str]) -> tuple[float, Array]:
        """Compute -2 ln p(data | levels) and its derivative by the logarithms of some levels.

        By a level, it is the mean of v^T dM v over all unknowns given the data, with M the products of
        [y, z, 1] and their priors, and the change of the covariances' log determinants. Only M is
        differentiated by differences.
        """
        terms, reduced = self._terms, self.at(levels)
        moments = reduced.second_moments()
        weighted = moments * terms.trust[:, None, None]
        of_parts = (_range_costs, _image_costs, _own_shift_costs, _end_costs)
        ranges, images, own_shifts, ends = (lru_cache(part(terms, weighted)) for part in of_parts)
        by_level = {"range_m": ranges, "ring_m": ranges, "own_shift_m": own_shifts}
        by_level |= dict.fromkeys(PoseLevels._fields, images)
        prior, mean, prior_volume = _prior(terms, levels, self._priors)
        # All captures have the same z; the mean of the square of its distance from that of the prior.
        z = terms.state.z - mean
        common = slice(OWN.size, -1)
        shift = np.outer(z, moments[0, common, -1])
        squares = moments[0, common, common] + np.outer(z, z) + shift + shift.T

        def change(name: str) -> float:
            there = replace(levels, **{name: getattr(levels, name) * np.exp(_LOG_STEP)})
            if name == "laser_m":
                moved, _, log_volume = _prior(terms, there, self._priors)
                return float(np.vdot(squares, moved - prior)) + log_volume - prior_volume
            cost = by_level.get(name, ends)
            return cost(there) - cost(levels)

        slopes = np.array([change(name) for name in names]) / _LOG_STEP
        return reduced.minus_2_log_evidence, slopes


def _ring_places(columns: Columns, layout: Layout) -> Indices:
    """List the places (L, c) in [y, z, residual] of each ring's columns."""
    laser = dict(zip(LASER, layout.row.of(LASER).reshape(len(LASER), -1), strict=True))
    n_rings = len(laser[LASER[0]])
    return np.column_stack(
        [laser[name] if name in laser else np.tile(layout.row.of([name]), (n_rings, 1)) for name in columns]
    )


def _range_costs(terms: Terms, moments: Array) -> Callable[[Levels], float]:
    """Return the returns' part of -2 ln p for moments (F, n, n) of all unknowns, by level."""
    place = _ring_places(RING, terms.state.layout)
    of_rings = moments[:, place[:, :, None], place[:, None, :]]

    def cost(levels: Levels) -> float:
        weighted, log_volumes = weigh_ranges(terms.ranges, levels.range_m, levels.ring_m)
        return float(np.vdot(of_rings, ring_systems(terms.ranges, weighted)) + terms.trust @ log_volumes)

    return cost


def _image_costs(terms: Terms, moments: Array) -> Callable[[Levels], float]:
    """Return the images' part of -2 ln p for moments (F, n, n) of all unknowns, by level."""

    def cost(levels: Levels) -> float:
        total = 0.0
        for capture, place, products, log_volumes in _image_products(terms, levels.pose):
            total += np.vdot(moments[capture[:, None, None], place[:, None], place], products)
            total += terms.trust[capture] @ log_volumes
        return float(total)

    return cost


def _own_shift_costs(terms: Terms, moments: Array) -> Callable[[Levels], float]:
    """Return the part of -2 ln p of the captures' own shifts for moments (F, n, n), by level."""
    at, shift_m = terms.state.layout.row["own_shift"].start, terms.state.own_shift_m
    square_m2 = moments[:, at, at] + 2 * moments[:, at, -1] * shift_m + moments[:, -1, -1] * shift_m**2

    def cost(levels: Levels) -> float:
        sigma_m = levels.own_shift_m
        return float(square_m2.sum() / sigma_m**2 + terms.trust.sum() * 2 * np.log(sigma_m))

    return cost


def _end_costs(terms: Terms, moments: Array) -> Callable[[Levels], float]:
    """Return the ring ends' part of -2 ln p for moments (F, n, n) of all unknowns, by level."""
    edges, row = terms.edges, terms.state.layout.row
    k = edges.capture
    own_shift = np.tile(row.of(["own_shift"]), (len(k), 1))
    place = np.hstack([_ring_places(END, terms.state.layout)[edges.ring, :-1], own_shift])
    J = np.column_stack([edges.rows[:, :-1], edges.rows[:, END["shifts"].start]])
    squares = np.einsum("mi,mij,mj->m", J, moments[k[:, None, None], place[:, :, None], place[:, None, :]], J)
    firsts = np.sum(J * moments[k[:, None], place, -1], axis=1)

    def cost(levels: Levels) -> float:
        weight, score, value = expand_ends(edges, levels.edge_rad, levels.backed_rad, levels.lost_share)
        return float(weight @ squares + 2 * score @ firsts + value @ terms.trust[k])

    return cost


def _range_block(terms: Terms, range_m: float, ring_m: float) -> tuple[Array, Array]:
    """Weight the returns' terms; also the log determinants (F,) of their covariances."""
    weighted, log_volumes = weigh_ranges(terms.ranges, range_m, ring_m)
    return _spread_rings(ring_systems(terms.ranges, weighted), RING, terms.state.layout), log_volumes


def _edge_block(terms: Terms, edge_rad: float, backed_rad: float, lost_share: float) -> Array:
    """Weight the ring ends' terms."""
    row = terms.state.layout.row
    by_ring = edge_system(terms.edges, edge_rad, backed_rad, lost_share, len(terms.trust))
    block = _spread_rings(by_ring, END, terms.state.layout)
    # A capture's own shift acts as that of all captures does.
    own_shift, common = row["own_shift"].start, row["shifts"].start
    block[:, own_shift] = block[:, common]
    block[:, :, own_shift] = block[:, :, common]
    return block


def _spread_rings(by_ring: Array, columns: Columns, layout: Layout) -> Array:
    """Sum normal equations over the rings of each capture, with errors of its own for each laser.

    Args:
        by_ring: (F, L, c, c) with columns as named.
        columns: their names.
        layout: of the unknowns.

    Returns:
        (F, n, n) products of [y, z, residual].
    """
    shared = [name for name in columns if name not in LASER]
    mine, at = columns.of(shared), layout.row.of(shared)
    block = np.zeros((len(by_ring), layout.row.size, layout.row.size))
    block[:, at[:, None], at] = by_ring.sum(axis=1)[:, mine[:, None], mine]
    lasers = [(columns[name].start, layout.row.of([name])) for name in LASER]
    for i, first in lasers:
        cross = by_ring[:, :, i][:, :, mine]
        block[:, first[:, None], at] = cross
        block[:, at[:, None], first] = np.swapaxes(cross, 1, 2)
        for j, second in lasers:
            block[:, first, second] = by_ring[:, :, i, j]
    return block


def _own_shift_block(terms: Terms, own_shift_m: float) -> tuple[Array, Array]:
    """Build what is known of the captures' own shifts; also the logs (F,) of its covariances."""
    row, shift_m = terms.state.layout.row, terms.state.own_shift_m
    block, precision = np.zeros((len(shift_m), row.size, row.size)), own_shift_m**-2
    at = row["own_shift"].start
    block[:, at, at] = precision
    block[:, at, -1] = block[:, -1, at] = precision * shift_m
    block[:, -1, -1] = precision * shift_m**2
    return block, np.full(len(block), 2 * np.log(own_shift_m))


def _image_block(terms: Terms, pose_levels: PoseLevels) -> tuple[Array, Array]:
    """Weight the images' terms; also the log determinants (F,) of their covariances."""
    layout, log_volumes = terms.state.layout, np.zeros_like(terms.trust)
    block = np.zeros((len(terms.trust), layout.row.size, layout.row.size))
    for capture, place, products, volumes in _image_products(terms, pose_levels):
        block[capture[:, None, None], place[:, None], place] += products
        log_volumes[capture] += volumes
    return block, log_volumes


def _image_products(terms: Terms, pose_levels: PoseLevels) -> Iterator[tuple[Indices, Indices, Array, Array]]:
    """Weight each camera's rows: captures (V,), places (c,), products (V, c, c), log determinants (V,)."""
    for c, (images, rows) in enumerate(zip(terms.images, terms.image_rows, strict=True)):
        cov = images.total_cov(pose_levels)
        products = np.swapaxes(rows, 1, 2) @ np.linalg.solve(cov, rows)
        yield images.capture, terms.state.layout.image_row(c), products, np.linalg.slogdet(cov)[1]


def _prior(terms: Terms, levels: Levels, priors: Priors) -> tuple[Array, Array, float]:
    """Build the priors' information (G, G), their mean (G,) and the log of their covariance's determinant.

    Range offsets of L rings have the covariance sigma_laser^2 (I - 1 1^T / L) + sigma_offset^2 1 1^T.
    """
    layout, known = terms.state.layout, priors.known
    L = layout.n_rings
    prior, mean = np.zeros((layout.z.size, layout.z.size)), np.zeros(layout.z.size)
    prior[layout.scales, layout.scales] = 1 / np.square(priors.scale)
    sigmas, log_volume = priors.independent, 0.0
    if known is not None:
        mean[layout.z["lens"]], sigmas["lens"] = known.lens, known.lens_sigma
        # Rings that are known: their indices among those seen, and among those known.
        _, measured, which = np.intersect1d(terms.rings, known.rings, return_indices=True)
    for name, sigma in sigmas.items():
        at = layout.z.of([name])
        prior[at, at] = sigma**-2.0
    of_lasers = ((levels.laser_m, priors.offset_m), (priors.azimuth_rad, 0.0), (priors.elevation_rad, 0.0))
    for k, (at, (each, common)) in enumerate(zip(layout.lasers, of_lasers, strict=True)):
        cov = each**2 * (np.eye(L) - 1 / L)
        if known is not None:
            cov = each**2 * np.eye(L)
            cov[measured, measured] = known.lasers_sigma[k, which] ** 2
            mean[at[measured]] = known.lasers[k, which]
        cov = cov + common**2 + _MEAN_FLOOR**2 * np.eye(L)
        prior[at[:, None], at] = np.linalg.inv(cov)
        log_volume += float(np.linalg.slogdet(cov)[1])
    return prior, mean, log_volume
