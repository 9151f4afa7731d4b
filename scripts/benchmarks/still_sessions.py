"""Simulated sessions with the board held still: detections in simulated scans, corners drawn from true poses.

Corners of rendered pictures lie within 0.01 px of the truth, better than any lens; drawn ones have the noise
that recordings show, and take no time.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.kept import kept_folder
from lce_rig.calibrate.likelihood.images import stack_images
from lce_rig.calibrate.likelihood.levels import Levels
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Scan
from lce_rig.core.geometry import Array, invert, perturb, transform
from lce_rig.core.planar_pose import solve_planar_pose
from lce_rig.core.results import ImageBoard, LidarBoard, Observation
from lce_rig.detect.detection import from_arrays, to_arrays
from lce_rig.detect.finder import BoardFinder
from lce_rig.detect.image.search import board_from_pose
from lce_rig.rig import Rig
from lce_rig.simulate import SimulationOptions
from lce_rig.simulate.placements import hold_board
from lce_rig.simulate.sampling import StagedBoard
from lce_rig.simulate.stage import PLACEMENT, Stage, set_stage, truth_extrinsics

# The camera's backdrop is not needed: the smaller it is, the sooner it is done.
_SHRINK = 16
_STAMP_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True, eq=False)
class StillSession:
    """One simulated session.

    Attributes:
        T_cam_lidar: (4, 4) the truth.
        T_cam_board: true (4, 4) by capture.
        candidates: of the captures that show the board in both sensors.
    """

    T_cam_lidar: Array
    T_cam_board: dict[str, Array]
    candidates: list[Observation]

    @property
    def places(self) -> dict[str, list[LidarBoard]]:
        """Places of the board in each scan, best first."""
        return {o.capture: [p for p in o.places if isinstance(p, LidarBoard)] for o in self.candidates}


def still_session(
    rig: Rig,
    seed: int,
    options: SimulationOptions,
    n_captures: int,
    sigma_px: float,
    folder: Path,
    levels: Levels | None = None,
) -> StillSession:
    """Read a session's scans from a folder, or simulate them and keep them there; then draw its corners.

    Args:
        rig: of one camera and one LiDAR.
        seed: of everything random.
        options: of the simulation.
        n_captures: placements of the board.
        sigma_px: noise of each corner's coordinates.
        folder: where detections are kept, see `kept_folder`.
        levels: of the errors that corners of one image share; None for none.
    """
    path = kept_folder(folder, rig, options) / f"{n_captures}-{seed:04d}.npz"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_suffix(".part.npz")
        np.savez_compressed(unfinished, **_simulate(rig, seed, options, n_captures))
        unfinished.rename(path)
    with np.load(path) as arrays:
        kept = dict(arrays)
    poses = {key.split("/")[1]: value for key, value in kept.items() if key.startswith("pose/")}
    rng = np.random.default_rng([seed, 2])
    candidates = []
    for name, T_cam_board in poses.items():
        prefix = f"scan/{name}/"
        scan = from_arrays(
            {key[len(prefix) :]: value for key, value in kept.items() if key.startswith(prefix)}
        )
        image = draw_corners(rig, T_cam_board, sigma_px, rng)
        if image is not None and levels is not None:
            images = stack_images(np.zeros(1, dtype=np.intp), [image])
            shared = rng.multivariate_normal(np.zeros(6), (images.total_cov(levels) - images.cov)[0])
            image = draw_corners(rig, perturb(T_cam_board, shared), sigma_px, rng)
        if isinstance(scan, list) and image is not None:
            boards = [board for board in scan if isinstance(board, LidarBoard)]
            candidates.append(Observation.of(name, image, boards))
    return StillSession(kept["truth"], poses, candidates)


def draw_corners(
    rig: Rig,
    T_cam_board: Array,
    sigma_px: float,
    rng: np.random.Generator,
    true_lens: Intrinsics | None = None,
    true_corners: Array | None = None,
) -> ImageBoard | None:
    """Draw a board's corners with noise and solve for its pose as the profile says.

    Args:
        rig: the profile.
        T_cam_board: (4, 4) the truth.
        sigma_px: noise of each coordinate.
        rng: draws it.
        true_lens: where it is another than the profile's.
        true_corners: (M, 3) of the board, where they are others than the profile's.
    """
    lens = next(iter(rig.cameras.values())).to_intrinsics()
    corners = rig.board.to_board().corners()
    seen = corners if true_corners is None else true_corners
    pixels, _ = (true_lens or lens).project(transform(T_cam_board, seen))
    pixels = pixels + sigma_px * rng.standard_normal(pixels.shape)
    solved = solve_planar_pose(pixels, corners, lens)
    return None if solved is None else board_from_pose(pixels, solved)


def _simulate(rig: Rig, seed: int, options: SimulationOptions, n_captures: int) -> dict[str, Any]:
    stage = set_stage(with_small_pictures(rig), seed, options)
    view = stage.views[0]
    arrays: dict[str, Any] = {
        "truth": truth_extrinsics(rig, seed, options)[next(iter(rig.cameras)), next(iter(rig.lidars))]
    }
    for index in range(n_captures):
        rng = stage.rng(index, PLACEMENT)
        T_world_board = stage.place(index, rng)
        scan = scan_held_board(stage, T_world_board, rng, index)
        name = f"{index:06d}"
        arrays[f"pose/{name}"] = invert(view.T_world_cam) @ T_world_board
        found = to_arrays(BoardFinder(rig).scan(scan))
        arrays |= {f"scan/{name}/{key}": value for key, value in found.items()}
    return arrays


def scan_held_board(stage: Stage, T_world_board: Array, rng: np.random.Generator, index: int) -> Scan:
    """Scan a still board at (4, 4); rng determines the carrier's appearance."""
    board = StagedBoard(stage, hold_board(T_world_board), rng)
    return board.take_scan(stage.views[0].lidar, _STAMP_NS + index * 4_000_000_000, (index,))


def with_small_pictures(rig: Rig) -> Rig:
    """Reduce a rig's image size, for sessions without rendering."""
    cameras = {}
    for name, camera in rig.cameras.items():
        lens = camera.intrinsics
        scaled = {key: getattr(lens, key) / _SHRINK for key in ("fx_px", "fy_px", "cx_px", "cy_px")}
        size = tuple(round(length / _SHRINK) for length in camera.resolution_px)
        cameras[name] = camera.model_copy(
            update={"resolution_px": size, "intrinsics": lens.model_copy(update=scaled)}
        )
    return rig.model_copy(update={"cameras": cameras})
