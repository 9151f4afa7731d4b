"""Joint estimate of all sensors of a rig, from estimates of pairs of sensors.

Pairs provide the captures that agree, the initial guess and the noise levels. In one likelihood each sensor
has one pose, so that loops of poses close, and the errors of a LiDAR or the board affect all its pairs.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lce_rig.calibrate.between_cameras import StereoPair
from lce_rig.calibrate.between_lidars import LidarPair
from lce_rig.calibrate.findings import TWO_PLACES
from lce_rig.calibrate.likelihood.fit import JointEstimate
from lce_rig.calibrate.likelihood.images import StackedImages, stack_images
from lce_rig.calibrate.likelihood.layout import Layout, State
from lce_rig.calibrate.likelihood.levels import OF_IMAGES
from lce_rig.calibrate.likelihood.rays import StackedScans, interior, no_scans, spread, stack_scans
from lce_rig.calibrate.likelihood.rig import RigEstimate, maximise_rig, relate
from lce_rig.calibrate.observations import board_key, group_poses
from lce_rig.calibrate.quadratics import jackknife_scatter
from lce_rig.calibrate.result import CalibrationEstimate, Sensitivity, Start, report, with_parts
from lce_rig.calibrate.session_lens import SessionLens
from lce_rig.calibrate.uncertainty import widen, with_corrected_planes, with_errors, without_lidar
from lce_rig.core.board import Board
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array, invert
from lce_rig.core.results import ImageBoard, LidarBoard, Observation, PatternBoard

# Errors of the profile that displace two cameras against each other.
_OF_CAMERAS = ("square_size", "intrinsics")
SensorPair = tuple[str, str]
"""Names of a camera and a LiDAR, or of two LiDARs."""


@dataclass(frozen=True, eq=False)
class RigResult:
    """Poses of the sensors of a rig.

    Attributes:
        cameras, lidars: their names; the first LiDAR is the base, without LiDARs the first camera.
        estimates: estimate of each given pair; of two LiDARs, in an optical frame at the first.
        joint: the estimate of all.
    """

    cameras: tuple[str, ...]
    lidars: tuple[str, ...]
    estimates: Mapping[SensorPair, CalibrationEstimate]
    joint: RigEstimate

    def on_base(self, sensor: str) -> tuple[Array, Array]:
        """Pose of the base in a sensor's frame (4, 4), and its derivative by the unknowns (6, G)."""
        if sensor in self.lidars:
            return self.joint.lidar(self.lidars.index(sensor))
        return self.joint.camera(self.cameras.index(sensor))

    def between(self, second: str, first: str) -> tuple[Array, Array]:
        """Pose of the first sensor in the second one's frame (4, 4), and its covariance (6, 6)."""
        T, J = relate(self.on_base(second), self.on_base(first))
        return T, np.asarray(J @ self.joint.cov_z @ J.T)


@dataclass(frozen=True, eq=False)
class _Seen:
    """Observations of two sensors in one capture.

    Attributes:
        pair: the sensors.
        capture: the capture's name.
        boards: boards in the scan of each LiDAR.
        image: image of the camera; None for two LiDARs.
    """

    pair: SensorPair
    capture: str
    boards: Mapping[str, LidarBoard]
    image: ImageBoard | None


