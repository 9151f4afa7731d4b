"""All terms at one state, and their normal equations for given noise levels.

A capture's own unknowns y enter only its own terms: the matrix is an arrow head, and y is eliminated capture
by capture (Schur complement). `layout` names the unknowns.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from lce_rig.calibrate.likelihood.end_density import edge_products
from lce_rig.calibrate.likelihood.images import StackedImages, image_rows
from lce_rig.calibrate.likelihood.layout import BOARD, END, LASER, OWN, RING, Columns, Indices, Layout, State
from lce_rig.calibrate.likelihood.levels import EXACT, OF_IMAGES, Levels, Priors
from lce_rig.calibrate.likelihood.rays import (
    EdgeRows,
    RangeSums,
    StackedScans,
    edge_rows,
    sum_ranges,
    weigh_ranges,
)
from lce_rig.calibrate.quadratics import Quadratics
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array

# Step of a level's logarithm for numerical differences.
_LOG_STEP = 1e-4
_OF_PROFILE = frozenset(BOARD)


@dataclass(frozen=True, eq=False)
class Terms:
    """All residuals at one state, before they are weighted.

    Attributes:
        scans: rays of F captures.
        images: images of each camera.
        board: the plate's size.
        state: values of the unknowns.
        trust: (F,) weight of each capture.
        ranges: sums of returns, at the state.
        edges: rows of ring ends.
        image_rows: linearised, of each camera.
    """

    scans: StackedScans
    images: tuple[StackedImages, ...]
    board: Board
    state: State
    trust: Array
    ranges: RangeSums
    edges: EdgeRows
    image_rows: tuple[Array, ...]


def linearise(
    scans: StackedScans,
    images: Sequence[StackedImages],
    board: Board,
    state: State,
    trust: Array | None = None,
) -> Terms:
    """Linearise all terms; `trust` (F,) is 1 for each capture by default."""
    return Terms(
        scans,
        tuple(images),
        board,
        state,
        np.ones(scans.n_captures) if trust is None else trust,
        sum_ranges(scans, state),
        edge_rows(scans, board, state),
        tuple(
            image_rows(of_camera, T, state.T_lidar_board, state.z[state.layout.errors(c)])
            for c, (of_camera, T) in enumerate(zip(images, state.T_cam_lidar, strict=True))
        ),
    )


class Products(NamedTuple):
    """Weighted products of rows, for n groups of measurements with independent errors.

    Attributes:
        capture: (n,) of each group.
        place: (n, c) of the rows' columns in [y, z, residual].
        products: (n, c, c).
        log_volume: (n,) log determinant of the errors' covariance.
    """

    capture: Indices
    place: Indices
    products: Array
    log_volume: Array


class Summed(NamedTuple):
    """Products summed over all groups.

    Attributes:
        products: (F, n, n) of [y, z, residual], by the captures' weights.
        log_volume: log determinant of the errors' covariances.
    """

    products: Array
    log_volume: float


class Known(NamedTuple):
    """Priors of the G unknowns shared by all captures.

    Attributes:
        information: (G, G).
        off: (G,) distance of the present values from the priors' means.
        log_volume: log determinant of the covariance.
    """

    information: Array
    off: Array
    log_volume: float


Part = Callable[[Terms, Levels], Iterator[Products]]


def _of_returns(terms: Terms, levels: Levels) -> Iterator[Products]:
    """Weight the returns, by capture and ring."""
    weighted, log_volumes = weigh_ranges(terms.ranges, levels.range_m, levels.ring_m)
    F, L = log_volumes.shape
    place = np.tile(_ring_places(RING, terms.state.layout), (F, 1))
    products = weighted.reshape(F * L, RING.size, RING.size)
    yield Products(np.repeat(np.arange(F), L), place, products, log_volumes.ravel())


def _of_ends(terms: Terms, levels: Levels) -> Iterator[Products]:
    """Weight the ring ends, by capture and ring."""
    group, products = edge_products(terms.edges, levels.edge_rad, levels.backed_rad, levels.lost_share)
    capture, ring = np.divmod(group, terms.state.layout.n_rings)
    yield Products(capture, _ring_places(END, terms.state.layout)[ring], products, np.zeros(len(group)))


def _of_images(terms: Terms, levels: Levels) -> Iterator[Products]:
    """Weight the images, camera by camera."""
    for c, (images, rows) in enumerate(zip(terms.images, terms.image_rows, strict=True)):
        cov = images.total_cov(levels)
        products = np.swapaxes(rows, 1, 2) @ np.linalg.solve(cov, rows)
        place = np.tile(terms.state.layout.image_row(c), (len(rows), 1))
        yield Products(images.capture, place, products, np.linalg.slogdet(cov)[1])


def _of_own_shifts(terms: Terms, levels: Levels) -> Iterator[Products]:
    """Weight the prior of the captures' own shifts: [shift; 1] (shift + value) / sigma."""
    rows = np.stack([np.ones_like(terms.trust), terms.state.own_shift_m], axis=1) / levels.own_shift_m
    F = len(rows)
    place = np.tile(terms.state.layout.row.of(["own_shift", "residual"]), (F, 1))
    log_volume = np.full(F, 2 * np.log(levels.own_shift_m))
    yield Products(np.arange(F), place, rows[:, :, None] * rows[:, None], log_volume)


