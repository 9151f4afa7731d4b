"""Find the board in a point cloud without rings: planes grown from neighbouring cells, and the outline."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.data import NO_RING, Scan
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.core.results import LidarBoard, LidarQuality
from lce_rig.detect.findings import (
    LIDAR_MOVED,
    LIDAR_NO_BORDER,
    LIDAR_NO_RETURNS,
    LIDAR_OUT_OF_VIEW,
    LIDAR_TOO_FEW_POINTS,
    LIDAR_TURNED,
)
from lce_rig.detect.lidar.measurement import EDGE_TOLERANCE_M, Beam, fit_plane_to_ranges, median
from lce_rig.detect.lidar.outline import (
    STRIP_M,
    Outline,
    Rays,
    Strips,
    fit_outline,
    measure_smears,
    measure_strips,
    register_rays,
    thin,
)
from lce_rig.detect.lidar.plates import Plates, fit_planes
from lce_rig.detect.lidar.search import (
    LAYER_M,
    STANDARD,
    Limits,
    board_at,
    distinct_boards,
    nearest_plate,
    other_plate,
    too_thick,
)
from lce_rig.detect.lidar.segments import MAX_INCIDENCE_RAD, Floats
from lce_rig.detect.lidar.template import Placement, PlaneView, plane_axes, view_plane

# Cells per short side of the board: 6 cm for a plate of 0.63 m.
_CELLS = 10.0
# Maximum points used of an accumulated point cloud of millions: to find plates, and to measure one.
_MOST_SEARCHED, _MOST_MEASURED = 200_000, 40_000
# Number of returns, or of rays, for a first estimate of plane and outline; the final one uses all.
_ROUGH = 6_000
_MOST_PATCHES = 8
# Maximum sum of |log| of a patch's sides over the board's to be the board, if another patch is found.
_ALIKE = 0.3
_MIN_CELL_POINTS = 6
_SAME_NORMAL = np.cos(np.radians(15.0))
_NOISE_M = 0.012  # maximum noise of a plane's returns, assumed until the cloud's own is measured
_SURROUND_M = 0.25
_MIN_POINTS = 60
# Approximate error of the directions of a rosette's beams, rad.
_DIRECTION_RAD = 7e-4
# Fraction of the plate without returns above which it reaches out of the field of view.
_DARK_SHARE = 0.08
_FOOT_M = 0.15
# Range differences of black and white squares, and of glare, reach centimetres at perpendicular incidence.
_LEAST_TOLERANCE_M, _MOST_TOLERANCE_M, _MOST_THICK_M = 0.02, 0.05, 0.03
# Growth of the outline above which it is that of another plate.
_MOST_GROWTH_M = 0.04
# Cells of the plate for means of returns; their noise is never taken as less than this.
_COARSE_M, _FINE_M, _LEAST_MEAN_M, _MIN_CELL_RETURNS = 0.25, 0.10, 0.002, 3
_TOUCHED_SHARE = 0.2
# Distance beyond a located border from which rays should pass the plate, m.
_CLEAR_M = 0.015
_STRIP_OFF = 4.0
# Maximum blur of a still board's border, m (at most 5 mm on recordings); a wider border is weighted by its
# width.
_MOST_SMEAR_M = 0.008
# Parts, in order of time, to detect that a plate moved, and the limit of their chi2 (6 freedoms, p = 1e-4).
_N_PARTS, _MOVED_CHI2 = 4, 27.9
# Minimum number of located places on vertical and on horizontal edges, and of means on the plate, to fix its
# pose.
_MIN_STRIPS, _MIN_MEANS = 2, 10


def find_unstructured_boards(
    scan: Scan, board: Board, limits: Limits = STANDARD
) -> list[LidarBoard] | Refusal:
    """Find plates of the board's size in a point cloud without rings, best first.

    Args:
        scan: one scan, or several of a still board together.
        board: board, which defines the outer size.
        limits: limits, not including the scan's noise.
    """
    points = np.asarray(scan.points, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        range_m = np.sqrt(np.einsum("ij,ij->i", points, points))
        index = np.flatnonzero((range_m >= limits.min_range_m) & (range_m <= 2.5 * limits.max_range_m + 5))
    if len(index) == 0:
        return LIDAR_NO_RETURNS.refusal(n_points=len(points), min_range_m=limits.min_range_m)
    searched = index[range_m[index] <= limits.max_range_m]
    searched = searched[thin(len(searched), _MOST_SEARCHED)]
    patches = grow_patches(points[searched], min(board.width_m, board.height_m) / _CELLS)
    near = np.column_stack([points, scan.intensity])[index]
    board_m = np.array([max(board.width_m, board.height_m), min(board.width_m, board.height_m)])
    ratio = patches.size_m / board_m
    misfit = np.abs(np.log(np.maximum(ratio, 1e-3))).sum(axis=1)
    can_be = np.flatnonzero((ratio > [0.5, 0.35]).all(axis=1) & (ratio < [2.2, 1.9]).all(axis=1))
    found: list[LidarBoard] = []
    misses: list[Refusal] = []
    for k in can_be[np.argsort(misfit[can_be])][:_MOST_PATCHES]:
        if found and misfit[k] > _ALIKE:
            break
        measured = measure_unstructured(near, board, patches.plane[k], patches.centre[k], limits)
        if isinstance(measured, LidarBoard):
            found.append(measured)
        else:
            misses.append(measured)
    if found:
        return distinct_boards(found, board)
    return misses[0] if misses else nearest_plate(patches, misfit, board, limits)


def _too_few(n_points: int, distance_m: float, min_points: int = _MIN_POINTS) -> Refusal:
    return LIDAR_TOO_FEW_POINTS.refusal(n_points=n_points, min_points=min_points, closer_m=distance_m / 4)


def look_for_unstructured_board(
    scan: Scan, board: Board, T_lidar_board: Array, limits: Limits = STANDARD
) -> LidarBoard | Refusal:
    """Find the board near a predicted pose (4, 4), from an image and extrinsics for example.

    The plates are searched in the cone of rays about the board.
    """
    about = _rays_about(scan.points, T_lidar_board[:3, 3], board)
    nearby = find_unstructured_boards(scan.select(about), board, replace(limits, max_range_m=np.inf))
    return board_at(nearby, T_lidar_board)


def _rays_about(points: Array | Floats, centre: Array, board: Board) -> NDArray[np.bool_]:
    """Find the rays (N,) that pass the board's centre closely enough to locate its border."""
    reach_m = 0.7 * float(np.hypot(board.width_m, board.height_m)) + _SURROUND_M
    squared_cosine = 1.0 / (1.0 + (reach_m / np.linalg.norm(centre)) ** 2)
    along = points @ (centre / np.linalg.norm(centre)).astype(points.dtype)
    squared_m2 = np.einsum("ij,ij->i", points, points)
    return np.asarray((along > 0) & (along**2 > squared_cosine * squared_m2))


