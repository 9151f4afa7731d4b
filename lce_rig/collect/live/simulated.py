"""The simulated rig in real time: its sensors as live sources, and a person who follows the guidance.

The simulation runs in its own process, as real sensors do. While the board is still, its scene is
rendered once and measured for each image and scan; while it moves, it is rendered every time. If the
computer is too slow, everything runs in slow motion: sensors, timestamps and person share one simulated time.
"""

import math
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lce_rig.collect.findings import CLOCK_SIMULATED
from lce_rig.collect.guidance.instructions import HeldPose, build_pose, describe_pose, instruct
from lce_rig.collect.guidance.sensor_model import SensorPlace
from lce_rig.collect.live.state import LiveState
from lce_rig.collect.worker import Worker
from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import LceRigError, ProfileError, SourceError
from lce_rig.core.geometry import Array, exp_so3, invert, pose
from lce_rig.devices.reading import READ_WAIT_S, Inbox, LiveSource, SourceStatus
from lce_rig.rig import Rig
from lce_rig.simulate import SimulationOptions
from lce_rig.simulate.live_scene import LiveScene
from lce_rig.simulate.placements import between
from lce_rig.simulate.stage import require_lidar

# A person's reaction time, walking speed, time until another attempt, and tries per fraction of the way.
REACTION_S = 0.7
WALK_MPS = 0.6
AGAIN_S = 7.0
_TRIES = 8
# Fractions of the way, tried one after the other if an obstacle blocks it.
_SHARES = (1.0, 0.75, 0.5, 0.25)
_START = HeldPose(0.0, 2.5, 0.0, 0.0, 0.0, 45.0)
_PERSON_STREAM = 101
_N_SLOTS = 32


class SimulatedSource(LiveSource):
    """One simulated sensor; see `LiveSource`."""

    def __init__(self, sensor: str) -> None:
        super().__init__(sensor, sensor, math.inf)
        self._taken = Inbox[Image | Scan]()
        self._failure: SourceError | None = None

    def open(self) -> None:
        """Start taking samples.

        Raises:
            SourceError: the simulation has ended.
        """
        if self._failure is not None:
            raise self._failure
        self._taken = Inbox()

    def read(self) -> list[Image | Scan]:
        """Return the samples from the simulation; see `LiveSource`."""
        came = self._taken.take(READ_WAIT_S)
        if came is None and self._failure is not None:
            raise self._failure
        return [] if came is None else [came[1]]

    def close(self) -> None:
        """Stop."""
        self._taken.close()

    def describe(self) -> SourceStatus:
        """Report the state of the sensor."""
        clock, n_lost = CLOCK_SIMULATED(), self._taken.n_dropped[self.sensor]
        return SourceStatus(self.sensor, n_lost=n_lost, clock=clock, device="simulated")

    def put(self, sample: Image | Scan) -> None:
        """Queue a sample of the simulation."""
        self._taken.put(self.sensor, [sample], _N_SLOTS)

    def fail(self, error: SourceError) -> None:
        """Stop with an error."""
        self._failure = error
        self._taken.close()


class SimulatedRig:
    """A simulated rig and a person with the board in front of it; open while its `with` block lasts.

    Attributes:
        sources: live sources of its sensors: frames and scans. Events cannot be simulated in real time.
    """

    def __init__(self, rig: Rig, seed: int) -> None:
        """Prepare.

        Args:
            rig: the profile.
            seed: random seed of truth, room, noise and the person.

        Raises:
            ProfileError: no camera of the rig has frames, or its LiDAR is not known.
        """
        require_lidar(rig)
        framed = [name for name, camera in rig.cameras.items() if camera.first_channel("frames")]
        if rig.cameras and not framed:
            raise ProfileError(
                f"rig {rig.name!r} has no camera with frames; events are not simulated in real time",
                "Simulate a recording instead: lce-rig simulate --recording FOLDER.",
            )
        self._by_sensor = {name: SimulatedSource(name) for name in [*framed, *rig.lidars]}
        self.sources: list[LiveSource] = list(self._by_sensor.values())
        # The person follows the nominal extrinsics, not the true ones.
        lidar = next(iter(rig.lidars))
        views = {name: SensorPlace.nominal(rig, name, lidar) for name in framed}
        self._worker = Worker("simulated rig", _Simulation, rig, seed, views)
        self._reader = threading.Thread(target=self._read, name="read simulated rig", daemon=True)
        self._now_s, self._period_s = 0.0, 1 / min(lidar.rate_hz for lidar in rig.lidars.values())
        self._is_guided = bool(framed)
        self._asked: tuple[str, Array] | Literal["elsewhere"] | None = None
        self._asked_s = -1e9
        self._last: tuple[int, bytes] | None = None
        self._changed_s = 0.0

    def __enter__(self) -> "SimulatedRig":
        """Start the simulation and wait until it runs.

        Raises:
            LceRigError: the simulation fails to start.
        """
        with ExitStack() as stack:
            stack.enter_context(self._worker)
            self._worker.call("take", None)
            stack.pop_all()
        self._reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the simulation."""
        self._worker.__exit__()
        self._reader.join()

    def watch(self, state: LiveState) -> None:
        """Show the person a state of the collection: the target placement and the number of captures."""
        place = state.drawing.wanted if state.drawing is not None else None
        if state.phase in ("holding", "saving") or (self._is_guided and place is None):
            return
        wanted, now_s = (state.n_captures, b"" if place is None else place.tobytes()), self._now_s
        if wanted != self._last:
            self._last, self._changed_s = wanted, now_s
            self._asked_s = -1e9
        is_noticed = now_s - self._changed_s > REACTION_S
        if is_noticed and now_s - self._asked_s > AGAIN_S:
            self._asked_s = now_s
            self._asked = "elsewhere"
            if state.drawing is not None and place is not None:
                self._asked = state.drawing.camera.partition(".")[0], place

    def _read(self) -> None:
        try:
            while True:
                asked, self._asked = self._asked, None
                for sample in self._worker.call("take", asked):
                    self._by_sensor[sample.sensor].put(sample)
                self._now_s += self._period_s
        except LceRigError:
            for source in self._by_sensor.values():
                source.fail(SourceError("the simulated rig has ended", "Start again."))


class _Simulation:
    """The simulation in the worker process: takes samples in turn, no faster than in real time."""

    def __init__(self, rig: Rig, seed: int, views: Mapping[str, SensorPlace]) -> None:
        self._scene = LiveScene(rig, seed, SimulationOptions.for_rig(rig.name))
        self._walker = Walker(self._scene, Person(), views)
        if views:
            camera = next(iter(views))
            self._scene.hold(self._scene.stage.T_world_sensor[camera] @ build_pose(views[camera], _START))
        else:
            self._scene.hold(self._walker.choose())
        self._period_ns = max(model.period_ns for model in self._scene.stage.models.values())
        self._stamp_ns, self._due_s = time.time_ns(), time.monotonic()

    def take(self, asked: tuple[str, Array] | Literal["elsewhere"] | None) -> list[Image | Scan]:
        """Send the person to a camera's T_cam_board (4, 4), or elsewhere; return a sample of each sensor."""
        time.sleep(max(0.0, self._due_s - time.monotonic()))
        if asked == "elsewhere":
            self._walker.set_out(self._walker.choose(), self._stamp_ns * 1e-9)
        elif asked is not None:
            self._walker.hear(*asked, self._stamp_ns * 1e-9)
        self._walker.walk(self._stamp_ns * 1e-9)
        samples = list(self._scene.take(self._stamp_ns))
        self._stamp_ns += self._period_ns
        # Do not make up for a slow cycle by shorter ones.
        self._due_s = max(self._due_s + self._period_ns * 1e-9, time.monotonic())
        return samples