def estimate_rig(
    cameras: Mapping[SensorPair, CalibrationEstimate],
    between: Mapping[SensorPair, LidarPair | StereoPair],
    board: Board,
    lidars: Sequence[str],
) -> RigResult:
    """Estimate the poses of cameras and LiDARs in one likelihood.

    Captures in which pairs use different surfaces of one scan are rejected.

    Args:
        cameras: estimates by the likelihood of cameras and LiDARs whose boards stood still.
        between: pairs of LiDARs, and of cameras. All pairs together connect all sensors.
        board: the board's specification.
        lidars: names in the order of the profile.
    """
    held = {name for pair in (*cameras, *between) for name in pair}
    of_lidars = tuple(name for name in lidars if name in held)
    of_cameras = tuple(sorted(held - set(of_lidars)))
    known = {camera: _known_of(camera, cameras, between) for camera in of_cameras}
    lenses = {camera: each.lens for camera, each in known.items()}
    seen = list(_list_seen(cameras, between, lenses))
    conflicts = _conflicts(seen)
    frames = _Frames.of([each for each in seen if each.capture not in conflicts], of_cameras, of_lidars)
    bases = of_lidars or of_cameras[:1]
    T_start = _spanning_poses(cameras, between, bases[0])
    T_base_board = frames.place(T_start)
    images, image_levels = _weigh_cameras(
        [frames.stack_images(name, board, lenses[name]) for name in of_cameras], list(known.values())
    )
    scans = [frames.stack_scans(name, board) for name in bases]
    donors = [_donor(name, cameras, between) for name in bases]
    states: list[State] = []
    for name, scan, donor in zip(bases, scans, donors, strict=True):
        T_cam = np.array([T_start[each] for each in of_cameras if not states]).reshape(-1, 4, 4)
        n_optics = [] if states else [each.turns.shape[1] for each in images]
        layout = Layout(n_optics, len(scan.rings), base=None if of_lidars else 0)
        z = donor.state.common_to(layout, donor.terms.scans.rings, scan.rings)
        if states:
            base = states[0]
            z[layout.shape] = base.z[base.layout.shape]
        states.append(State(layout, T_cam, T_start[name] @ T_base_board, np.zeros(frames.n), z))
    joint = maximise_rig(
        scans,
        images,
        board,
        states,
        np.array([T_start[name] for name in bases]),
        [replace(donor.levels, **image_levels) for donor in donors],
        [donor.priors for donor in donors],
        group_poses(T_base_board),
    )
    result = RigResult(of_cameras, of_lidars, {}, joint)
    estimates: dict[SensorPair, CalibrationEstimate] = {}
    for pair, alone in cameras.items():
        start = _without(conflicts, alone.as_start, alone.same_scan)
        T, J = relate(result.on_base(pair[0]), result.on_base(pair[1]))
        c = of_cameras.index(pair[0])
        optics = joint.terms.base.state.layout.optics(c)
        estimates[pair] = replace(
            _report(result, pair[1], start, T, J, board, frames.numbers(start)),
            lens=lenses[pair[0]],
            cov_with_lens=np.asarray(J @ joint.cov_z[:, optics] @ images[c].of_lens),
            joint=alone.joint,
            same_scan=alone.same_scan,
            channels=alone.channels,
            channel_difference=alone.channel_difference,
            association=alone.association,
        )
    for pair, given in between.items():
        start = _without(conflicts, given.start, {})
        T, J = relate(result.on_base(pair[0]), result.on_base(pair[1]))
        if isinstance(given, StereoPair):
            estimates[pair] = replace(
                _report(result, pair[1], start, T, J, board, frames.numbers(start)),
                lens=lenses[pair[0]],
                lens_of_base=lenses[pair[1]],
                joint=(given.joint, 0),
            )
            continue
        J = np.kron(np.eye(2), given.T_view[:3, :3]) @ J
        estimates[pair] = replace(
            _report(result, pair[1], start, given.T_view @ T, J, board, frames.numbers(start), True),
            joint=(given.joint, 0),
        )
    with_names = {
        pair: replace(estimate, estimated_with=tuple(sorted(held - set(pair))))
        for pair, estimate in estimates.items()
    }
    return replace(result, estimates=with_names)


@dataclass(frozen=True, eq=False)
class _Frames:
    """Boards and images of n placements in time: captures with the same scan are merged.

    Attributes:
        n: number of placements.
        of_capture: placement number by capture name.
        boards: boards by LiDAR and placement number.
        images: images by camera and placement number.
    """

    n: int
    of_capture: Mapping[str, int]
    boards: Mapping[str, Mapping[int, LidarBoard]]
    images: Mapping[str, Mapping[int, ImageBoard]]

    @classmethod
    def of(cls, seen: Sequence[_Seen], cameras: Sequence[str], lidars: Sequence[str]) -> "_Frames":
        of_capture = _number_frames(seen)
        boards: dict[str, dict[int, LidarBoard]] = {name: {} for name in lidars}
        images: dict[str, dict[int, ImageBoard]] = {name: {} for name in cameras}
        for each in seen:
            frame = of_capture[each.capture]
            for name, found in each.boards.items():
                boards[name].setdefault(frame, found)
            if each.image is not None:
                images[each.pair[0]].setdefault(frame, each.image)
        return cls(max(of_capture.values()) + 1, of_capture, boards, images)

    def numbers(self, start: Start) -> list[int]:
        """List the numbers of an estimate's captures."""
        return [self.of_capture[o.capture] for o in start.observations]

    def stack_images(self, camera: str, board: Board, lens: SessionLens | None) -> StackedImages:
        """Stack a camera's images."""
        frames = sorted(self.images[camera])
        found = [self.images[camera][frame] for frame in frames]
        return stack_images(np.array(frames), found, board.pattern_offset_m, lens)

    def stack_scans(self, base: str, board: Board) -> StackedScans:
        """Stack a LiDAR's scans; for a camera as the base they have no returns."""
        boards = self.boards.get(base)
        if not boards:
            return no_scans(self.n)
        frames = sorted(boards)
        found = [interior(boards[frame], board) for frame in frames]
        return spread(stack_scans(found, board), np.array(frames), self.n)

    def place(self, T_start: Mapping[str, Array]) -> Array:
        """Place the boards: T_base_board (n, 4, 4), from a camera if one saw the board.

        Args:
            T_start: T_sensor_base (4, 4) of each sensor.
        """
        T = np.zeros((self.n, 4, 4))
        for lidar, of_lidar in self.boards.items():
            for frame, found in of_lidar.items():
                T[frame] = invert(T_start[lidar]) @ found.T_lidar_board
        for camera, of_camera in self.images.items():
            for frame, image in of_camera.items():
                T[frame] = invert(T_start[camera]) @ image.T_cam_board
        return T