def grow_patches(points: Array, cell_m: float) -> Plates:
    """Join neighbouring cells of points (N, 3) that lie in one plane, the largest patch first.

    Each cell's plane is fitted to its points and those of neighbouring cells.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if len(points) < _MIN_POINTS:
        return Plates.none()
    sums = _sum_cells(points, cell_m)
    centres = sums[:, 1:4] / sums[:, :1]
    tree = cKDTree(centres, balanced_tree=False, compact_nodes=False)
    pairs = tree.query_pairs(1.8 * cell_m, output_type="ndarray")
    n_cells = len(centres)
    near = coo_array((np.ones(len(pairs)), pairs.T), shape=(n_cells, n_cells)).tocsr()
    around = np.asarray(near @ sums + near.T @ sums + sums, dtype=np.float64)
    plane, _, eigenvalues = fit_planes(around)
    normal = plane[:, :3]
    flat = (around[:, 0] >= _MIN_CELL_POINTS) & (eigenvalues[:, 1] > (0.35 * cell_m) ** 2)
    flat &= eigenvalues[:, 0] < (2.0 * _NOISE_M) ** 2
    if not flat.any():
        return Plates.none()
    i, j = pairs.take(np.flatnonzero(flat[pairs].all(axis=1)), axis=0).T
    of_i, of_j = normal.take(i, axis=0), normal.take(j, axis=0)
    apart = centres.take(j, axis=0) - centres.take(i, axis=0)
    joined = np.abs(np.einsum("ij,ij->i", of_i, of_j)) > _SAME_NORMAL
    for side in (of_i, of_j):
        joined &= np.abs(np.einsum("ij,ij->i", side, apart)) < 2.5 * _NOISE_M
    graph = coo_array((np.ones(joined.sum()), (i[joined], j[joined])), shape=(n_cells, n_cells))
    n_patches, label = connected_components(graph, directed=False)
    count = np.bincount(label)
    large = np.flatnonzero(count >= 8)
    large = large[np.argsort(-count[large], kind="stable")]
    # Each cell has the same weight: a rosette is densest in its centre.
    alike = sums / sums[:, :1]
    totals = [np.bincount(label, column, n_patches)[large] for column in alike.T]
    return Plates.of(np.array(totals, dtype=np.float64).T, np.zeros(len(large), dtype=np.intp))


def _sum_cells(points: Array, cell_m: float) -> Array:
    """Sum 1, p and p p^T of the points in each voxel: (V, 13)."""
    # Contiguous columns take half the time of rows.
    columns = np.ascontiguousarray(points.T)
    key = np.zeros(len(points), dtype=np.int64)
    for column in columns:
        cell = np.floor(column / cell_m).astype(np.int64)
        cell -= cell.min()
        key *= cell.max() + 1
        key += cell
    order = np.argsort(key)
    key = key[order]
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    x, y, z = columns.take(order, axis=1)
    sums = [np.add.reduceat(of, starts) for of in (x, y, z, x * x, x * y, x * z, y * y, y * z, z * z)]
    count = np.diff(starts, append=len(key)).astype(np.float64)
    return np.stack([count, *(sums[k] for k in (0, 1, 2, 3, 4, 5, 4, 6, 7, 5, 7, 8))], axis=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class _View(PlaneView):
    """The view of a plate in a point cloud without rings.

    Attributes:
        returns: (M, 4) x, y, z, intensity; intensities are all the same if the point cloud has none.
        beam: the LiDAR's beam.
    """

    returns: Array
    beam: Beam

    @property
    def is_far_behind(self) -> NDArray[np.bool_]:
        """Whether rays (M,) return from so far behind the plane that they passed beside the plate."""
        return self.height_m < -_MOST_TOLERANCE_M

    @classmethod
    def of(cls, returns: Array, plane: Array, centre: Array, tolerance_m: float, limits: Limits) -> "_View":
        """Intersect a plane near a point with the rays of returns (N, 4)."""
        among = np.arange(len(returns))
        view = view_plane(returns[:, :3], among, plane, centre, np.inf, tolerance_m)
        return cls(**vars(view), returns=returns[view.member], beam=limits.beam)

    def beam_parts_m(self, normals: Array, uv: Array) -> Array:
        """Split half the beam's width on the plane along unit normals (K, 2) at uv (K, 2) by its two axes.

        The beam's cross-section is an ellipse of half widths a and b; on an oblique plane its footprint is
        elongated. Along a normal m of the plane with normal n it reaches

            h = |diag(a, b) [level, up]^T s|,    s = m - (m . ray) / (n . ray) n                         (1)

        the root of a sum of two squares, whose shares (K, 2) of h are returned.
        """
        at = self.origin + uv @ self.axes.T
        range_m = np.linalg.norm(at, axis=1, keepdims=True)
        ray = at / range_m
        along = normals @ self.axes.T
        turn = np.sum(along * ray, axis=1) / (ray @ self.plane[:3])
        sideways = along - turn[:, None] * self.plane[:3]
        across = np.einsum("ki,kij->kj", sideways, plane_axes(ray))
        squares = (across * self.beam.widths_m(range_m) / 2) ** 2
        return np.asarray(squares / np.sqrt(np.maximum(squares.sum(axis=1, keepdims=True), 1e-18)))

    def half_beam_m(self, normals: Array) -> Array:
        """Compute half the beam's width along unit normals (K, 2) of the plane, at the origin."""
        return np.asarray(self.beam_parts_m(normals, np.zeros_like(normals)).sum(axis=1))

    def blur_m(self, normals: Array) -> Array:
        """Compute the border's blur for unit normals (K, 2): a quarter of the beam, noise of directions."""
        distance_m = float(np.linalg.norm(self.origin))
        return np.asarray(np.hypot(self.half_beam_m(normals) / 2, _DIRECTION_RAD * distance_m))

    def growth_m(self, placement: Placement) -> tuple[Array, float]:
        """Predict the excess of half width and half height of a plate (2,), and its standard deviation, m."""
        expected = self.half_beam_m(placement.axes)
        return expected, float(expected.max()) / 2 + 0.005

    def rays(self, half_m: tuple[float, float], placement: Placement | None = None) -> Rays:
        """Separate rays that return from the plate from those that pass beside it.

        Rays that return from before the plane, or just behind it where echoes of plate and background blend,
        are skipped, except that a stand or a touching object ends the plate. Places without any return count
        as passed, unless they lie on a first placement.

        Args:
            half_m: half width and half height of the plate.
            placement: its rough placement; None if only its middle is known.
        """
        is_on = self.is_on
        is_beside = self.is_far_behind
        n_on, radius_m = int(np.count_nonzero(is_on)), float(np.hypot(*half_m))
        area = placement or Placement(0.0, 0.0, 0.0, (radius_m, radius_m))
        n_due = n_on * float(np.prod(area.half_m) / np.prod(half_m))
        empty, _ = _empty_places(self.uv, area, n_due)
        if placement is not None:
            empty = empty[placement.distance_m(empty) > 0]
            is_foot = (self.height_m > self.tolerance_m) & (self.height_m < _FOOT_M)
            is_beside |= is_foot & (placement.distance_m(self.uv) > -0.01)
        uv = np.concatenate([self.uv[is_on], self.uv[is_beside], empty])
        return Rays(uv, np.arange(len(uv)) < n_on)


