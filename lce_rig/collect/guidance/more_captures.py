"""The captures that a session lacks: how many, and where to hold the board."""

from dataclasses import replace

import numpy as np

from lce_rig.collect.findings import GUIDE_ADD
from lce_rig.collect.guidance.instructions import describe_pose
from lce_rig.collect.guidance.planner import ENOUGH_SHARE, LEANS_DEG, Planner
from lce_rig.collect.guidance.sensor_model import SensorModel, SensorPlace
from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import ProfileError
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array
from lce_rig.rig import Rig

_FEWEST, _MOST = 2, 6
# Boards whose distances differ by this factor or more are near and far ones.
_FAR = 1.4
# A LiDAR beside the camera that looks the same way: people need no more to know where to stand.
_SAME_WAY = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def plan_captures(
    rig: Rig, camera: str, lidar: str, held: Array, calibration: Calibration | None = None
) -> list[Finding]:
    """Plan the captures to add, each where it reduces the uncertainty most after those before it.

    They end when the standard deviations, as the calibration states them now and the model lets them shrink,
    are predicted to meet the profile's target.

    Args:
        rig: the profile.
        camera, lidar: the sensors.
        held: (N, 4, 4) T_cam_board of the captures so far.
        calibration: their result; None where they give none.

    Returns:
        The plan; nothing where the LiDAR's beams are not known, or no new placement is left.
    """
    try:
        model = SensorModel.of(rig, camera, lidar)
    except ProfileError:
        return []
    nominal = rig.nominal(camera, lidar)
    T_cam_lidar = _SAME_WAY if nominal is None else nominal.to_matrix()
    if calibration is not None:
        T_cam_lidar, figures = calibration.T_cam_lidar, calibration.diagnostics
        rms_m = figures.fit_plane_rms_m, figures.fit_edge_rms_m
        if np.isfinite(rms_m).all():
            model = replace(model, errors=model.errors.learned(*rms_m, len(held)))
    planner, wanted, needed = Planner(SensorPlace.upright(model, T_cam_lidar)), held, rig.calibration
    guidance = planner.guide(held)
    # What the calibration states over what the model predicts.
    ratios = np.ones(2)
    if calibration is not None:
        stated = np.array([calibration.sigma_rotation_deg, calibration.sigma_translation_m])
        ratios = np.maximum(stated / [guidance.sigma_rotation_deg, guidance.sigma_translation_m], 1.0)
    is_enough = False
    while guidance.T_cam_board is not None and len(wanted) < len(held) + _MOST and not is_enough:
        wanted = np.concatenate([wanted, guidance.T_cam_board[None]])
        guidance = planner.guide(wanted)
        sigmas = ratios * [guidance.sigma_rotation_deg, guidance.sigma_translation_m]
        is_met = guidance.is_enough if calibration is None else needed.in_targets(*sigmas) <= ENOUGH_SHARE
        is_enough = bool(is_met and len(wanted) >= max(rig.quality.min_captures, len(held) + _FEWEST))
    added = wanted[len(held) :]
    if not len(added):
        return []
    return [GUIDE_ADD(n_captures=len(added), is_enough=is_enough, placements=_describe(planner.view, added))]


def _describe(view: SensorPlace, poses: Array) -> tuple[tuple[int, float, str, tuple[str, ...]], ...]:
    """Describe boards (N, 4, 4) as near ones and far ones.

    Returns:
        Of each group the number, the mean distance in m, its place in the image if that is aside,
        and the tilts, as the person who holds the board has them: where they face.
    """
    ordered = poses[np.argsort(np.linalg.norm(poses[:, :3, 3], axis=1))]
    distance_m = np.linalg.norm(ordered[:, :3, 3], axis=1)
    gaps = distance_m[1:] / distance_m[:-1]
    parts = [ordered]
    if distance_m[-1] >= _FAR * distance_m[0]:
        parts = np.split(ordered, [int(np.argmax(gaps)) + 1])
    return tuple(
        (
            len(part),
            round(float(np.linalg.norm(part[:, :3, 3], axis=1).mean()), 1),
            common_third(view.model.lens, part[:, :3, 3]),
            _sides(view, part),
        )
        for part in parts
    )


def common_third(lens: Intrinsics, centres: Array) -> str:
    """Name the outer third of the image in which all boards are; "" for none.

    Args:
        lens: of the camera.
        centres: (N, 3) of the boards, camera frame, m.
    """
    pixels, _ = lens.project(centres)
    x, y = (pixels / [lens.width_px, lens.height_px]).T
    # The person faces the rig: the image's right is on the left.
    for word, share in (("high", y), ("low", 1 - y), ("on your right", x), ("on your left", 1 - x)):
        if share.max() < 1 / 3:
            return word
    return ""


def _sides(view: SensorPlace, poses: Array) -> tuple[str, ...]:
    """Name the tilts of boards, each once: where they face, as the person who holds them says it."""
    sides: dict[str, None] = {}
    for T_cam_board in poses:
        held = describe_pose(view, T_cam_board)
        leans = {"down": held.tilt_deg, "up": -held.tilt_deg}
        leans |= {"right": held.turn_deg, "left": -held.turn_deg}
        side = max(leans, key=lambda name: leans[name])
        if leans[side] > LEANS_DEG:
            sides[side] = None
    return tuple(sides)