_PARTS: dict[Part, tuple[str, ...]] = {
    _of_returns: ("range_m", "ring_m"),
    _of_ends: ("edge_rad", "backed_rad", "lost_share"),
    _of_images: OF_IMAGES,
    _of_own_shifts: ("own_shift_m",),
}
"""The levels on which the products of each kind of measurement depend."""


def _ring_places(columns: Columns, layout: Layout) -> Indices:
    """List the indices (L, c) in [y, z, residual] of each ring's columns."""
    laser = dict(zip(LASER, layout.row.of(LASER).reshape(len(LASER), -1), strict=True))
    shape = layout.n_rings, 1
    return np.column_stack(
        [laser[name] if name in laser else np.tile(layout.row.of([name]), shape) for name in columns]
    )


@dataclass(frozen=True, eq=False)
class Reduced:
    """Normal equations with the captures' own unknowns eliminated.

    Attributes:
        cost: quadratic cost of F captures in z, at its present value.
        own_steps: (F, 7, G + 1), y = -own_steps [z; 1].
        of_own: (F, 7, 7) information of the captures' own unknowns alone.
        minus_2_log_evidence: -2 ln p(data | levels) up to a constant, all unknowns integrated out.
        minus_2_log_likelihood: -2 ln p(data, z | levels) at the optimum of z, own unknowns integrated out.
    """

    cost: Quadratics
    own_steps: Array
    of_own: Array
    minus_2_log_evidence: float
    minus_2_log_likelihood: float

    @cached_property
    def gradient(self) -> Array:
        """Gradient (G,) by z, over all captures and priors."""
        return np.asarray(self.cost.gradients.sum(axis=0) + self.cost.prior_gradient)

    @property
    def decrement(self) -> float:
        """Squared length of the step, in standard deviations of all unknowns."""
        z, _ = self.step
        y = self.own_steps[:, :, -1]
        return float(np.einsum("fi,fij,fj", y, self.of_own, y) - self.gradient @ z)

    @cached_property
    def step(self) -> tuple[Array, Array]:
        """Newton step towards the optimum: z (G,) and y (F, 7)."""
        # Priors of constants differ by many orders of magnitude, too many for `Quadratics.optimum`.
        z = np.asarray(-np.linalg.solve(self.cost.information, self.gradient))
        return z, -self.own_steps @ np.append(z, 1.0)

    def second_moments(self, trust: Array) -> Array:
        """Compute the mean (F, 7 + G + 1, 7 + G + 1) of v v^T, v = [y, z, 1], given the data.

        A capture of weight w (`trust`, (F,)) counts as w captures, each with the covariance of y that one of
        full weight has.
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
        moments[:, own, own] += trust[:, None, None] * np.linalg.inv(self.of_own)
        return np.asarray(moments)


def assemble(terms: Terms, levels: Levels, priors: Priors) -> Reduced:
    """Weight all terms, eliminate the captures' own unknowns and add the priors.

    Args:
        terms: linearised terms of F captures.
        levels: noise levels of the terms.
        priors: prior standard deviations of the constant errors.
    """
    return _reduce(terms, sum_products(terms, levels), levels, priors)


@dataclass(frozen=True, eq=False)
class Evidence:
    """-2 ln p(data | levels) as a function of some levels, with its derivatives by their logarithms.

    By a level, it is the mean of v^T dM v over all unknowns given the data, with M the products of
    [y, z, 1] and their priors, and the change of the covariances' log determinants. Only M is differentiated
    by differences.

    Attributes:
        terms: linearised terms of F captures.
        priors: prior standard deviations of the constant errors.
        names: names of the levels that vary.
        others: sum of the products that depend on other levels alone.
    """

    terms: Terms
    priors: Priors
    names: Sequence[str]
    others: Summed

    @classmethod
    def of(cls, terms: Terms, levels: Levels, priors: Priors, names: Sequence[str]) -> "Evidence":
        """Sum the products that depend on none of the named levels, at their present values."""
        fixed = [part for part, of_part in _PARTS.items() if not set(of_part) & set(names)]
        others = _sum(terms, [each for part in fixed for each in part(terms, levels)])
        return cls(terms, priors, names, others)

    def __call__(self, levels: Levels) -> tuple[float, Array]:
        """Compute the value at these levels, and its derivatives."""
        terms, priors = self.terms, self.priors
        part_of = {name: part for part, of_part in _PARTS.items() for name in of_part if name in self.names}
        parts = {part: list(part(terms, levels)) for part in _PARTS if part in part_of.values()}
        varying = _sum(terms, [each for products in parts.values() for each in products])
        summed = Summed(self.others.products + varying.products, self.others.log_volume + varying.log_volume)
        reduced = _reduce(terms, summed, levels, priors)
        moments = reduced.second_moments(terms.trust)
        weighted = moments * terms.trust[:, None, None]
        known = prior_of(terms, levels, priors)
        # All captures have the same z; the mean of the square of its distance from that of the prior.
        z = known.off
        common = slice(OWN.size, -1)
        shift = np.outer(z, moments[0, common, -1])
        squares = moments[0, common, common] + np.outer(z, z) + shift + shift.T
        felt = {part: [weighted[_places(each)] for each in products] for part, products in parts.items()}

        def change(name: str) -> float:
            there = replace(levels, **{name: getattr(levels, name) * np.exp(_LOG_STEP)})
            if name == "laser_m":
                moved = prior_of(terms, there, priors)
                by_prior = float(np.vdot(squares, moved.information - known.information))
                return by_prior + moved.log_volume - known.log_volume
            part, total = part_of[name], 0.0
            for own, here, after in zip(felt[part], parts[part], part(terms, there), strict=True):
                total += float(np.vdot(own, after.products - here.products))
                total += float(terms.trust[here.capture] @ (after.log_volume - here.log_volume))
            return total

        slopes = np.array([change(name) for name in self.names]) / _LOG_STEP
        return reduced.minus_2_log_evidence, slopes


def _places(part: Products) -> tuple[Indices, Indices, Indices]:
    """Index the elements (n, c, c) of products in matrices (F, n, n) of all unknowns."""
    return part.capture[:, None, None], part.place[:, :, None], part.place[:, None, :]


def sum_products(terms: Terms, levels: Levels) -> Summed:
    """Sum the products of all measurements."""
    return _sum(terms, [each for part in _PARTS for each in part(terms, levels)])


def _sum(terms: Terms, parts: Sequence[Products]) -> Summed:
    """Sum the products of some parts."""
    trust, size = terms.trust, terms.state.layout.row.size
    M, log_volume = np.zeros(len(trust) * size**2), 0.0
    for part in parts:
        capture, row, column = _places(part)
        at = (capture * size + row) * size + column
        M += np.bincount(at.ravel(), part.products.ravel(), len(M))
        log_volume += float(trust[part.capture] @ part.log_volume)
    return Summed(M.reshape(-1, size, size) * trust[:, None, None], log_volume)


def _reduce(terms: Terms, summed: Summed, levels: Levels, priors: Priors) -> Reduced:
    """Eliminate the captures' own unknowns and add the priors."""
    return eliminate(summed, terms.trust, OWN.size, prior_of(terms, levels, priors))