def _empty_places(uv: Array, placement: Placement, n_due: float) -> tuple[Array, float]:
    """List cells (K, 2) in and near a placement without rays, themselves and neighbours; and their size.

    Cells are large enough that four returns are expected in each.
    """
    from scipy.ndimage import maximum_filter

    half = np.array(placement.half_m)
    cell_m = max(2 * float(np.sqrt(4 * half.prod() / max(n_due, 1.0))), 0.01)
    n = np.ceil(2 * (half + 0.12) / cell_m).astype(np.intp)
    cell = np.floor(placement.local(uv) / cell_m + n / 2).astype(np.intp)
    cell = cell[((cell >= 0) & (cell < n)).all(axis=1)]
    is_hit = np.bincount(cell[:, 0] * n[1] + cell[:, 1], minlength=int(n.prod())).reshape(n) > 0
    empty = np.argwhere(~maximum_filter(is_hit, 3))
    at = ((empty + 0.5 - n / 2) * cell_m) @ placement.axes
    return at + [placement.u_m, placement.v_m], cell_m


def measure_unstructured(
    returns: Array, board: Board, plane: Array, centre: Array, limits: Limits
) -> LidarBoard | Refusal:
    """Fit plane and outline to the rays near a patch, measure the board and check it against the limits.

    Args:
        returns: (N, 4) x, y, z, intensity.
        board: nominal size.
        plane: (4,) first guess.
        centre: (3,) m, near the plate's middle.
        limits: limits, not including the scan's noise.
    """
    distance_m = float(np.linalg.norm(centre))
    if plane[3] < np.cos(MAX_INCIDENCE_RAD) * distance_m:
        return LIDAR_TURNED.refusal(max_turn_deg=float(np.degrees(MAX_INCIDENCE_RAD)), distance_m=distance_m)
    half_m = (board.width_m / 2, board.height_m / 2)
    returns = returns[_rays_about(returns[:, :3], centre, board)]
    returns = returns[thin(len(returns), _MOST_MEASURED)]
    view = _View.of(returns[thin(len(returns), _ROUGH)], plane, centre, 4 * _NOISE_M, limits)
    n_on = int(np.count_nonzero(view.is_on))
    starts = register_rays(view.rays(half_m), half_m) if n_on >= _MIN_POINTS else []
    if not starts:
        return _too_few(n_on, distance_m)
    outline: Outline | None = None
    for _ in range(2):
        rays = view.rays(half_m, starts[0])
        rays = rays.select(thin(len(rays.uv), _ROUGH))
        fits = (fit_outline(rays, start, view.blur_m, view.growth_m(start)) for start in starts)
        outline = min((fit for fit in fits if fit), key=lambda fit: fit.placement.error_m, default=None)
        inside = np.zeros(0) if outline is None else view.is_on & (outline.placement.distance_m(view.uv) < 0)
        if outline is None or np.count_nonzero(inside) < _MIN_POINTS:
            return _too_few(int(np.count_nonzero(inside)), distance_m)
        on_plate = view.returns[:, :3][inside]
        plane, spread_m = fit_plane_to_ranges(on_plate, view.plane, distance_m)
        tolerance_m = min(max(3.5 * spread_m, _LEAST_TOLERANCE_M), _MOST_TOLERANCE_M)
        centre = view.origin + view.axes @ [outline.placement.u_m, outline.placement.v_m]
        view = _View.of(returns, plane, centre, tolerance_m, limits)
        starts = [replace(outline.placement, u_m=0.0, v_m=0.0)]
    outline = fit_outline(view.rays(half_m, starts[0]), starts[0], view.blur_m, view.growth_m(starts[0]))
    if outline is None:
        return _too_few(0, distance_m)
    return _describe(view, board, outline)


