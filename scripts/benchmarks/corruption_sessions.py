"""Whole sessions for the study of corruptions: images, scans and profile, simulated or recorded.

What is corrupted here are the samples themselves, so that detectors have their say as well.
"""

import tempfile
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from benchmarks.corruption_causes import LENS, NOTHING, RANGE_OFFSET, Codes
from benchmarks.recordings import RecordedSet
from lce_rig.calibrate import CalibrateOptions
from lce_rig.core.calibration import Calibration, Method
from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import ProfileError, refusal_of
from lce_rig.core.geometry import Array, exp_so3, perturb, pose
from lce_rig.detect.detection import Detections, ImageDetection
from lce_rig.detect.finder import BoardFinder
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import Rig, load_rig
from lce_rig.session import Session
from lce_rig.simulate import SimulatedCapture, SimulationOptions, simulate_captures, truth_extrinsics
from lce_rig.simulate.sampling import capture_at
from lce_rig.simulate.stage import PLACEMENT, Stage, set_stage

SEED = 0
N_CAPTURES, N_PARALLEL, N_IN_ONE_PLACE = 15, 12, 12
_N_PLACES = 4000
PARALLEL, ONE_PLACE = "parallel", "one place"
# How late the timestamps of a moving board's images are, s.
LATE_S = (0.02, 0.05, 0.1, 0.3)
# Further streams of random numbers; the simulation itself uses the lower ones.
_PARALLEL, _ONE_PLACE = 90, 91
# Captures of boards that are placed otherwise have noise of their own.
_FIRST_PARALLEL, _FIRST_IN_ONE_PLACE = 1000, 2000
# Recordings with approximate or unfit intrinsics, or with long ranges, as published.
_FAULTS: Mapping[str, Codes] = {
    "os1_64": LENS,
    "os1_gen1": RANGE_OFFSET,
    "vlp16_tilted": LENS,
    "vlp32c_left": LENS,
    "vlp32c_right": LENS,
}
# Motion of a board held as still as possible by hand.
_JITTER_M, _JITTER_RAD = 0.01, np.radians(1.0)


def rig_with_drawing(name: str) -> Rig:
    """Load a shipped profile and add nominal extrinsics, as if from a CAD model."""
    rig = load_rig(name)
    drawn = tuple(entry.model_copy(update={"source": "cad"}) for entry in rig.nominal_extrinsics)
    return rig.model_copy(update={"nominal_extrinsics": drawn})


@dataclass(frozen=True, eq=False)
class Samples:
    """A session of one camera channel and one LiDAR in memory.

    Attributes:
        name: of the session.
        rig: the profile.
        images: by capture.
        scans: by capture.
        T_cam_lidar: (4, 4) the truth; None where nobody knows it.
        T_lidar_moved: (4, 4) p_lidar = T p_moved: where the LiDAR went while the session was taken. The truth
            that an error counts against is T_cam_lidar @ T_lidar_moved.
        variants: sessions of the same rig in which boards were shown otherwise, by name.
        faults: codes of the causes that are true of the session as it was recorded.
    """

    name: str
    rig: Rig
    images: Mapping[str, Image]
    scans: Mapping[str, Scan]
    T_cam_lidar: Array | None = None
    T_lidar_moved: Array = field(default_factory=lambda: np.eye(4))
    variants: Mapping[str, "Samples"] = field(default_factory=dict)
    faults: Codes = NOTHING

    @property
    def captures(self) -> list[str]:
        """Names of the captures, sorted."""
        return sorted(self.images)


def calibrate_by(rig: Rig, found: Detections, method: Method) -> Calibration:
    """Calibrate the one camera and LiDAR of a session."""
    calibration, *_ = calibrate_detections(rig, found, CalibrateOptions(method=method))[0]
    return calibration


def some_of(found: Detections, names: Collection[str]) -> Detections:
    """Select the detections of some captures."""
    images = {key: {n: each for n, each in held.items() if n in names} for key, held in found.images.items()}
    lidars = {key: {n: each for n, each in held.items() if n in names} for key, held in found.lidars.items()}
    return Detections(images, lidars)


def late(offset_s: float) -> str:
    """Name the variant in which a board moves and images are late."""
    return f"{1000 * offset_s:.0f} ms late"


def simulated_samples(rig_name: str, seed: int = SEED, n_captures: int = N_CAPTURES) -> Samples:
    """Simulate a session of still boards, and its variants.

    Args:
        rig_name: of a shipped profile with one camera and one LiDAR.
        seed: of everything random.
        n_captures: of the session, and of its variants with moving boards.
    """
    rig = rig_with_drawing(rig_name)
    options = SimulationOptions.for_rig(rig.name)
    stage = set_stage(rig, seed, options)
    truth = truth_extrinsics(rig, seed, options)[next(iter(rig.cameras)), next(iter(rig.lidars))]
    plain = _gather(rig, truth, (_placed(stage, index) for index in range(n_captures)))
    variants = {
        PARALLEL: _gather(rig, truth, _facing_one_way(stage)),
        ONE_PLACE: _gather(rig, truth, _in_one_place(stage)),
    }
    if rig.cameras[next(iter(rig.cameras))].first_channel("events"):
        for offset_s in LATE_S:
            moving = replace(SimulationOptions.for_rig(rig.name, "moving"), frame_offset_s=offset_s)
            captures = simulate_captures(_frames_only(rig), n_captures=n_captures, seed=seed, options=moving)
            variants[late(offset_s)] = _gather(rig, truth, captures)
    return replace(plain, variants=variants)


