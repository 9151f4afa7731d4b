"""Live collection under load: a VLP-16, a camera of 1280x720 and a DAVIS346, each over its transport."""

import json
import multiprocessing
import os
import resource
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import datetime
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from wire.davis import RandomDavis
from wire.reel import Reel, make_reel
from wire.rig import WireRig
from wire.sync_board import FakeBoard
from wire.timing import LOOP_NS

from benchmarks.measured import measure
from benchmarks.tables import print_head, print_row
from lce_rig.collect.live.collection import collect_live
from lce_rig.collect.live.state import Key, LiveOptions, LiveReport, LiveState
from lce_rig.core.geometry import Array
from lce_rig.devices import open_live
from lce_rig.devices.davis import DavisSource, OpenedCamera
from lce_rig.devices.reading import LiveSource, SourceStatus
from lce_rig.rig import Rig, load_rig
from lce_rig.rig.profile import SyncSettings
from lce_rig.session import Session

LOOPS_PER_HOLD = 10
N_PLACEMENTS = 20
HOLD_S = 0.5
# Stillness is judged over half a second before the hold begins.
_STILL_S = 0.5 + HOLD_S
_DRAIN_S = 1.0
_MOVED_M = 0.05
_CLOCK_HZ = os.sysconf("SC_CLK_TCK")


@dataclass
class Load:
    """What one run measured.

    Attributes:
        report: of the collection.
        statuses: of the sensors in the end, by name.
        shown_ns: time of day of each state that followed a frame.
        changes_s: from each change of placement on the wire to the first state that shows it.
        settled_s: from the board's being set down until its capture was safe on the disk.
        wall_s, cpu_s, sender_cpu_s: of the collector, and of the camera's process.
        peak_bytes: memory of the collector.
        sent: by the senders, by name.
        tied_s: from the beginning until clocks were tied, and boards may move; None where never.
        n_events: events in each capture.
    """

    report: LiveReport
    statuses: dict[str, SourceStatus]
    shown_ns: list[int] = field(default_factory=list)
    changes_s: list[float] = field(default_factory=list)
    settled_s: list[float] = field(default_factory=list)
    wall_s: float = 0.0
    cpu_s: float = 0.0
    sender_cpu_s: float = 0.0
    peak_bytes: int = 0
    sent: dict[str, dict[str, int]] = field(default_factory=dict)
    tied_s: float | None = None
    n_events: list[int] = field(default_factory=list)


def bench_live(duration_s: float) -> None:
    """Collect under load; tabulate losses, the speed of guidance and captures, and their cost."""
    with tempfile.TemporaryDirectory() as folder:
        rig = load_of_sensors()
        reel = make_reel(Path(folder) / "reel", rig, N_PLACEMENTS)
        for number, (has_frames, has_board) in enumerate(((False, False), (True, False), (True, True))):
            frames, board = "25 Hz" if has_frames else "off", "attached" if has_board else "none"
            print(f"\nframes of the DAVIS346: {frames}; sync board: {board}; load {os.getloadavg()[0]:.1f}\n")
            part = Path(folder) / str(number)
            part.mkdir()
            print_load(run_load(part, rig, reel, duration_s, has_frames=has_frames, has_board=has_board))
            print(f"\nload {os.getloadavg()[0]:.1f}")


def load_of_sensors() -> Rig:
    """Build a rig of a VLP-16, a camera of 1280x720 px and a DAVIS346 that look the same way."""
    rlfs, rles = load_rig("rlfs"), load_rig("rles")
    cam = rlfs.cameras["cam"]
    driver = cam.driver.model_copy(update={"type": "command", "pixel_format": "UYVY", "device": None})
    nominal = rlfs.nominal_extrinsics[0]
    beside = nominal.model_copy(update={"camera": "davis", "translation_m": (0.08, -0.059, -0.07)})
    cameras = {"cam": cam.model_copy(update={"driver": driver}), "davis": rles.cameras["davis"]}
    return rlfs.model_copy(
        update={"name": "load", "cameras": cameras, "nominal_extrinsics": (nominal, beside)}
    )