def _describe(view: _View, board: Board, outline: Outline) -> LidarBoard | Refusal:
    """Check the returns inside a fitted outline and compute the board's figures."""
    placement = outline.placement
    distance_m = float(np.linalg.norm(view.origin))
    away = placement.distance_m(view.uv)
    is_board = view.is_on & (away <= 0)
    n_on = int(np.count_nonzero(is_board))
    margin_m = 0.02 + float(outline.growth_m.max())
    deep = away < -margin_m
    beyond = float(np.count_nonzero(view.is_on & (away > margin_m) & (away < 0.15))) / max(n_on, 1)
    dark, cell_m = _empty_places(view.uv, placement, n_on)
    # A cell at the rim is dark only if its neighbours are, so the share counts the hidden part of it.
    n_dark = np.count_nonzero(placement.distance_m(dark) < 0)
    dark_share = n_dark * cell_m**2 / (board.width_m * board.height_m)
    sheet = view.height_m[deep & (np.abs(view.height_m) < LAYER_M)]
    rms_m = float(np.sqrt(np.mean(sheet**2))) if len(sheet) else 0.0
    if np.abs(outline.growth_m - view.growth_m(placement)[0]).max() > _MOST_GROWTH_M:
        size_m = np.array([board.width_m, board.height_m]) + 2 * outline.growth_m
        return other_plate(size_m, distance_m, board)
    if rms_m > _MOST_THICK_M:
        return too_thick(sheet, _MOST_THICK_M)
    if dark_share > _DARK_SHARE:
        return LIDAR_OUT_OF_VIEW.refusal(distance_m=distance_m, share=float(dark_share))
    rays = view.rays(placement.half_m, placement)
    strips = measure_strips(rays, outline, view.blur_m, np.zeros(4))
    is_touched, *_ = _look_beyond(view, strips, placement)
    smears_m = measure_smears(_beside(rays, strips, is_touched), outline, view.blur_m)
    smears_m[smears_m <= _MOST_SMEAR_M] = 0.0
    if smears_m.any():
        moved_m = _measure_motion(view, outline, smears_m)
        if moved_m is not None:
            return LIDAR_MOVED.refusal(distance_m=distance_m, moved_m=moved_m)
        strips = measure_strips(rays, outline, view.blur_m, smears_m)
    # Something touches or hides a strip that deviates from its neighbours.
    strip_smear_m = smears_m[strips.side]
    is_good = (strips.sigma_m < np.hypot(EDGE_TOLERANCE_M, strip_smear_m)) & (
        np.abs(strips.off_m) < np.hypot(_STRIP_OFF * strips.sigma_m, 0.015)
    )
    is_touched, behind_m, echo = _look_beyond(view, strips, placement)
    is_good &= ~is_touched
    # Vertical edges locate the plate along its width, horizontal ones along its height: both are needed.
    is_upright = np.abs(strips.outwards[is_good] @ placement.axes[0]) > np.sqrt(0.5)
    n_upright, n_level = int(np.count_nonzero(is_upright)), int(np.count_nonzero(~is_upright))
    if min(n_upright, n_level) < _MIN_STRIPS:
        return LIDAR_NO_BORDER.refusal(distance_m=distance_m, n_upright=n_upright, n_level=n_level)
    edge_rms_m = float(np.sqrt(np.mean(strips.off_m[is_good] ** 2)))
    growth, size_sigma = outline.growth_m, 2 * np.sqrt(np.diag(outline.cov)[3:])
    sigma_m = np.hypot(size_sigma, view.beam.widths_m(distance_m).max() / 2)
    points, point_sigma_m = _average(
        view.returns[:, :3][is_board], placement.local(view.uv[is_board]), view.plane
    )
    if len(points) < _MIN_MEANS:
        n_needed = int(np.ceil(_MIN_CELL_RETURNS * board.width_m * board.height_m / _FINE_M**2))
        return _too_few(n_on, distance_m, n_needed)
    size_m = np.array([board.width_m, board.height_m]) + 2 * (growth - view.growth_m(placement)[0])
    quality = LidarQuality(
        width_m=float(size_m[0]),
        height_m=float(size_m[1]),
        width_sigma_m=float(sigma_m[0]),
        height_sigma_m=float(sigma_m[1]),
        n_rings=0,
        n_points=n_on,
        n_ring_ends=int(np.count_nonzero(is_good)),
        n_ring_ends_dropped=int(np.count_nonzero(~is_good)),
        plane_rms_m=rms_m,
        edge_rms_m=edge_rms_m,
        template_m=edge_rms_m,
        beyond_share=beyond,
        distance_m=distance_m,
    )
    beam_m = view.beam_parts_m(strips.outwards, strips.uv)
    inwards = beam_m.sum(axis=1)[:, None] * strips.outwards
    edge = view.origin + (strips.uv - inwards)[is_good] @ view.axes.T
    # The errors of a side's strips may be equal, so together they count as one place of their width.
    n_of_side = np.bincount(strips.side[is_good], minlength=4)[strips.side[is_good]]
    edge_sigma_m = strip_smear_m[is_good] * np.sqrt(n_of_side)
    return LidarBoard(
        points=points,
        ring=np.full(len(points), NO_RING, dtype=np.int16),
        edge_points=edge,
        edge_ring=np.full(len(edge), NO_RING, dtype=np.int16),
        edge_side=np.zeros(len(edge), dtype=np.int8),
        edge_behind_m=behind_m[is_good],
        edge_echo=echo[is_good],
        edge_beam_m=beam_m[is_good],
        azimuth_step_rad=0.0,
        plane=view.plane,
        sigma_m=point_sigma_m,
        T_lidar_board=view.pose_of(placement),
        quality=quality,
        edge_sigma_m=edge_sigma_m if edge_sigma_m.any() else None,
    )