def _report(
    result: RigResult,
    second: str,
    start: Start,
    T: Array,
    J: Array,
    board: Board,
    frames: Sequence[int],
    is_of_lidars: bool = False,
) -> CalibrationEstimate:
    """Report a pose T (4, 4) with the derivative J (6, G) as the estimate of a pair."""
    joint, is_of_cameras = result.joint, second not in result.lidars
    m = 0 if is_of_cameras else result.lidars.index(second)
    scatter, constants = (J @ each @ J.T for each in joint.covariances)
    if is_of_lidars:
        constants = constants + joint.of_model(J)
    left_out = jackknife_scatter(joint.left_out @ J.T)
    n_placements = len(np.unique(joint.placement[np.array(frames, dtype=np.intp)]))
    cov, inflation = widen(scatter + constants, left_out, n_placements)
    part, at = joint.terms.parts[m], joint.terms.places[m]
    shift = at[part.state.layout.z["shifts"]][0]
    shift_sigma_m = float(np.sqrt(joint.cov_z[shift, shift]))
    figures = with_errors(start.diagnostics, joint.levels[m], part.state, shift_sigma_m, inflation)
    if result.cameras:
        figures = replace(figures, camera_scale=1.0 - joint.terms.base.state.squares)
    figures = with_parts(figures, scatter, constants)
    moves = tuple(Sensitivity(name, 1.0, (J @ each).T) for name, each in joint.moves.items())
    if is_of_cameras:
        figures = without_lidar(figures)
        moves = tuple(each for each in moves if each.source in _OF_CAMERAS)
    estimate = report(start, T, cov, board, figures)
    if not (is_of_cameras or is_of_lidars):
        estimate = with_corrected_planes(estimate, board, part.scans.rings, part.state)
    return replace(estimate, method="ml", sensitivities=moves)


class _Known(NamedTuple):
    """A camera's lens and image errors by level, from its most informative pair."""

    lens: SessionLens | None
    levels: Mapping[str, float]


def _known_of(
    camera: str,
    cameras: Mapping[SensorPair, CalibrationEstimate],
    between: Mapping[SensorPair, LidarPair | StereoPair],
) -> _Known:
    """Choose the pair of a camera with the most captures, preferably one with a LiDAR."""
    of_lidars = [e for pair, e in cameras.items() if camera in pair]
    if of_lidars:
        main = max(of_lidars, key=lambda e: len(e.used))
        d = main.diagnostics
        tilt_rad, spin_rad = np.radians([d.noise_tilt_deg, d.noise_spin_deg]).tolist()
        values = tilt_rad, spin_rad, d.noise_depth_m, d.noise_across_m
        return _Known(main.lens, dict(zip(OF_IMAGES, values, strict=True)))
    pairs = [
        (len(each.start.observations), pair, each)
        for pair, each in between.items()
        if camera in pair and isinstance(each, StereoPair)
    ]
    _, pair, stereo = max(pairs, key=lambda each: each[0])
    levels = {name: float(getattr(stereo.joint.levels, name)) for name in OF_IMAGES}
    return _Known(stereo.lenses[pair.index(camera)], levels)


def _donor(
    base: str,
    cameras: Mapping[SensorPair, CalibrationEstimate],
    between: Mapping[SensorPair, LidarPair | StereoPair],
) -> JointEstimate:
    """Choose the most informative pair for a LiDAR's, or a base camera's, errors and noise."""
    found = [(len(e.used), e.joint[0]) for (_, name), e in cameras.items() if name == base and e.joint]
    if found:
        return max(found, key=lambda each: each[0])[1]
    alone = [
        given.joint if isinstance(given, StereoPair) else given.alone[pair.index(base)]
        for pair, given in between.items()
        if base in pair
    ]
    return max(alone, key=lambda each: len(each.placement))


def _list_seen(
    cameras: Mapping[SensorPair, CalibrationEstimate],
    between: Mapping[SensorPair, LidarPair | StereoPair],
    lenses: Mapping[str, SessionLens | None],
) -> Iterator[_Seen]:
    """List the observations of each pair in the captures it uses, all with the common lens."""
    for pair, estimate in sorted(cameras.items(), key=lambda each: each[0]):
        observations: Sequence[Observation] = list(estimate.observations.values())
        lens = lenses[pair[0]]
        if lens is not None and lens is not estimate.lens:
            observations = lens.refit(observations)
        for o in observations:
            yield _Seen(pair, o.capture, {pair[1]: o.lidar}, o.image)
    for pair, given in sorted(between.items(), key=lambda each: each[0]):
        if isinstance(given, StereoPair):
            yield from _list_images(pair, given, lenses)
            continue
        for name, both in given.boards.items():
            yield _Seen(pair, name, dict(zip(pair, both, strict=True)), None)


