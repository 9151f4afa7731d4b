"""Recordings of two LiDARs without a camera become captures."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

import lce_rig as lce
from lce_rig.collect.offline import collect
from lce_rig.core.board import Board
from lce_rig.core.data import Scan, Stream
from lce_rig.core.errors import SourceError
from lce_rig.core.geometry import Array, exp_so3, pose
from lce_rig.core.pcd import encode_pcd
from lce_rig.io import open_recording
from lce_rig.io.ros.bag_recorder import BagRecorder
from lce_rig.rig import Rig
from lce_rig.session import Session
from tests.detect.scans import board_plate, cast, place, room
from tests.shared import changed

PLATE = Board(cols=2, rows=2, square_m=0.1, width_m=0.9, height_m=0.7)
BESIDE = pose(exp_so3(np.radians([0, 0, 25.0])), np.array([0.1, -0.5, 0.0]))
LIDARS = {
    name: {"model": "VLP-16", "frame": f"{name}_link", "topic": f"/{name}", "rate_hz": 10}
    for name in ("left", "right")
}
START_NS = 1_760_000_000_000_000_000


@pytest.fixture
def rig() -> Rig:
    board = {"type": "plain", "width_m": PLATE.width_m, "height_m": PLATE.height_m}
    return Rig.model_validate({"format_version": 1, "name": "pair", "board": board, "lidars": LIDARS})


def scan_both(T_left_board: Array, seed: int) -> list[Scan]:
    scans = []
    for name, T in (("left", np.eye(4)), ("right", np.linalg.inv(BESIDE))):
        scan = cast([board_plate(T @ T_left_board, PLATE), *room(13)], sigma_m=0.005, seed=seed)
        scans.append(replace(scan, sensor=name))
    return scans


@dataclass
class Recording:
    """A reader of scans in memory; see `ContinuousRecording`."""

    samples_read: list[Scan]
    path: Path = Path("scans")
    key: str = "scans"
    notes: list[str] = field(default_factory=list)

    @property
    def n_samples(self) -> int:
        return len(self.samples_read)

    @property
    def streams(self) -> set[Stream]:
        return {Stream(scan.sensor, "", "scans") for scan in self.samples_read}

    def samples(self) -> Iterator[Scan]:
        yield from self.samples_read


def recorded(boards: list[Array], late_ns: int = 20_000_000) -> Recording:
    """Scan boards one after the other, ten times a second; the right LiDAR begins later."""
    scans = []
    for k, T in enumerate(boards):
        for scan, wait_ns in zip(scan_both(T, k), (0, late_ns), strict=True):
            scans.append(replace(scan, stamp_ns=START_NS + k * 100_000_000 + wait_ns))
    return Recording(sorted(scans, key=lambda scan: scan.stamp_ns or 0))


def test_collect_still_plate_gives_a_capture(tmp_path: Path, rig: Rig) -> None:
    stood = [place(2.5, 15, 45, yaw) for yaw in (20, -20) for _ in range(8)]
    with Session.create(tmp_path / "s", rig) as session:
        report = collect(session, [recorded(stood)])
        assert len(report.captured) == 2
        assert all(capture.lidars == ["left", "right"] for capture in session.captures)
        again = collect(session, [recorded(stood)])
    assert not again.captured and again.n_known == 2


def test_collect_from_takes_options_per_bag(tmp_path: Path, rig: Rig) -> None:
    scans, names = recorded([place(2.5, 15, 45, 20)] * 8).samples_read, ("left", "right")
    bags, sources = [], []
    for name in names:
        with BagRecorder.in_folder(
            tmp_path / name, changed(rig, **{f"lidars__{name}__topic": "/points"})
        ) as bag:
            for scan in scans:
                if scan.sensor == name:
                    bag.write(scan)
        bags.append(bag.path)
        sources.append(lce.SourceOptions(topics={name: "/points"}))
    session = lce.collect_from(rig, bags, tmp_path / "s", sources=sources)
    assert [capture.lidars for capture in session.captures] == [["left", "right"]]
    with pytest.raises(lce.UsageError):
        lce.collect_from(rig, bags, tmp_path / "t", sources=sources[:1])


def test_collect_moving_plate_is_skipped(tmp_path: Path, rig: Rig) -> None:
    """A plate that only one LiDAR sees gives no capture either."""
    moved = [place(2.0 + 0.06 * k, 15, 45, 20) for k in range(14)]
    with Session.create(tmp_path / "s", rig) as session:
        assert not collect(session, [recorded(moved)]).captured
        apart = recorded([place(2.5, 15, 45, 20)] * 8, late_ns=5_000_000_000)
        report = collect(session, [apart])
    assert not report.captured and "read.no_other" in report.counts.by_code()


def test_single_lidar_scans_are_refused_with_action(tmp_path: Path, rig: Rig) -> None:
    one = recorded([place(2.5, 15, 45, 20)] * 8)
    one.samples_read = [scan for scan in one.samples_read if scan.sensor == "left"]
    with Session.create(tmp_path / "s", rig) as session, pytest.raises(SourceError):
        collect(session, [one])


@pytest.mark.parametrize("above", ["", "pcd"])
def test_collect_lidar_folders_match_by_name(tmp_path: Path, rig: Rig, above: str) -> None:
    folder = tmp_path / "recording"
    for k in range(3):
        for scan in scan_both(place(2.5, 15, 45, 10 * k), k):
            cloud = np.zeros(len(scan.points), dtype=[*((n, "f4") for n in "xyz"), ("ring", "u2")])
            for axis, name in enumerate("xyz"):
                cloud[name] = scan.points[:, axis]
            cloud["ring"] = scan.ring
            place_of = folder / above / scan.sensor
            place_of.mkdir(parents=True, exist_ok=True)
            if (k, scan.sensor) != (2, "right"):
                (place_of / f"{k}.pcd").write_bytes(encode_pcd(cloud))
    with Session.create(tmp_path / "s", rig) as session:
        report = collect(session, [open_recording(folder, rig)])
        assert len(report.captured) == 2
        assert all(capture.lidars == ["left", "right"] for capture in session.captures)
        assert not collect(session, [open_recording(folder, rig)]).captured


def test_folder_of_single_lidar_is_refused(tmp_path: Path, rig: Rig) -> None:
    (tmp_path / "left").mkdir()
    (tmp_path / "left" / "0.pcd").write_bytes(b"")
    with pytest.raises(SourceError):
        open_recording(tmp_path, rig)