def _beside(rays: Rays, strips: Strips, is_touched: NDArray[np.bool_]) -> Rays:
    """Exclude the rays nearest to a border strip (K,) that something touches."""
    from scipy.spatial import cKDTree

    if not is_touched.any():
        return rays
    return rays.select(~is_touched[cKDTree(strips.uv).query(rays.uv)[1]])


def _measure_motion(view: _View, outline: Outline, smears_m: Array) -> float | None:
    """Measure the plate's motion in its plane during accumulation, m; None if it did not move.

    Points come in order of time: the outline is fitted to the rays of each quarter.

    Args:
        view: the plate's plane and beams.
        outline: fitted to all rays.
        smears_m: (4,) of its sides.
    """
    placement = outline.placement
    smear_m = float(smears_m.max())
    growth = (outline.growth_m, 1e-3)
    places, covs = [], []
    for rows in np.array_split(np.arange(len(view.uv)), _N_PARTS):
        part = replace(
            view,
            member=view.member[rows],
            uv=view.uv[rows],
            height_m=view.height_m[rows],
            returns=view.returns[rows],
        )
        fit = fit_outline(
            part.rays(placement.half_m, placement),
            placement,
            lambda axes: np.hypot(view.blur_m(axes), smear_m),
            growth,
        )
        if fit is not None:
            places.append([fit.placement.u_m, fit.placement.v_m])
            covs.append(fit.cov[:2, :2])
    if len(places) < _N_PARTS:
        return None
    away = np.array(places) - np.mean(places, axis=0)
    chi2 = float(np.einsum("ki,kij,kj", away, np.linalg.inv(covs), away))
    if chi2 < _MOVED_CHI2:
        return None
    return float(np.linalg.norm(np.ptp(places, axis=0)))


