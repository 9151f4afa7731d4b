"""Our score of a scene's edges compared with published ones, by one measure.

Each method gives a capture `Evidence`: points, and what each is worth on a pixel. Published methods are
written from their papers' formulas:

- Levinson and Thrun, "Automatic online calibration of cameras and lasers", RSS 2013: depth discontinuities
  times the inverse distance transform of the image's edges.
- Pandey et al., "Automatic extrinsic calibration of vision and lidar by maximizing mutual information",
  J. Field Robotics 2014: mutual information of reflectivity and grey value, smoothed by Silverman's rule.
- Koide et al., "General, single-shot, target-less, and automatic LiDAR-camera extrinsic calibration toolbox",
  ICRA 2023: normalised information distance of equalised reflectivity and grey value, without hidden points.


The same test judges all: an axis has changed if its peak lies three standard deviations away, the larger of
two jackknives with the deployed covariance and the biases of docs/drift.md.
"""

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.stats import rankdata

from benchmarks.recordings import RIGS, SETS, RecordedSet
from benchmarks.tables import print_head, print_row
from lce_rig import pipeline
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import Array, perturb, transform
from lce_rig.detect.finder import BoardFinder
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.scene.alignment import IS_ROTATION
from lce_rig.scene.depth_edges import CHANNELS, DepthEdges, find_depth_edges
from lce_rig.scene.edge_field import build_edge_field
from lce_rig.scene.views import is_apart_from_board
from lce_rig.session import Session

_SETS = (
    *(each for each in SETS if each.name in ("rlfs01", "rlfs02", "acfr_vlp16")),
    RecordedSet("os1_64", str(RIGS / "os1_64.yaml"), (("os1_64", "frames"),)),
)
_PART = 5
_COLUMNS, _ROWS = 8, 3  # parts of the image
_THRESHOLD_SIGMAS = 3.0
_BIAS = np.array([0.005, 0.005, 0.015, *np.radians([0.10, 0.05, 0.15])])
_CHANGES = np.array([0.05, 0.05, 0.05, *np.radians([1.0, 0.5, 1.0])])
_UNIT = np.where(IS_ROTATION, np.degrees(1.0), 1000.0)
_REACH = np.where(IS_ROTATION, np.radians(3.0), 0.3)
_STEPS = np.linspace(-1.0, 1.0, 61)
_RIVAL = np.where(IS_ROTATION, np.radians(1.0), 0.1)
_BESIDE_RAD = 0.05


@dataclass(frozen=True, eq=False)
class Evidence:
    """What one capture offers a method.

    Attributes:
        points: (N, 3) m, frame lidar.
        rate: turns their pixels (N, 2) into the bin (N,) each counts in, and its worth (N,).
    """

    points: Array
    rate: Callable[[Array], tuple[NDArray[np.intp], Array]]

    def select(self, keep: NDArray[np.bool_]) -> "Evidence":
        """Keep the points of a mask (N,)."""
        index = np.flatnonzero(keep)

        def rate(pixels: Array) -> tuple[NDArray[np.intp], Array]:
            all_of_them = np.full((len(keep), 2), np.nan)
            all_of_them[index] = pixels
            bins, worth = self.rate(all_of_them)
            return bins[index], worth[index]

        return Evidence(self.points[index], rate)


@dataclass(frozen=True)
class Method:
    """A score of extrinsics.

    Attributes:
        name: in the table.
        prepare: turns (image, scan, intrinsics, beam, T_cam_lidar) into evidence.
        n_bins: of the sums that the score is made of.
        score: turns sums (..., n_bins) into scores (...); the highest is best.
    """

    name: str
    prepare: Callable[[Image, Scan, Intrinsics, Beam, Array], Evidence]
    n_bins: int
    score: Callable[[Array], Array]


def _sum(sums: Array) -> Array:
    return np.asarray(sums[..., 0])


def _prepare_depth(image: Image, scan: Scan, lens: Intrinsics, beam: Beam, _: Array) -> Evidence:
    edges = find_depth_edges(scan, beam)
    return _of_edges(edges.select(edges.channel == CHANNELS.index("depth")), image, lens)