def recorded_samples(recorded: RecordedSet) -> Samples:
    """Read a recorded set of one camera channel and one LiDAR, collected as a user would."""
    with tempfile.TemporaryDirectory() as scratch:
        recorded.collect(Path(scratch) / "session")
        session = Session.open(Path(scratch) / "session")
        (channel,) = (channel for _, channel in recorded.folders)
        camera, lidar = next(iter(session.rig.cameras)), next(iter(session.rig.lidars))
        captures = session.captures
        images = {capture.name: capture.image(camera, channel) for capture in captures}
        scans = {capture.name: capture.scan(lidar) for capture in captures}
        faults = _FAULTS.get(recorded.name, NOTHING)
        return Samples(recorded.name, session.rig, images, scans, faults=faults)


class Detector:
    """Finds boards as `pipeline.detect` does, and remembers those of a session's own samples.

    Args:
        samples: the session; where its profile is another one, samples are looked at again.
    """

    def __init__(self, samples: Samples) -> None:
        self._rig = samples.rig
        self._images = {image: _see(samples.rig, image) for image in samples.images.values()}
        self._scans = {scan: BoardFinder(samples.rig).scan(scan) for scan in samples.scans.values()}

    def detect(self, samples: Samples) -> Detections:
        """Find the board in every sample."""
        rig = samples.rig
        is_own_board = rig.board == self._rig.board
        known_images = self._images if is_own_board and rig.cameras == self._rig.cameras else {}
        known_scans = self._scans if is_own_board else {}
        images = {name: known_images.get(each) or _see(rig, each) for name, each in samples.images.items()}
        scans = {
            name: known_scans.get(each) or BoardFinder(rig).scan(each) for name, each in samples.scans.items()
        }
        image, scan = next(iter(samples.images.values())), next(iter(samples.scans.values()))
        return Detections({(image.sensor, image.channel): images}, {scan.sensor: scans})


def _see(rig: Rig, image: Image) -> ImageDetection:
    """Find the board in an image; one of another size than the profile's is refused, as in a session."""
    try:
        return BoardFinder(rig).image(image)
    except ProfileError as error:
        return refusal_of("image", error)


def _gather(rig: Rig, truth: Array, captures: Iterator[SimulatedCapture]) -> Samples:
    images, scans = {}, {}
    for number, capture in enumerate(captures):
        images[f"{number:06d}"], scans[f"{number:06d}"] = capture.images[0], capture.scans[0]
    return Samples(rig.name, rig, images, scans, truth)


def _placed(stage: Stage, index: int) -> SimulatedCapture:
    rng = stage.rng(index, PLACEMENT)
    return capture_at(stage, index, stage.place(index, rng), rng)


def _facing_one_way(stage: Stage) -> Iterator[SimulatedCapture]:
    for number, T_world_board in enumerate(nearly_parallel(stage, stage.rng(_PARALLEL))):
        yield capture_at(stage, _FIRST_PARALLEL + number, T_world_board)


def _in_one_place(stage: Stage) -> Iterator[SimulatedCapture]:
    T_world_board = stage.place(0, stage.rng(0, PLACEMENT))
    rng = stage.rng(_ONE_PLACE)
    for number in range(N_IN_ONE_PLACE):
        jitter = rng.standard_normal(6) * np.repeat([_JITTER_M, _JITTER_RAD], 3) / np.sqrt(3)
        yield capture_at(stage, _FIRST_IN_ONE_PLACE + number, perturb(T_world_board, jitter))


def _frames_only(rig: Rig) -> Rig:
    """Leave out channels of events, which would take most of a simulation's time."""
    cameras = {}
    for name, camera in rig.cameras.items():
        frames = {key: channel for key, channel in camera.channels.items() if channel.kind == "frames"}
        cameras[name] = camera.model_copy(update={"channels": frames})
    return rig.model_copy(update={"cameras": cameras})


def nearly_parallel(stage: Stage, rng: np.random.Generator) -> Iterator[Array]:
    """Hold the board at many places with its normal within a few degrees of one direction."""
    view, spread_deg = stage.views[0], rng.uniform(1.0, 5.0)
    lean = exp_so3(np.radians(15) * rng.uniform(-1, 1, 3) * [1, 1, 0])
    n_found = 0
    for _ in range(_N_PLACES):
        T_world_board = _facing(stage, lean, spread_deg, rng)
        if not view.can_be_held(stage.board, stage.room, T_world_board):
            continue
        is_seen = view.seen_share(stage.board, T_world_board) > 0.8
        if is_seen and view.count_rings(stage.board, T_world_board) >= 5:
            yield T_world_board
            n_found += 1
            if n_found == N_PARALLEL:
                return


def _facing(stage: Stage, lean: Array, spread_deg: float, rng: np.random.Generator) -> Array:
    lens = stage.views[0].intrinsics
    pixel = rng.uniform(0.15, 0.85, 2) * [lens.width_px, lens.height_px]
    centre = lens.unproject(pixel) * rng.uniform(*stage.options.distance_m)
    wobble = exp_so3(np.radians(spread_deg) * rng.standard_normal(3) * [1, 1, 0])
    mean_deg, half_width_deg = stage.options.roll_deg
    roll_deg = mean_deg + half_width_deg * rng.uniform(-1, 1)
    roll = exp_so3(np.radians(roll_deg) * np.array([0.0, 0.0, 1.0]))
    facing = np.diag([1.0, -1.0, -1.0])
    return np.asarray(stage.views[0].T_world_cam @ pose(lean @ wobble @ facing @ roll, centre))