def _look_beyond(view: _View, strips: Strips, placement: Placement) -> tuple[NDArray[np.bool_], Array, Array]:
    """Examine the returns beyond each strip of the border (K,).

    Returns:
        Whether a hand, a box or the like hides it; `edge_behind_m` and `edge_echo` of `LidarBoard`.
    """
    from scipy.spatial import cKDTree

    behind_m, echo = np.full(len(strips.uv), np.inf), np.zeros(len(strips.uv))
    is_touched = np.zeros(len(strips.uv), dtype=np.bool_)
    # The power received falls with the square of the range.
    power = np.maximum(view.returns[:, 3], 1e-9) / (view.returns[:, :3] ** 2).sum(axis=1)
    away = placement.distance_m(view.uv)
    of_plate = float(np.median(power[view.is_on & (away < -0.01) & (away > -STRIP_M)]))
    beyond = strips.uv + strips.outwards * STRIP_M / 2
    for k, members in enumerate(cKDTree(view.uv).query_ball_point(beyond, STRIP_M / 2)):
        height_m = view.height_m[members]
        # Rays that pass a plate show its border. An object before the border hides it; the floor, or a stand
        # in its plane, leaves the border's place open.
        is_clear = (view.uv[members] - strips.uv[k]) @ strips.outwards[k] > _CLEAR_M
        is_behind = view.is_far_behind[members]
        is_touched[k] = np.count_nonzero(~is_behind & is_clear) > _TOUCHED_SHARE * np.count_nonzero(is_clear)
        if np.count_nonzero(is_behind) > _TOUCHED_SHARE * len(members):
            behind_m[k] = -median(height_m[is_behind])
            of_background = median(power[members][is_behind])
            echo[k] = of_background / (of_background + of_plate)
    return is_touched, behind_m, echo


