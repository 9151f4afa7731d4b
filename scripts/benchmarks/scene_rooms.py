"""Furnished simulated rooms: sessions with exact truth, in which scene and boards are both seen.

Pictures have half the resolution, which renders in a quarter of the time.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import lce_rig as lce
from benchmarks.furniture import Furniture
from benchmarks.kept import kept_folder
from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import Rig, load_rig
from lce_rig.rig.profile import NominalExtrinsic
from lce_rig.scene.outline_score import OutlineView
from lce_rig.scene.views import build_view, without_board
from lce_rig.session import Session
from lce_rig.simulate import SimulationOptions, simulate_captures, truth_extrinsics

ROOMS = Path("build/rooms")
N_CAPTURES = 10


@dataclass(frozen=True, eq=False)
class FurnishedRoom:
    """A session of one camera and one LiDAR in a room of its own.

    Attributes:
        session: all captures.
        T_cam_lidar: (4, 4) the truth.
    """

    session: Session
    T_cam_lidar: Array

    @property
    def rig(self) -> Rig:
        """The profile, with small pictures."""
        return self.session.rig

    @property
    def camera(self) -> str:
        """The camera's name."""
        return next(iter(self.rig.cameras))

    @property
    def lens(self) -> Intrinsics:
        """The camera's intrinsics."""
        return self.rig.cameras[self.camera].to_intrinsics()

    @cached_property
    def detections(self) -> Detections:
        """The boards of all captures."""
        return lce.detect_boards(self.session, n_threads=1)

    def calibrate(self) -> Calibration:
        """Calibrate on the boards of all captures alone."""
        (calibration,), _ = calibrate_detections(self.rig, self.detections)
        return calibration

    def views(self, calibration: Calibration, *, ignore_board: bool = False) -> list[OutlineView]:
        """Find the edges of all captures, without those at the board if it is to be ignored."""
        views = []
        for capture in self.session.captures:
            image, scan = capture.image(self.camera, "frames"), capture.scan(calibration.lidar)
            view = build_view(self.rig, calibration, capture.name, image, scan)
            if ignore_board:
                found = self.detections.images[self.camera, "frames"][capture.name]
                view = without_board(view, found, self.rig, calibration)
            views.append(view)
        return views


def furnished_room(
    rig_name: str, seed: int, n_captures: int = N_CAPTURES, folder: Path = ROOMS
) -> FurnishedRoom:
    """Read a session from a folder, or simulate it and keep it there.

    Args:
        rig_name: of a shipped profile.
        seed: of room, furniture, truth, placements and noise.
        n_captures: placements of the board.
        folder: of sessions, see `kept_folder`.
    """
    rig, options = _small_rig(rig_name), replace(SimulationOptions.for_rig(rig_name), furnish=Furniture())
    path = kept_folder(folder, rig, options, is_detected=False) / f"{n_captures}-{seed:04d}"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_suffix(".part")
        with Session.create(unfinished, rig) as session:
            for capture in simulate_captures(rig, n_captures=n_captures, seed=seed, options=options):
                session.add_capture(capture.images, capture.scans, {})
        unfinished.rename(path)
    (truth,) = truth_extrinsics(rig, seed, options).values()
    return FurnishedRoom(Session.open(path), truth)


def _small_rig(rig_name: str) -> Rig:
    rig = load_rig(rig_name)
    (name,) = rig.cameras
    camera, lens = rig.cameras[name], rig.cameras[name].intrinsics
    if camera.resolution_px[0] >= 1000:
        scaled = {key: getattr(lens, key) / 2 for key in ("fx_px", "fy_px")}
        scaled |= {key: (getattr(lens, key) - 0.5) / 2 for key in ("cx_px", "cy_px")}
        size = tuple(length // 2 for length in camera.resolution_px)
        camera = camera.model_copy(
            update={"resolution_px": size, "intrinsics": lens.model_copy(update=scaled)}
        )
    changes = {"cameras": {name: camera}, "nominal_extrinsics": rig.nominal_extrinsics or _above(name)}
    return rig.model_copy(update=changes)


def _above(camera: str) -> tuple[NominalExtrinsic, ...]:
    """Mount the LiDAR 0.4 m above a camera that looks along its x axis."""
    return (
        NominalExtrinsic(
            camera=camera,
            lidar="lidar",
            quaternion_wxyz=(0.5, 0.5, -0.5, 0.5),
            translation_m=(0.0, -0.4, -0.05),
            source="typical",
        ),
    )
