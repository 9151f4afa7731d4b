"""A board that is carried about in front of a small rig, in a round room; its recording as a bag."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from lce_rig.core.board import Board
from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import Array, exp_so3, invert, pose, transform
from lce_rig.rig import Rig, load_rig, parse_rig

T0_NS = 1_700_000_000 * 10**9
STEP_NS = 100_000_000
MM = 1e-3
# Camera optical axes (x right, y down, z forward) from the LiDAR's (x forward, y left, z up).
T_CAM_LIDAR = pose(np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.05, -0.1, 0.02]))
# Board axes (x right, y up, z to the viewer) for a viewer who looks along x.
FACING = np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])


@dataclass(frozen=True)
class Placement:
    """Where the board is: its centre, frame lidar, and how it is turned from hanging as a diamond."""

    centre_m: tuple[float, float, float]
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def to_pose(self) -> Array:
        diamond = exp_so3(np.radians([0.0, 0.0, 40.0]))
        return pose(exp_so3(np.radians(self.turn_deg)) @ FACING @ diamond, np.array(self.centre_m))

    def towards(self, other: "Placement", fraction: float) -> "Placement":
        mix = [
            tuple((1 - fraction) * np.array(a) + fraction * np.array(b))
            for a, b in ((self.centre_m, other.centre_m), (self.turn_deg, other.turn_deg))
        ]
        return Placement(*mix)


LEFT = Placement((2.2, 0.35, -0.05), (0, 15, 20))
RIGHT = Placement((2.6, -0.3, 0.0), (5, -20, -15))


@pytest.fixture(scope="session")
def rig() -> Rig:
    """The shipped rig at half its resolution and without distortion."""
    from lce_rig.rig import dump_rig

    full = load_rig("rlfs")
    camera = full.cameras["cam"]
    given = camera.intrinsics
    intrinsics = given.model_copy(
        update={
            "fx_px": given.fx_px / 2, "fy_px": given.fy_px / 2,
            "cx_px": given.cx_px / 2, "cy_px": given.cy_px / 2, "distortion": (),
        }
    )  # fmt: skip
    small = camera.model_copy(update={"resolution_px": (640, 360), "intrinsics": intrinsics})
    return parse_rig(dump_rig(full.model_copy(update={"cameras": {"cam": small}})))


class Stage:
    """Renders pictures and scans of the board."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.board: Board = rig.board.to_board()
        # Twice the resolution, averaged, so that edges fall between pixels as a lens lets them.
        self._double_K = np.diag([2, 2, 1]) @ rig.cameras["cam"].to_intrinsics().matrix + [
            [0, 0, 0.5],
            [0, 0, 0.5],
            [0, 0, 0],
        ]
        self._print = _draw_print(self.board)
        azimuth = np.linspace(np.pi, -np.pi, 1800, endpoint=False)
        elevation = np.radians(np.arange(-15, 16, 2))
        grid_a, grid_e = np.meshgrid(azimuth, elevation, indexing="ij")
        cos_e = np.cos(grid_e)
        self._beams = np.stack([cos_e * np.cos(grid_a), cos_e * np.sin(grid_a), np.sin(grid_e)], -1).reshape(
            -1, 3
        )
        self._ring = np.tile(np.arange(16, dtype=np.int16), 1800)
        self._offset_ns = np.repeat(np.arange(1800) * 55_296, 16)

    def image(self, T_lidar_board: Array, stamp_ns: int, seed: int) -> Image:
        T_cam_board = T_CAM_LIDAR @ T_lidar_board
        to_board = np.array([
            [MM, 0, MM / 2 - self.board.width_m / 2], [0, -MM, self.board.height_m / 2 - MM / 2], [0, 0, 1],
        ])  # fmt: skip
        H = self._double_K @ T_cam_board[:3, [0, 1, 3]] @ to_board
        double = cv2.warpPerspective(self._print, H, (1280, 720), flags=cv2.INTER_LINEAR, borderValue=110.0)
        grey = cv2.resize(double, (640, 360), interpolation=cv2.INTER_AREA)
        noise = np.random.default_rng(seed).normal(0, 1.5, grey.shape)
        pixels = np.clip(cv2.GaussianBlur(grey, (0, 0), 0.6) + noise, 0, 255).astype(np.uint8)
        return Image("cam", "frames", stamp_ns, pixels)

    def scan(self, T_lidar_board: Array, stamp_ns: int, seed: int) -> Scan:
        depth = _meet_plate(invert(T_lidar_board), self._beams, self.board)
        wall = 5.0 / np.maximum(np.hypot(self._beams[:, 0], self._beams[:, 1]), 1e-3)
        floor = np.where(self._beams[:, 2] < 0, -1.2 / np.minimum(self._beams[:, 2], -1e-6), np.inf)
        ranges = np.minimum(np.minimum(wall, floor), depth) + np.random.default_rng(seed).normal(
            0, 0.008, len(depth)
        )
        points = (self._beams * ranges[:, None]).astype(np.float32)
        return Scan(
            "lidar", stamp_ns, points, np.full(len(points), 50, np.float32), self._ring, self._offset_ns
        )

    def frames(self, placements: Iterable[Placement], lag_ns: int = 0) -> Iterator[Image | Scan]:
        """One scan and, at its middle plus `lag_ns`, one picture for each placement, at 10 Hz."""
        for k, placement in enumerate(placements):
            T_lidar_board = placement.to_pose()
            stamp_ns = T0_NS + k * STEP_NS
            yield self.scan(T_lidar_board, stamp_ns, seed=2 * k)
            yield self.image(T_lidar_board, stamp_ns + STEP_NS // 2 + lag_ns, seed=2 * k + 1)


def _draw_print(board: Board) -> Array:
    """Draw the plate at a millimetre a pixel."""
    x = (np.arange(round(board.width_m / MM)) + 0.5) * MM - board.width_m / 2
    y = board.height_m / 2 - (np.arange(round(board.height_m / MM)) + 0.5) * MM
    col = np.floor(x / board.square_m + (board.cols + 1) / 2)[None, :]
    row = np.floor((board.rows + 1) / 2 - y / board.square_m)[:, None]
    is_print = (col >= 0) & (col <= board.cols) & (row >= 0) & (row <= board.rows)
    return np.where(is_print & ((col + row) % 2 == 0), 40.0, 210.0)


def _meet_plate(T_board_eye: Array, rays_eye: Array, board: Board) -> Array:
    """Measure each ray's way to the plate; infinite where it passes by."""
    origin, rays = T_board_eye[:3, 3], rays_eye @ T_board_eye[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -origin[2] / rays[:, 2]
    hits = np.abs(origin[:2] + depth[:, None] * rays[:, :2])
    is_hit = (depth > 0) & (hits[:, 0] <= board.width_m / 2) & (hits[:, 1] <= board.height_m / 2)
    return np.where(is_hit, depth, np.inf)


def carry(*stops: tuple[Placement, int], n_moving: int = 5) -> list[Placement]:
    """Stand at each stop for some frames, and move on to the next within `n_moving`."""
    path: list[Placement] = []
    for (here, n_still), (there, _) in zip(stops, [*stops[1:], stops[-1]], strict=True):
        path += [here] * n_still
        if there is not here:
            path += [here.towards(there, (k + 1) / (n_moving + 1)) for k in range(n_moving)]
    return path


@pytest.fixture(scope="session")
def stage(rig: Rig) -> Stage:
    return Stage(rig)


@pytest.fixture(scope="session")
def visit(stage: Stage) -> list[Image | Scan]:
    """The board stands left, is carried to the right, and back to the left."""
    return list(stage.frames(carry((LEFT, 8), (RIGHT, 8), (LEFT, 8), n_moving=4)))


@pytest.fixture(scope="session")
def write_bag() -> Callable[[Path, Iterable[Image | Scan]], Path]:
    """Write pictures and scans as a ROS 1 bag on the profile's topics."""

    def write(path: Path, samples: Iterable[Image | Scan]) -> Path:
        from rosbags.rosbag1 import Writer
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS1_NOETIC)
        with Writer(path) as writer:
            connections: dict[str, Any] = {}
            for sample in samples:
                topic, message = _to_message(sample, store.types)
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
                raw = store.serialize_ros1(message, message.__msgtype__)
                writer.write(connections[topic], sample.stamp_ns + 20_000_000, raw)
        return path

    return write


def _to_message(sample: Image | Scan, types: Any) -> tuple[str, Any]:
    stamp = types["builtin_interfaces/msg/Time"](
        sec=sample.stamp_ns // 10**9, nanosec=sample.stamp_ns % 10**9
    )
    header = types["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id="sensor")
    if isinstance(sample, Image):
        height, width = sample.pixels.shape
        return "/camera/image_raw", types["sensor_msgs/msg/Image"](
            header=header, height=height, width=width, encoding="mono8", is_bigendian=0, step=width,
            data=sample.pixels.ravel(),
        )  # fmt: skip
    columns = {"x": "<f4", "y": "<f4", "z": "<f4", "intensity": "<f4", "ring": "<u2", "time": "<f4"}
    cloud = np.zeros(len(sample.points), dtype=list(columns.items()))
    for k, axis in enumerate("xyz"):
        cloud[axis] = sample.points[:, k]
    cloud["intensity"], cloud["ring"], cloud["time"] = sample.intensity, sample.ring, sample.offset_ns * 1e-9
    field = types["sensor_msgs/msg/PointField"]
    fields = [
        field(name=n, offset=cloud.dtype.fields[n][1], datatype=4 if n == "ring" else 7, count=1)
        for n in columns
    ]
    return "/velodyne_points", types["sensor_msgs/msg/PointCloud2"](
        header=header, height=1, width=len(cloud), fields=fields, is_bigendian=False, point_step=22,
        row_step=22 * len(cloud), data=np.frombuffer(cloud.tobytes(), np.uint8), is_dense=True,
    )  # fmt: skip


@pytest.fixture(scope="session")
def paths() -> dict[str, Any]:
    """Placements and how to string them together, for tests that make their own motion."""
    return {"left": LEFT, "right": RIGHT, "carry": carry, "T_cam_lidar": T_CAM_LIDAR, "transform": transform}