def _average(points: Array, local: Array, plane: Array) -> tuple[Array, float]:
    """Average the returns in cells of the plate; also return the effective noise of one mean.

    Errors of neighbouring returns are similar: they follow the squares, glare and incidence. The means in
    coarse cells are nearly independent; their scatter is scaled to the number of fine cells.

    Args:
        points: (N, 3) of the plate.
        local: (N, 2) in its axes, m.
        plane: (4,) fitted to them.
    """
    sigmas = []
    for cell_m in (_COARSE_M, _FINE_M):
        cells = np.floor(local / cell_m).astype(np.int64)
        cells -= cells.min(axis=0)
        _, cell = np.unique(cells[:, 0] * 1000 + cells[:, 1], return_inverse=True)
        count = np.bincount(cell)
        is_full = count >= max(_MIN_CELL_RETURNS, 0.2 * float(np.median(count)))
        means = np.stack([np.bincount(cell, column)[is_full] / count[is_full] for column in points.T], axis=1)
        height = means @ plane[:3] + plane[3]
        freedom = max(len(height) - 3, 1)
        sigmas.append((len(height), float(np.sqrt(height @ height / freedom))))
    (n_coarse, coarse_m), (n_fine, fine_m) = sigmas
    return means, max(coarse_m * np.sqrt(n_fine / max(n_coarse, 1)), fine_m, _LEAST_MEAN_M)