_FIGURE = {
    "sideways": "right_m",
    "nearer": "ahead_m",
    "height": "up_m",
    "tilt": "tilt_deg",
    "turn": "turn_deg",
    "roll": "roll_deg",
}


@dataclass(frozen=True)
class Person:
    """A simulated person; follows instructions with errors.

    Attributes:
        place_sigma_m: error along each axis.
        turn_sigma_deg: error about each axis.
        ignored_share: probability that one of the instructions is ignored.
    """

    place_sigma_m: float = 0.10
    turn_sigma_deg: float = 8.0
    ignored_share: float = 0.2

    def follow(self, view: SensorPlace, present: Array, wanted: Array, rng: np.random.Generator) -> Array:
        """Move a board T_cam_board (4, 4) to the target pose (4, 4), with the person's errors."""
        aim = describe_pose(view, wanted)
        instructions = instruct(view, present, wanted)
        if instructions and rng.random() < self.ignored_share:
            ignored = rng.choice(list(instructions))
            aim = replace(aim, **{_FIGURE[ignored]: getattr(describe_pose(view, present), _FIGURE[ignored])})
        aimed = build_pose(view, aim)
        turn = exp_so3(np.radians(self.turn_sigma_deg) * rng.standard_normal(3))
        place = aimed[:3, 3] + self.place_sigma_m * rng.standard_normal(3)
        return pose(turn @ aimed[:3, :3], place)


class Walker:
    """Carries the board towards the target placement, as far as the room allows."""

    def __init__(self, scene: LiveScene, person: Person, views: Mapping[str, SensorPlace]) -> None:
        self._scene = scene
        self._person = person
        self._views = views
        self._rng = scene.stage.rng(_PERSON_STREAM)
        self._way: tuple[Array, Array, float, float] | None = None
        self._n_chosen = 0

    def choose(self) -> Array:
        """Choose a placement T_world_board (4, 4) without guidance."""
        self._n_chosen += 1
        return self._scene.stage.place(self._n_chosen, self._rng)

    def set_out(self, T_world_board: Array, now_s: float) -> None:
        """Set out for a placement (4, 4)."""
        way_m = float(np.linalg.norm(T_world_board[:3, 3] - self._scene.T_world_board[:3, 3]))
        self._way = self._scene.T_world_board, T_world_board, now_s, now_s + max(way_m / WALK_MPS, 0.5)

    def hear(self, camera: str, wanted: Array, now_s: float) -> None:
        """Start towards a placement T_cam_board (4, 4), as far as the board can be held.

        Args:
            camera: camera of the placement.
            wanted: (4, 4) T_cam_board.
            now_s: simulated time.
        """
        view, T_world_cam = self._views[camera], self._scene.stage.T_world_sensor[camera]
        present = invert(T_world_cam) @ self._scene.T_world_board
        for share in np.repeat(_SHARES, _TRIES):
            aim = wanted if share == 1 else between(present, wanted, share)
            reached = T_world_cam @ self._person.follow(view, present, aim, self._rng)
            if self._scene.can_be_held(camera, reached):
                self.set_out(reached, now_s)
                return

    def walk(self, now_s: float) -> None:
        """Move the board along its path to its position at `now_s`."""
        if self._way is None:
            return
        start, end, from_s, until_s = self._way
        share = min((now_s - from_s) / (until_s - from_s), 1.0)
        if share >= 1:
            self._scene.hold(end)
            self._way = None
        else:
            self._scene.pass_by(start, end, share)