def run_load(
    folder: Path, rig: Rig, reel: Reel, duration_s: float, *, has_frames: bool, has_board: bool = False
) -> Load:
    """Start the senders, and collect in a separate process."""
    camera_report = folder / "camera.json"
    with ExitStack() as stack:
        if has_board:
            board = stack.enter_context(FakeBoard(drift=30e-6, period_s=0.1, knows_utc=True))
            rig = rig.model_copy(update={"sync": SyncSettings(device=board.path)})
        wire = stack.enter_context(WireRig(folder, rig, reel, LOOPS_PER_HOLD, report=camera_report))
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        cpu_s = _cpu_s(wire.pid)
        process = context.Process(
            target=_collect, args=(theirs, wire.rig, folder / "session", reel, duration_s, has_frames)
        )
        process.start()
        assert ours.recv() == "time is over"
        cpu_s = _cpu_s(wire.pid) - cpu_s
        sent = wire.stop()
        load: Load = ours.recv()
        process.join()
    load.sent |= {"lidar": sent, "cam": json.loads(camera_report.read_text())}
    load.sender_cpu_s += cpu_s
    return load


class _Watch:
    """Takes the states of a collection, and asks for its end."""

    def __init__(self, parent: Connection, duration_s: float) -> None:
        self.shown_ns: list[int] = []
        self.changes_s: list[float] = []
        self.tied_s: float | None = None
        self._parent, self._ends_s = parent, time.monotonic() + duration_s
        self._has_told = False
        self._drawing: object = None
        self._centres: dict[str, Array] = {}
        self._change_ns = 0

    def show(self, state: LiveState) -> None:
        """Note when a frame was shown, and when the first that shows the board at another place."""
        now_ns, drawing = time.time_ns(), state.drawing
        if self.tied_s is None and drawing is not None:
            self.tied_s = None if state.requires_still_boards else state.elapsed_s
        if drawing is None or drawing is self._drawing:
            return
        self._drawing = drawing
        self.shown_ns.append(now_ns)
        if drawing.present is None:
            return
        centre, last = drawing.present[:3, 3], self._centres.get(drawing.camera)
        self._centres[drawing.camera] = centre
        change_ns = last_change_ns(now_ns)
        if last is not None and np.linalg.norm(centre - last) > _MOVED_M and change_ns > self._change_ns:
            self._change_ns = change_ns
            self.changes_s.append((now_ns - change_ns) * 1e-9)

    def key(self) -> Key | None:
        """Ask for the end once the senders have stopped."""
        now_s = time.monotonic()
        if now_s > self._ends_s and not self._has_told:
            self._has_told = True
            self._parent.send("time is over")
        return "stop" if now_s > self._ends_s + _DRAIN_S else None


def last_change_ns(time_ns: int) -> int:
    """Find when the board was set down where it is at a time."""
    hold_ns = LOOPS_PER_HOLD * LOOP_NS
    return time_ns // hold_ns * hold_ns


def measure_settled_s(session: Session) -> list[float]:
    """Measure how long each capture took from the board's being set down to the safe disk."""
    found = []
    for entry in session.read_journal():
        if entry["event"] == "captured":
            stamp_ns = session.capture(entry["capture"]).scan("lidar").stamp_ns
            assert stamp_ns is not None
            safe_s = datetime.fromisoformat(entry["time"]).timestamp()
            found.append(safe_s - last_change_ns(stamp_ns) * 1e-9)
    return found