def eliminate(summed: Summed, trust: Array, n_own: int, known: Known) -> Reduced:
    """Eliminate the own unknowns of F captures and add the information on the others.

    Args:
        summed: products of rows of n_own own unknowns, G others and the residual.
        trust: (F,) weight of each capture.
        n_own: number of own unknowns of a capture.
        known: levels that do not vary.
    """
    M, log_volume = summed
    own, common = slice(0, n_own), slice(n_own, None)
    of_own, cross = M[:, own, own], M[:, own, common]
    steps = np.linalg.solve(of_own, cross)
    reduced = M[:, common, common] - np.swapaxes(cross, 1, 2) @ steps
    hessians, gradients, costs = reduced[:, :-1, :-1], reduced[:, :-1, -1], reduced[:, -1, -1]
    prior, off = known.information, known.off
    cost = Quadratics(gradients, hessians, prior, prior @ off, np.arange(len(M)))
    information, gradient = cost.information, gradients.sum(axis=0) + cost.prior_gradient
    least = costs.sum() + off @ cost.prior_gradient
    least -= gradient @ np.linalg.solve(information, gradient)
    # Profiled over own unknowns, the likelihood would grow without bound as a noise level falls.
    likelihood = float(least + log_volume + trust @ np.linalg.slogdet(of_own)[1])
    evidence = likelihood + float(np.linalg.slogdet(information)[1]) + known.log_volume
    return Reduced(cost, np.asarray(steps), of_own, evidence, likelihood)