def _prepare_ours(image: Image, scan: Scan, lens: Intrinsics, beam: Beam, _: Array) -> Evidence:
    return _of_edges(find_depth_edges(scan, beam), image, lens)


def _of_edges(edges: DepthEdges, image: Image, lens: Intrinsics) -> Evidence:
    field = build_edge_field(image.grey, lens.fx_px)

    def rate(pixels: Array) -> tuple[NDArray[np.intp], Array]:
        return np.zeros(len(pixels), dtype=np.intp), edges.weight * field.sample(pixels)

    return Evidence(edges.points, rate)


_IDT_SHARE, _IDT_DECAY = 1 / 3, 0.98  # alpha and gamma of the paper
_IDT_JUMP_M = 0.3


def _prepare_levinson(image: Image, scan: Scan, lens: Intrinsics, beam: Beam, _: Array) -> Evidence:
    grey = image.grey.astype(np.float32)
    edges = np.zeros_like(grey)
    padded = np.pad(grey, 1, mode="edge")
    for row in range(3):
        for column in range(3):
            shifted = padded[row : row + grey.shape[0], column : column + grey.shape[1]]
            np.maximum(edges, np.abs(shifted - grey), out=edges)
    # max E decay^max(|dx|, |dy|), by squares of 1, 2, 4, ... px.
    spread = edges
    for reach_px in (1, 2, 4, 8, 16, 32, 64):
        square = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
        spread = np.maximum(spread, _IDT_DECAY**reach_px * cv2.dilate(spread, square))
    field = _IDT_SHARE * edges + (1 - _IDT_SHARE) * spread

    points = np.asarray(scan.points, dtype=np.float64)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    order = np.lexsort((azimuth, scan.ring))
    points, rings = points[order], np.asarray(scan.ring)[order]
    range_m = np.linalg.norm(points, axis=1)
    step = np.where(np.diff(rings) == 0, np.diff(range_m), 0.0)
    jump = np.maximum(np.append(step, 0.0), np.append(0.0, -step))
    keep = jump > _IDT_JUMP_M
    weight = np.sqrt(jump[keep])

    def rate(pixels: Array) -> tuple[NDArray[np.intp], Array]:
        at = np.where(np.isfinite(pixels), pixels, -1e4).astype(np.float32)
        sampled = cv2.remap(field, at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR, borderValue=0.0)[0]
        return np.zeros(len(at), dtype=np.intp), weight * sampled

    return Evidence(points[keep], rate)


def _is_near(scan: Scan, lens: Intrinsics, T: Array) -> NDArray[np.bool_]:
    """Find the points in the image or close beside it."""
    pixels, _ = lens.project(transform(T, np.asarray(scan.points, dtype=np.float64)))
    return lens.is_inside(pixels, -_BESIDE_RAD * lens.fx_px)


_MI_BINS, _NID_BINS = 32, 16