def _collect(
    parent: Connection, rig: Rig, path: Path, reel: Reel, duration_s: float, has_frames: bool
) -> None:
    davis = RandomDavis(reel, "davis", LOOPS_PER_HOLD, has_frames=has_frames)
    sources: Sequence[LiveSource] = [
        DavisSource("davis", rig.cameras["davis"], lambda *_: OpenedCamera(davis, "made here"))
        if source.sensor == "davis"
        else source
        for source in open_live(rig)
    ]
    with Session.create(path, rig) as session:
        began_s, cpu_s = time.monotonic(), time.process_time()
        watch = _Watch(parent, duration_s)
        report = collect_live(
            session, sources, LiveOptions(hold_s=HOLD_S, goes_on=True), watch.show, watch.key
        )
        statuses = {source.sensor: source.status() for source in sources}
        load = Load(report, statuses, watch.shown_ns, watch.changes_s, measure_settled_s(session))
        load.tied_s = watch.tied_s
        load.n_events = [
            sum(len(capture.events(camera)) for camera in capture.event_cameras)
            for capture in session.captures
        ]
        load.sent["davis"] = {"events": davis.n_events, "frames": davis.n_frames}
        load.wall_s, load.cpu_s = time.monotonic() - began_s, time.process_time() - cpu_s
    load.peak_bytes = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    load.sender_cpu_s = children.ru_utime + children.ru_stime
    parent.send(load)


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _CLOCK_HZ


def print_load(load: Load) -> None:
    """Tabulate a run."""
    lidar, cam, davis = (load.statuses[name] for name in ("lidar", "cam", "davis"))
    gaps_s = np.diff(load.shown_ns) * 1e-9
    latencies_s = load.report.latencies_s
    sent = load.sent
    n_packets = lidar.n_packets or 0
    measure("live.lost", "{}, {}, {}", lidar.n_lost, cam.n_dropped, davis.n_dropped)
    measure("live.updates", "{:.1f} per second", len(gaps_s) / gaps_s.sum())
    measure("live.gap", "{:.2f} s", gaps_s.max())
    if latencies_s:
        measure("live.safe", "{:.2f} s", max(latencies_s))
    measure("live.load", "{:.2f} of a core, {:.0f} MB", load.cpu_s / load.wall_s, load.peak_bytes / 1e6)
    print_head("what", "figure")
    print_row("duration", f"{load.wall_s:.1f} s")
    print_row("packets sent, taken, lost by us", f"{sent['lidar']['sent']}, {n_packets:.0f}, {lidar.n_lost}")
    print_row("scans dropped because nobody took them", lidar.n_dropped)
    print_row(
        "pictures 1280x720 sent, taken, skipped by a full pipe, dropped",
        f"{sent['cam']['sent']}, {cam.n_samples}, {sent['cam']['late']}, {cam.n_dropped}",
    )
    print_row(
        "events sent, events a second taken at the end, batches dropped",
        f"{sent['davis']['events']}, {davis.rates_hz['events'] / 1e6:.2f} M, {davis.n_dropped}",
    )
    print_row("guidance updates a second", f"{len(gaps_s) / gaps_s.sum():.1f}")
    print_row("longest time without one", f"{gaps_s.max():.2f} s")
    print_row("a moved board is shown after, median / worst", _pair(load.changes_s))
    print_row("clocks tied after", "never" if load.tied_s is None else f"{load.tied_s:.1f} s")
    print_row("captures, those with events", f"{len(load.n_events)}, {sum(n > 0 for n in load.n_events)}")
    if any(load.n_events):
        print_row(
            "events in each of these, median", f"{np.median([n for n in load.n_events if n]) / 1e6:.2f} M"
        )
    print_row("decision to safe on disk, median / worst", _pair(latencies_s))
    if load.tied_s is None:
        settled_s = [s - _STILL_S for s in load.settled_s]
        print_row("end of the hold to safe on disk, median / worst", _pair(settled_s))
    print_row("collector, share of a core", f"{load.cpu_s / load.wall_s:.2f}")
    print_row("senders, share of a core", f"{load.sender_cpu_s / load.wall_s:.2f}")
    print_row("collector, peak memory", f"{load.peak_bytes / 1e6:.0f} MB")


def _pair(values_s: Sequence[float]) -> str:
    if not values_s:
        return "-"
    return f"{np.median(values_s):.2f} / {max(values_s):.2f} s"
