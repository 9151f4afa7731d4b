"""The paper's simulated sets: its rig, 30 placements of the board, ten levels of noise on each.

As in the paper, a board is photographed and swept by the LiDAR's beams once, and the ten levels are noise on
what these met. What was detected is kept in a folder, so that every method sees the same boards.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from benchmarks.kept import kept_folder
from lce_rig.core.data_sheets import VLP_16
from lce_rig.core.geometry import Array
from lce_rig.detect.detection import ImageDetection, LidarDetection, from_arrays, to_arrays
from lce_rig.detect.finder import BoardFinder
from lce_rig.rig import Rig, load_rig
from lce_rig.session.durable import load_arrays, store_arrays
from lce_rig.simulate import LidarNoise, SimulationOptions
from lce_rig.simulate.lidar import measure_sweep, sweep_scene
from lce_rig.simulate.placements import hold_board
from lce_rig.simulate.sampling import StagedBoard
from lce_rig.simulate.stage import IMAGE, PLACEMENT, SCAN, Stage, set_stage, truth_extrinsics

#: Range noise by level, m.
RANGE_SIGMA_M = (0.0, 0.008, 0.016, 0.024, 0.032, 0.040, 0.048, 0.060, 0.080, 0.100)
LEVELS = range(1, len(RANGE_SIGMA_M) + 1)
N_CAPTURES = 30
CAMERA, LIDAR = "cam", "lidar"
# The paper's exact extrinsic as its files give it, to five digits.
_ROTATION = ((-0.27068, -0.94215, -0.19768), (0.15218, 0.16088, -0.97517), (0.95056, -0.29404, 0.099833))
_TRANSLATION_M = (0.41853, -0.30504, -0.14758)


def paper_noise(level: int) -> LidarNoise:
    """Give the paper's noise of a level: white on all ranges, and on azimuths near the board's rim."""
    quiet = replace(
        LidarNoise.of(VLP_16), laser_sigma_m=0.0, dark_bias_m=0.0, weak_bias_m=0.0, edge_growth_m=0.0
    )
    # The paper's simulator spreads points at the rim by 0.003 rad times the range, whatever the level.
    return replace(quiet, range_sigma_m=RANGE_SIGMA_M[level - 1], rim_spread_rad=0.0015)


@dataclass(frozen=True, eq=False)
class Placement:
    """One board in both sensors.

    Attributes:
        image: in the picture.
        scans: by level of noise.
    """

    image: ImageDetection
    scans: dict[int, LidarDetection]


@dataclass(frozen=True, eq=False)
class PaperSet:
    """One simulated set at all levels of noise, with the true T_cam_lidar (4, 4)."""

    placements: list[Placement]
    T_cam_lidar: Array


def paper_rig() -> Rig:
    """Build the simulated rig with its sensors where the paper has them."""
    data = load_rig("sss").model_dump()
    data["nominal_extrinsics"] = [
        {"camera": CAMERA, "lidar": LIDAR, "matrix": _ROTATION, "translation_m": _TRANSLATION_M}
    ]
    return Rig.model_validate(data)


def paper_set(folder: Path, seed: int, n_captures: int = N_CAPTURES) -> PaperSet:
    """Simulate a set and detect its boards, or read stored detections.

    Args:
        folder: where detections are kept.
        seed: of placements and noise.
        n_captures: placements.
    """
    maker = _Maker(seed)
    own = kept_folder(folder, maker.rig)
    placements = []
    for index in range(n_captures):
        path = own / f"seed{seed:03d}" / f"{index:06d}.npz"
        placement = _read(path)
        if placement is None:
            placement = maker.place(index)
            store_arrays(path, _flatten(placement))
        placements.append(placement)
    return PaperSet(placements, maker.T_cam_lidar)


class _Maker:
    """Simulates placements; the room is built only where one is missing."""

    def __init__(self, seed: int) -> None:
        self._seed, self.rig = seed, paper_rig()
        # The noise level does not matter: beams hit the same surfaces at all levels.
        self._options = replace(SimulationOptions.for_rig("sss"), lidar=paper_noise(LEVELS[0]))
        self.T_cam_lidar = truth_extrinsics(self.rig, seed, self._options)[CAMERA, LIDAR]

    @cached_property
    def _stage(self) -> Stage:
        return set_stage(self.rig, self._seed, self._options)

    def place(self, index: int) -> Placement:
        """Photograph and sweep a board, and detect it at every level."""
        stage, T_world_lidar = self._stage, self._stage.T_world_sensor[LIDAR]
        T_world_board = stage.place(index, stage.rng(index, PLACEMENT))
        board = StagedBoard(stage, hold_board(T_world_board), stage.rng(index))
        image = board.take_image(CAMERA, 0, (index, IMAGE))
        model = stage.models[LIDAR]
        sweep = sweep_scene(
            board.scene_at(0), T_world_lidar, model, stage.noise[LIDAR], stage.rng(index, SCAN)
        )
        scans = {}
        for level in LEVELS:
            noise = paper_noise(level)
            scan = measure_sweep(sweep, model, noise, stage.rng(index, SCAN, level), sensor=LIDAR)
            scans[level] = BoardFinder(self.rig).scan(scan)
        return Placement(BoardFinder(self.rig).image(image), scans)


def _flatten(placement: Placement) -> dict[str, Array]:
    parts = {"image": placement.image} | {f"scan{level}": scan for level, scan in placement.scans.items()}
    return {f"{name}/{key}": a for name, part in parts.items() for key, a in to_arrays(part).items()}


def _read(path: Path) -> Placement | None:
    """Read a placement; None where it was not kept, or by a detector that found less."""
    kept = load_arrays(path)
    try:
        return None if kept is None else _rebuild(kept)
    except ValueError:
        return None


def _rebuild(kept: dict[str, Array]) -> Placement:
    def part(name: str) -> dict[str, Array]:
        prefix = f"{name}/"
        return {key[len(prefix) :]: a for key, a in kept.items() if key.startswith(prefix)}

    scans = {level: from_arrays(part(f"scan{level}")) for level in LEVELS}
    return Placement(from_arrays(part("image")), scans)  # type: ignore[arg-type]
