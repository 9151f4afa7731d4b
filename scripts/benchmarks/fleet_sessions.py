"""Simulated sessions of many robots, of which some were nudged at a known date; and sessions that are broken.

Images and scans are simulated once for each mounting and shared between the robots so mounted; no two
sessions of one robot share a capture.
"""

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.kept import kept_folder
from lce_rig.core.calibration import MOTIONS
from lce_rig.core.geometry import Array, perturb
from lce_rig.rig import Rig, dump_rig, load_rig
from lce_rig.rig.profile import NominalExtrinsic
from lce_rig.session import Session
from lce_rig.simulate import SimulationOptions, simulate_captures, truth_extrinsics

N_ROBOTS, N_SESSIONS, N_NUDGED = 60, 500, 12
_CAPTURES = 8
# Captures of one mounting, enough for the robot with the most sessions.
_MOST = -(-N_SESSIONS // N_ROBOTS) * _CAPTURES
_MOUNTINGS = 2
_FIRST_DATE = datetime(2026, 1, 5, 9, tzinfo=timezone.utc)
TRUTH = "fleet_truth.json"


@dataclass(frozen=True)
class Nudge:
    """How a robot's camera moved.

    Attributes:
        after: sessions that the robot had before.
        motion: along or about which axis of the camera.
        size: in m or deg.
    """

    after: int
    motion: str
    size: float

    @property
    def tangent(self) -> Array:
        """The change of T_cam_lidar (6,)."""
        tangent = np.zeros(6)
        index = MOTIONS.index(self.motion)  # type: ignore[arg-type]
        tangent[index] = np.radians(self.size) if index >= 3 else self.size
        return tangent


@dataclass(frozen=True)
class SimulatedRobot:
    """One robot: its mounting, its sessions' number, and whether it was nudged."""

    name: str
    mounting: int
    n_sessions: int
    nudge: Nudge | None


def small_rig() -> Rig:
    """Give the rig rlfs with images of half the size."""
    rig = load_rig("rlfs")
    camera = rig.cameras["cam"]
    halves = {key: getattr(camera.intrinsics, key) / 2 for key in ("fx_px", "fy_px", "cx_px", "cy_px")}
    lens = camera.intrinsics.model_copy(update=halves)
    small = camera.model_copy(update={"resolution_px": (640, 360), "intrinsics": lens})
    return rig.model_copy(update={"cameras": {"cam": small}})


def robots(n_robots: int, n_sessions: int, n_nudged: int, seed: int = 0) -> list[SimulatedRobot]:
    """Draw the robots; nudges of 0.3 to 1 deg or 10 to 30 mm about or along one axis each."""
    rng = np.random.default_rng(seed)
    nudged = set(rng.choice(n_robots, n_nudged, replace=False).tolist())
    found: list[SimulatedRobot] = []
    for k in range(n_robots):
        own = n_sessions // n_robots + (k < n_sessions % n_robots)
        nudge = None
        if k in nudged:
            index = len([each for each in found if each.nudge]) % 6
            sizes = (0.3, 1.0) if index >= 3 else (0.010, 0.030)
            size = float(rng.uniform(*sizes) * rng.choice([-1, 1]))
            nudge = Nudge(int(rng.integers(own // 2 - 1, own // 2 + 2)), MOTIONS[index], size)
        found.append(SimulatedRobot(f"r{k:03d}", k % _MOUNTINGS, own, nudge))
    return found


def make_fleet(
    root: Path,
    folder: Path,
    n_robots: int = N_ROBOTS,
    n_sessions: int = N_SESSIONS,
    n_nudged: int = N_NUDGED,
) -> list[SimulatedRobot]:
    """Write the sessions of a fleet below a root, unless they are there, with the truth beside them.

    Args:
        root: for the sessions, root/robot/session.
        folder: where simulated captures are kept.
        n_robots, n_sessions, n_nudged: of the fleet.
    """
    fleet = robots(n_robots, n_sessions, n_nudged)
    if (root / TRUTH).exists():
        return fleet
    rig = small_rig()
    kept = kept_folder(folder, rig, "fleet", is_detected=False)
    pools: list[tuple[Path, int, Nudge | None, int]] = [
        (kept, mounting, None, _MOST) for mounting in range(_MOUNTINGS)
    ]
    pools += [
        (kept, r.mounting, r.nudge, (r.n_sessions - r.nudge.after) * _CAPTURES) for r in fleet if r.nudge
    ]
    with get_context("spawn").Pool(len(os.sched_getaffinity(0))) as pool:
        pool.map(_simulate_pool, pools, chunksize=1)
    for number, robot in enumerate(fleet):
        before = _pool_path(kept, robot.mounting, None, _MOST)
        order = np.random.default_rng([number, 1]).permutation(_MOST)
        for k in range(robot.n_sessions):
            chosen, pool_path = order[k * _CAPTURES : (k + 1) * _CAPTURES], before
            if robot.nudge and k >= robot.nudge.after:
                n = (robot.n_sessions - robot.nudge.after) * _CAPTURES
                pool_path = _pool_path(kept, robot.mounting, robot.nudge, n)
                chosen = np.arange(
                    (k - robot.nudge.after) * _CAPTURES, (k - robot.nudge.after + 1) * _CAPTURES
                )
            date = _FIRST_DATE + timedelta(days=7 * k, minutes=13 * number)
            compose(root / robot.name / f"{date:%Y-%m-%d}", rig, robot.name, pool_path, chosen.tolist(), date)
    truth = {
        robot.name: None
        if robot.nudge is None
        else vars(robot.nudge) | {"date": f"{_FIRST_DATE + timedelta(days=7 * robot.nudge.after):%Y-%m-%d}"}
        for robot in fleet
    }
    (root / TRUTH).write_text(json.dumps(truth, indent=1) + "\n")
    return fleet


def _pool_path(kept: Path, mounting: int, nudge: Nudge | None, n: int) -> Path:
    moved = "" if nudge is None else f"-{nudge.motion}-{nudge.size:.6f}"
    return kept / f"mounting{mounting}{moved}-{n}"


def _simulate_pool(pool: tuple[Path, int, Nudge | None, int]) -> None:
    """Simulate the captures of one mounting into a session, unless it is there."""
    kept, mounting, nudge, n = pool
    path = _pool_path(kept, mounting, nudge, n)
    if path.exists():
        return
    rig = small_rig()
    options = SimulationOptions.for_rig(rig.name)
    T = truth_extrinsics(rig, mounting, options)["cam", "lidar"]
    seed = mounting if nudge is None else 100 + MOTIONS.index(nudge.motion) * 10 + mounting  # type: ignore[arg-type]
    if nudge is not None:
        T = perturb(T, nudge.tangent)
    exact = NominalExtrinsic(
        camera="cam",
        lidar="lidar",
        matrix=tuple(map(tuple, T[:3, :3].tolist())),  # type: ignore[arg-type]
        translation_m=tuple(T[:3, 3].tolist()),
    )
    options = replace(options, mounting_seed=mounting, truth_rotation_deg=0.0, truth_translation_m=0.0)
    draft = path.with_name(f".{path.name}-{os.getpid()}")
    shutil.rmtree(draft, ignore_errors=True)
    moved = rig.model_copy(update={"nominal_extrinsics": (exact,)})
    with Session.create(draft, rig) as session:
        for capture in simulate_captures(moved, n_captures=n, seed=seed, options=options):
            session.add_capture(capture.images, capture.scans, {"source": "simulated"})
    draft.rename(path)


def compose(path: Path, rig: Rig, robot: str, pool: Path, chosen: list[int], date: datetime) -> None:
    """Write a session with the captures of another one, sharing its files, at another date."""
    lidar, camera = rig.lidars["lidar"], rig.cameras["cam"]
    own = rig.model_copy(
        update={
            "robot": robot,
            "lidars": {"lidar": lidar.model_copy(update={"serial": f"L-{robot}"})},
            "cameras": {"cam": camera.model_copy(update={"serial": f"C-{robot}"})},
        }
    )
    Session.create(path, own).close()
    start_ns = round(date.timestamp() * 1e9)
    for number, index in enumerate(chosen):
        source, target = pool / "captures" / f"{index:06d}", path / "captures" / f"{number:06d}"
        target.mkdir()
        manifest: dict[str, Any] = json.loads((source / "meta.json").read_text())
        first_ns = min(entry["stamp_ns"] for entry in manifest["files"])
        for entry in manifest["files"]:
            os.link(source / entry["file"], target / entry["file"])
            for key in ("stamp_ns", "host_ns"):
                entry[key] += start_ns + number * 4_000_000_000 - first_ns
        (target / "meta.json").write_text(json.dumps(manifest))


# Sessions that are broken. Files are shared with others: they are replaced, not changed.


def _truncate(session: Path) -> None:
    """Cut every second file of captures, as a copy that ended early."""
    for path in sorted(session.glob("captures/*/cam.frames.png")):
        data = path.read_bytes()
        path.unlink()
        path.write_bytes(data[: len(data) // 2])


def _torn_marker(session: Path) -> None:
    (session / "session.json").write_text('{"format_vers')


def _other_board(session: Path) -> None:
    """State a board of fewer squares than the one in the images."""
    text = (session / "rig.yaml").read_text()
    (session / "rig.yaml").write_text(text.replace("[8, 6]", "[7, 5]"))


def _other_rig(session: Path) -> None:
    (session / "rig.yaml").write_text(dump_rig(load_rig("sss")))


def _endless(session: Path) -> None:
    """Hold thousands of captures."""
    own = sorted(session.glob("captures/*"))
    for k in range(len(own), 3000):
        copy = session / "captures" / f"{k:06d}"
        copy.mkdir()
        for file in own[k % len(own)].iterdir():
            os.link(file, copy / file.name)


def _memory_bomb(session: Path) -> None:
    """Hold images of 67 megapixels."""
    import hashlib

    text = (session / "rig.yaml").read_text().replace("[640, 360]", "[8192, 8192]")
    text = re.sub(r"([fc][xy]_px): ([0-9.]+)", lambda found: f"{found[1]}: {16 * float(found[2]):.4f}", text)
    (session / "rig.yaml").write_text(text)
    noise = np.random.default_rng(0).integers(0, 255, (64, 64), dtype=np.uint8)
    data = cv2.imencode(".png", np.tile(noise, (128, 128)))[1].tobytes()
    for manifest in sorted(session.glob("captures/*/meta.json")):
        image = manifest.parent / "cam.frames.png"
        image.unlink()
        image.write_bytes(data)
        document = json.loads(manifest.read_text())
        for entry in document["files"]:
            if entry["kind"] == "image":
                entry |= {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        manifest.write_text(json.dumps(document))


BROKEN: dict[str, tuple[Callable[[Path], None], str]] = {
    "images truncated": (_truncate, "failed"),
    "session.json truncated": (_torn_marker, "failed"),
    "another board in the profile": (_other_board, "failed"),
    "another rig's profile": (_other_rig, "failed"),
    "endless": (_endless, "timed_out"),
    "memory bomb": (_memory_bomb, "out_of_memory"),
}
"""What breaks a session, and the status that it must get."""


def break_sessions(root: Path, share: float = 0.2) -> dict[str, str]:
    """Break every so many sessions below a root; return the kinds by their path."""
    sessions = sorted(path.parent for path in root.glob("*/*/session.json"))
    broken: dict[str, str] = {}
    chosen: Iterator[Path] = iter(sessions[:: round(1 / share)])
    for number, session in enumerate(chosen):
        kind = list(BROKEN)[number % len(BROKEN)]
        BROKEN[kind][0](session)
        broken[str(session)] = kind
    return broken