def prior_of(terms: Terms, levels: Levels, priors: Priors) -> Known:
    """Build the priors of the unknowns shared by all captures.

    Range offsets of L rings have the covariance sigma_laser^2 (I - 1 1^T / L) + sigma_offset^2 1 1^T.
    """
    layout, known = terms.state.layout, priors.known
    L = layout.n_rings
    prior, mean = np.zeros((layout.z.size, layout.z.size)), np.zeros(layout.z.size)
    sigmas, log_volume = priors.of_scans, 0.0
    if layout.n_cameras:
        sigmas |= priors.of_print
    for name in layout.z:
        if name.startswith("optics"):
            sigmas[name] = np.full(len(layout.z.of([name])), priors.optics)
    if known is not None:
        mean[layout.z["lens"]], sigmas["lens"] = known.lens, known.lens_sigma
        # Indices of the rings with known errors, among the rings seen and among the known ones.
        _, measured, which = np.intersect1d(terms.scans.rings, known.rings, return_indices=True)
    for name, sigma in sigmas.items():
        at = layout.z.of([name])
        prior[at, at] = sigma**-2.0
    if layout.base is not None:
        at = layout.camera(layout.base)
        prior[at, at] = EXACT**-2.0
    for at in (layout.z.of(sigmas.keys() & _OF_PROFILE), layout.plate):
        # Weights of Student's distribution at the present values.
        prior[at, at] /= 1 + prior[at, at] * terms.state.z[at] ** 2 / priors.freedoms
    of_lasers = ((levels.laser_m, priors.offset_m), (priors.azimuth_rad, 0.0), (priors.elevation_rad, 0.0))
    for k, (at, (each, common)) in enumerate(zip(layout.lasers, of_lasers, strict=True)):
        cov = each**2 * (np.eye(L) - 1 / L)
        if known is not None:
            cov = each**2 * np.eye(L)
            cov[measured, measured] = known.lasers_sigma[k, which] ** 2
            mean[at[measured]] = known.lasers[k, which]
        # The lasers' own errors have zero mean: that of ranges is the common offset, those of angles are part
        # of the extrinsics.
        cov = cov + common**2 + EXACT**2 * np.eye(L)
        prior[at[:, None], at] = np.linalg.inv(cov)
        log_volume += float(np.linalg.slogdet(cov)[1])
    return Known(prior, terms.state.z - mean, log_volume)