def _of_pixels(
    grey: NDArray[np.uint8], reflectivity: NDArray[np.intp], n_bins: int
) -> Callable[[Array], tuple[NDArray[np.intp], Array]]:
    """Count pairs of reflectivity (in bins) and grey value."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    height, width = smooth.shape

    def rate(pixels: Array) -> tuple[NDArray[np.intp], Array]:
        at = np.where(np.isfinite(pixels), pixels, -1e4)
        column, row = np.rint(at).astype(np.intp).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        value = smooth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)].astype(np.intp)
        return reflectivity * n_bins + value * n_bins // 256, inside.astype(np.float64)

    return rate


def _prepare_pandey(image: Image, scan: Scan, lens: Intrinsics, beam: Beam, T: Array) -> Evidence:
    scan = scan.select(_is_near(scan, lens, T))
    points = np.asarray(scan.points, dtype=np.float64)
    full = max(float(np.percentile(scan.intensity, 98)), 1e-6)
    level = np.clip(scan.intensity / full * _MI_BINS, 0, _MI_BINS - 1).astype(np.intp)
    return Evidence(points, _of_pixels(image.grey, level, _MI_BINS))


def _prepare_koide(image: Image, scan: Scan, lens: Intrinsics, beam: Beam, T: Array) -> Evidence:
    scan = scan.select(_is_near(scan, lens, T))
    points = np.asarray(scan.points, dtype=np.float64)
    level = (rankdata(scan.intensity, "average") / (len(points) + 1) * _NID_BINS).astype(np.intp)
    keep = ~_is_hidden(points, lens, T)
    return Evidence(points[keep], _of_pixels(image.grey, level[keep], _NID_BINS))


_CELL_RAD = 0.012
_HIDDEN_M, _HIDDEN_SHARE = 0.3, 0.05


def _is_hidden(points: Array, lens: Intrinsics, T: Array) -> NDArray[np.bool_]:
    """Find points that lie behind nearer ones as the camera sees them."""
    p = transform(T, points)
    distance = np.linalg.norm(p, axis=1)
    pixels, _ = lens.project(p)
    ok = lens.is_inside(pixels, -_BESIDE_RAD * lens.fx_px)
    cell = np.floor(np.where(ok[:, None], pixels, 0.0) / (_CELL_RAD * lens.fx_px)).astype(np.intp)
    cell -= cell.min(axis=0)
    nearest = np.full(cell.max(axis=0) + 1, 1e6, dtype=np.float32)
    np.minimum.at(nearest, (cell[ok, 0], cell[ok, 1]), distance[ok].astype(np.float32))
    return ok & (distance > nearest[cell[:, 0], cell[:, 1]] * (1 + _HIDDEN_SHARE) + _HIDDEN_M)


def _entropies(counts: Array, n_bins: int) -> tuple[Array, Array]:
    """Mutual information and joint entropy of histograms (..., n_bins^2)."""
    share = counts / np.maximum(counts.sum(axis=-1, keepdims=True), 1e-12)
    pairs = share.reshape(*share.shape[:-1], n_bins, n_bins)

    def entropy(p: Array) -> Array:
        return np.asarray(-np.sum(p * np.log(np.maximum(p, 1e-12)), axis=-1))

    joint = entropy(share)
    return entropy(pairs.sum(axis=-1)) + entropy(pairs.sum(axis=-2)) - joint, joint


def _mutual_information(counts: Array) -> Array:
    pairs = counts.reshape(*counts.shape[:-1], _MI_BINS, _MI_BINS)
    total = pairs.reshape(-1, _MI_BINS, _MI_BINS).sum(axis=0)
    n = max(total.sum() / max(np.prod(pairs.shape[:-2]), 1), 2.0)
    for axis in (-2, -1):
        marginal = total.sum(axis=-1 if axis == -2 else -2)
        bins = np.arange(_MI_BINS)
        mean = np.average(bins, weights=marginal)
        spread = np.sqrt(np.average((bins - mean) ** 2, weights=marginal))
        pairs = gaussian_filter1d(pairs, max(1.06 * spread * n**-0.2, 0.3), axis=axis, mode="nearest")
    return _entropies(pairs.reshape(counts.shape), _MI_BINS)[0]


def _less_distance(counts: Array) -> Array:
    information, joint = _entropies(counts, _NID_BINS)
    return np.asarray(information / np.maximum(joint, 1e-12) - 1.0)


METHODS = (
    Method("depth edges", _prepare_depth, 1, _sum),
    Method("depth and reflectivity edges", _prepare_ours, 1, _sum),
    Method("Levinson and Thrun 2013", _prepare_levinson, 1, _sum),
    Method("Pandey et al. 2014", _prepare_pandey, _MI_BINS**2, _mutual_information),
    Method("Koide et al. 2023", _prepare_koide, _NID_BINS**2, _less_distance),
)


def add_up(
    evidence: Sequence[Evidence], n_bins: int, lens: Intrinsics, T_cam_lidar: Array, axis: int
) -> NDArray[np.float32]:
    """Sum what the points are worth along one axis, (steps, captures, parts of the image, n_bins)."""
    sums = np.zeros((len(_STEPS), len(evidence), _COLUMNS * _ROWS, n_bins), dtype=np.float32)
    for k, each in enumerate(evidence):
        pixels, _ = lens.project(transform(T_cam_lidar, each.points))
        column = np.clip(np.nan_to_num(pixels[:, 0]) / lens.width_px * _COLUMNS, 0, _COLUMNS - 1)
        row = np.clip(np.nan_to_num(pixels[:, 1]) / lens.height_px * _ROWS, 0, _ROWS - 1)
        part = column.astype(np.intp) * _ROWS + row.astype(np.intp)
        for step, offset in enumerate(_STEPS * _REACH[axis]):
            T = perturb(T_cam_lidar, offset * np.eye(6)[axis])
            pixels, _ = lens.project(transform(T, each.points))
            bins, worth = each.rate(pixels)
            flat = np.bincount(part * n_bins + bins, worth, _COLUMNS * _ROWS * n_bins)
            sums[step, k] = flat.reshape(-1, n_bins)
    return sums


def peaks(scores: Array, axis: int) -> Array:
    """Find the highest point of each column (steps, N), between steps by a parabola."""
    offsets = _STEPS * _REACH[axis]
    index = np.clip(scores.argmax(axis=0), 1, len(offsets) - 2)
    pick = np.arange(scores.shape[1])
    before, at, after = (scores[index + shift, pick] for shift in (-1, 0, 1))
    bend = before - 2 * at + after
    step = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)
    return np.asarray(offsets[index] + np.clip(step, -1, 1) * (offsets[1] - offsets[0]))


def sigma(sums: Array, score: Callable[[Array], Array], axis: int) -> float:
    """The larger of two jackknives of the peak: over the parts of the image, and over the captures."""
    result = 0.0
    for over in (1, 2):  # captures, parts
        by = sums.sum(axis=3 - over)  # (steps, n, bins)
        by = by[:, np.any(by != 0, axis=(0, 2))]
        n = by.shape[1]
        if n < 2:
            continue
        found = peaks(score(by.sum(axis=1, keepdims=True) - by), axis)
        result = max(result, float(np.sqrt((n - 1) / n * np.sum((found - found.mean()) ** 2))))
    return result


def contrast(curve: Array, axis: int) -> float:
    """How much higher the peak is than the best rival 1 deg or 10 cm away, as a share of its height."""
    away = np.abs(_STEPS * _REACH[axis] - peaks(curve[:, None], axis)[0]) > _RIVAL[axis]
    return float((curve.max() - curve[away].max()) / max(curve.max() - np.median(curve), 1e-12))


class _Recorded:
    """A recorded set, its board calibration, and where its images show the board."""

    def __init__(self, recorded: RecordedSet) -> None:
        with tempfile.TemporaryDirectory() as folder:
            recorded.collect(Path(folder) / "session")
            session = Session.open(Path(folder) / "session")
            (self.calibration,) = pipeline.calibrate(session).pairs
            c = self.calibration
            self.rig, lidar = session.rig, session.rig.lidars[c.lidar]
            self.lens = session.rig.cameras[c.camera].to_intrinsics()
            self.beam = Beam(lidar.beam_aperture_m, lidar.beam_divergence_rad)
            self.samples = [(each.image(c.camera, "frames"), each.scan(c.lidar)) for each in session.captures]
            finder = BoardFinder(session.rig)
            self.found = [finder.image(image) for image, _ in self.samples]

    def prepare(self, method: Method, ignore_board: bool) -> tuple[list[Evidence], float]:
        """Prepare all captures: (evidence near the image, ms per capture)."""
        c, evidence = self.calibration, []
        start = time.perf_counter()
        prepared = [
            method.prepare(image, scan, self.lens, self.beam, c.T_cam_lidar) for image, scan in self.samples
        ]
        prepare_ms = 1000 * (time.perf_counter() - start) / len(prepared)
        for each, found in zip(prepared, self.found, strict=True):
            pixels, _ = self.lens.project(transform(c.T_cam_lidar, each.points))
            keep = self.lens.is_inside(pixels, -_BESIDE_RAD * self.lens.fx_px)
            if ignore_board:
                keep &= is_apart_from_board(each.points, found, self.rig, c)
            evidence.append(each.select(keep))
        return evidence, prepare_ms

    def parts(self, n_splits: int) -> list[NDArray[np.intp]]:
        """Split the captures at random into parts of five, several times."""
        rng = np.random.default_rng(0)
        orders = [rng.permutation(len(self.samples)) for _ in range(n_splits)]
        return [
            order[first : first + _PART]
            for order in orders
            for first in range(0, len(order) - _PART + 1, _PART)
        ]


def bench_scene_methods(n_splits: int, only: str = "") -> None:
    """Print the table of docs/benchmarks.md."""
    sets = {each.name: _Recorded(each) for each in _SETS if each.is_there and only in each.name}
    for ignore_board in (False, True):
        print(f"\n### {'Board left out' if ignore_board else 'All'}\n")
        print_head(
            "set", "method", "peak, rotation x, y, z deg", "translation x, y, z mm",
            "rms of parts, deg", "mm", "contrast, rotation", "translation", "parts", "false alarms",
            "1, 0.5, 1 deg seen", "5 cm seen", "prepare, score ms",
        )  # fmt: skip
        for name, own in sets.items():
            for method in METHODS:
                print_row(name, method.name, *_measure(own, method, n_splits, ignore_board))


def _measure(own: _Recorded, method: Method, n_splits: int, ignore_board: bool) -> list[object]:
    """Measure one method on one set: cells of the table."""
    c, parts = own.calibration, own.parts(n_splits)
    evidence, prepare_ms = own.prepare(method, ignore_board)
    sigma_deployed = np.sqrt(np.diag(c.cov))
    peak, rms, height = np.zeros(6), np.zeros(6), np.zeros(6)
    seen, is_false = np.zeros(6, dtype=np.intp), np.zeros(len(parts), dtype=bool)
    start, score_s = time.perf_counter(), 0.0
    for axis in range(6):
        start = time.perf_counter()
        sums = add_up(evidence, method.n_bins, own.lens, c.T_cam_lidar, axis)
        score_s += time.perf_counter() - start
        curve = method.score(sums.sum(axis=(1, 2)))
        peak[axis], height[axis] = peaks(curve[:, None], axis)[0], contrast(curve, axis)
        of_parts = []
        for k, part in enumerate(parts):
            own_sums = sums[:, part]
            found = float(peaks(method.score(own_sums.sum(axis=(1, 2)))[:, None], axis)[0])
            scatter = sigma(own_sums, method.score, axis)
            limit = _THRESHOLD_SIGMAS * np.sqrt(scatter**2 + sigma_deployed[axis] ** 2 + _BIAS[axis] ** 2)
            of_parts.append(found)
            is_false[k] |= abs(found) > limit
            # Along one axis, changed extrinsics have the same curve, moved.
            seen[axis] += sum(abs(found + sign * _CHANGES[axis]) > limit for sign in (-1, 1))
        rms[axis] = np.sqrt(np.mean(np.square(of_parts)))
    score_ms = 1000 * score_s / (6 * len(_STEPS) * len(evidence))

    def figures(values: Array, digits: int) -> str:
        return ", ".join(f"{value:.{digits}f}" for value in values)

    peak, rms = peak * _UNIT, rms * _UNIT
    return [
        figures(peak[3:], 2), figures(peak[:3], 0), figures(rms[3:], 2), figures(rms[:3], 0),
        figures(height[3:], 2), figures(height[:3], 2), len(parts), int(is_false.sum()),
        f"{', '.join(map(str, seen[3:]))} of {2 * len(parts)}", f"{', '.join(map(str, seen[:3]))}",
        f"{prepare_ms:.0f}, {score_ms:.1f}",
    ]  # fmt: skip
