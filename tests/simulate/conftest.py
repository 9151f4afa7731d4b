"""Small rigs and scenes that render fast."""

import numpy as np
import pytest

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image
from lce_rig.core.data_sheets import VLP_16
from lce_rig.core.geometry import exp_so3, pose
from lce_rig.rig import Rig
from lce_rig.simulate.backdrop import build_backdrop
from lce_rig.simulate.image_rendering import expose, render_radiance
from lce_rig.simulate.lidar import LidarModel, measure_sweep, sweep_scene
from lce_rig.simulate.options import CameraNoise, EventNoise
from lce_rig.simulate.room import build_room

PERFECT = CameraNoise(blur_px=0.6, full_well_e=np.inf, read_noise_e=0.0, vignetting=0.0)
QUIET_EVENTS = EventNoise(0.30, 0.25, 0.0, 0.0, np.inf, 0.0, 0.0, 0.0, 0.0)
VLP16 = LidarModel.of(VLP_16, 10.0)
FACING_LIDAR = np.array(
    [[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
)  # x right, y up, print towards -x
CAMERA_FORWARD = np.array(
    [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
)  # R_world_cam looking along +x


def make_rig(name="small", **changes):
    """A VLP-16 and a DAVIS-sized camera side by side, with changes."""
    camera = {
        "resolution_px": (346, 260),
        "intrinsics": {
            "fx_px": 305.57, "fy_px": 305.62, "cx_px": 175.21, "cy_px": 125.49,
            "distortion": (-0.3879, 0.2354, 0.00087, -0.00076, -0.1027),
        },
    }  # fmt: skip
    extrinsic = {
        "camera": "cam",
        "lidar": "lidar",
        "quaternion_wxyz": (0.5, 0.5, -0.5, 0.5),
        "translation_m": (0.126, -0.065, -0.080),
    }
    profile = {
        "format_version": 1,
        "name": name,
        "board": {"inner_corners": (9, 6), "square_m": 0.068, "width_m": 0.8, "height_m": 0.6},
        "lidars": {"lidar": {}},
        "cameras": {"cam": camera},
        "nominal_extrinsics": (extrinsic,),
    }
    return Rig.model_validate({**profile, **changes})


def board_before_lidar(distance_m, *, roll_deg=45.0, yaw_deg=0.0):
    """T_world_board (4, 4) of a board at the LiDAR's height, straight ahead, facing it."""
    turn = exp_so3(np.array([[0.0, np.radians(yaw_deg), 0.0], [0.0, 0.0, np.radians(roll_deg)]]))
    return pose(FACING_LIDAR @ turn[0] @ turn[1], np.array([distance_m, 0.0, 1.0]))


@pytest.fixture(scope="session")
def board():
    return Board(cols=9, rows=6, square_m=0.068, width_m=0.8, height_m=0.6)


@pytest.fixture(scope="session")
def room():
    return build_room(0.0, np.random.default_rng(0))


@pytest.fixture(scope="session")
def T_world_lidar():
    return pose(np.eye(3), np.array([0.0, 0.0, 1.0]))


@pytest.fixture(scope="session")
def T_world_cam():
    return pose(CAMERA_FORWARD, np.array([0.05, 0.1, 1.05]))


LENSES = {
    "radtan": Intrinsics(330.0, 331.0, 241.3, 178.2, 480, 360, "radtan", (-0.38, 0.2, 0.001, -0.0005, -0.05)),
    "equidistant": Intrinsics(
        300.0, 301.0, 238.7, 181.4, 480, 360, "equidistant", (-0.05, -0.02, 0.01, -0.002)
    ),
}


@pytest.fixture(scope="session", params=sorted(LENSES))
def backdrop(request, room, T_world_cam):
    return build_backdrop(room, T_world_cam, LENSES[request.param])


def render_image(scene, backdrop, noise, rng):
    return Image("cam", "frames", 0, expose(render_radiance(scene, backdrop), noise, rng))


def simulate_scan(scene, T_world_lidar, model, noise, rng, *, stamp_ns=0, board_at=None, **measured):
    """Simulate one revolution; `measured` goes to `measure_sweep`."""
    sweep = sweep_scene(scene, T_world_lidar, model, noise, rng, stamp_ns, board_at)
    return measure_sweep(sweep, model, noise, rng, stamp_ns=stamp_ns, **measured)