def _list_images(
    pair: SensorPair, given: StereoPair, lenses: Mapping[str, SessionLens | None]
) -> Iterator[_Seen]:
    """List what two cameras saw."""
    observations = given.start.observations
    first = [o.image for o in observations]
    second = [o.surface.image for o in observations if isinstance(o.surface, PatternBoard)]
    for name, images, lens in zip(pair, (first, second), given.lenses, strict=True):
        best = lenses[name]
        found = images if best is None or best is lens else best.refit_images(images)
        for o, image in zip(observations, found, strict=True):
            yield _Seen((name, _other_of(pair, name)), o.capture, {}, image)


def _other_of(pair: SensorPair, name: str) -> str:
    return pair[1] if pair[0] == name else pair[0]


def _conflicts(seen: Sequence[_Seen]) -> dict[str, Refusal]:
    """Find captures in which pairs use different surfaces of one scan."""
    surfaces: dict[tuple[str, str], tuple[_Seen, bytes]] = {}
    conflicts = {}
    for each in seen:
        for lidar, found in each.boards.items():
            key = board_key(found)
            other, held = surfaces.setdefault((each.capture, lidar), (each, key))
            if held != key:
                first, second = _other_of(other.pair, lidar), _other_of(each.pair, lidar)
                conflicts[each.capture] = TWO_PLACES.refusal(first=first, second=second)
    return conflicts


def _number_frames(seen: Sequence[_Seen]) -> dict[str, int]:
    """Number captures from 0; captures with the same LiDAR scan share a number."""
    same: dict[str, str] = {}

    def root(name: str) -> str:
        while same.setdefault(name, name) != name:
            name = same[name]
        return name

    scans: dict[tuple[str, bytes], str] = {}
    for each in seen:
        for lidar, found in each.boards.items():
            first = scans.setdefault((lidar, board_key(found)), each.capture)
            one, other = sorted((root(first), root(each.capture)))
            same[other] = one
    numbers = {name: k for k, name in enumerate(sorted({root(each.capture) for each in seen}))}
    return {each.capture: numbers[root(each.capture)] for each in seen}


def _spanning_poses(
    cameras: Mapping[SensorPair, CalibrationEstimate],
    between: Mapping[SensorPair, LidarPair | StereoPair],
    base: str,
) -> dict[str, Array]:
    """Compose each sensor's T_sensor_base (4, 4) along the pairs with the most captures."""
    edges = [(len(e.used), pair, e.T_cam_lidar) for pair, e in cameras.items()]
    for pair, given in between.items():
        T_first_second = given.start.T_cam_lidar
        if not isinstance(given, StereoPair):
            T_first_second = invert(given.T_view) @ T_first_second
        edges.append((len(given.start.observations), pair, T_first_second))
    edges.sort(key=lambda edge: (-edge[0], edge[1]))
    found = {base: np.eye(4)}
    for _ in edges:
        for _, (first, second), T in edges:
            if (first in found) != (second in found):
                if first in found:
                    found[second] = invert(T) @ found[first]
                else:
                    found[first] = T @ found[second]
                break
    return found


def _weigh_cameras(
    stacked: Sequence[StackedImages], known: Sequence[_Known]
) -> tuple[list[StackedImages], dict[str, float]]:
    """Assign each camera's own image errors: the images, and levels as geometric means over all cameras."""
    if not known:
        return [], {}
    logs = np.log([[each.levels[name] for name in OF_IMAGES] for each in known])
    mean = logs.mean(axis=0)
    scaled = [
        images.with_larger_errors(dict(zip(OF_IMAGES, own, strict=True)))
        for images, own in zip(stacked, np.exp(logs - mean).tolist(), strict=True)
    ]
    return scaled, dict(zip(OF_IMAGES, np.exp(mean).tolist(), strict=True))


def _without(conflicts: Mapping[str, Refusal], own: Start, same_scan: Mapping[str, tuple[str, ...]]) -> Start:
    """Remove captures with conflicts, and captures with the same scan, from a pair."""
    held = [same_scan.get(o.capture, (o.capture,)) for o in own.observations]
    kept = [k for k, names in enumerate(held) if not conflicts.keys() & names]
    mine = {name: why for name, why in conflicts.items() if name in set().union(*held)}
    return Start(
        own.T_cam_lidar,
        own.certificate,
        [own.observations[k] for k in kept],
        {**own.refused, **mine},
        own.held_out_m[kept],
        own.diagnostics,
    )
