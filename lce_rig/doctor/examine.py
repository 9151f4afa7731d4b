"""Is this computer, with these sensors, fit to collect? Every check in a table, and how they are made."""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from lce_rig.core.data import Image, join_events
from lce_rig.core.errors import LceRigError, SourceError, refusal_of
from lce_rig.core.findings import Finding, Refusal
from lce_rig.detect.events.search import find_event_board, reconstructor_for
from lce_rig.detect.finder import BoardFinder
from lce_rig.devices.velodyne_web import WebReport
from lce_rig.doctor import Check
from lce_rig.doctor.clocks import (
    check_clock,
    check_edges,
    check_frames_of_pulses,
    check_offsets,
    check_pulses_sent,
    check_sync,
)
from lce_rig.doctor.computer import COMPUTER_CHECKS
from lce_rig.doctor.devices import (
    check_board,
    check_device,
    check_events,
    check_image,
    check_pulse,
    check_settings,
    check_stream,
    read_web,
)
from lce_rig.doctor.observing import ObservedSensor, SensorReport, observe
from lce_rig.doctor.sensor_sources import driver_of, sensors, source_of
from lce_rig.rig import Rig
from lce_rig.rig.sync_settings import BOARD

SensorCheck = Callable[[SensorReport, str], Check | None]

LIDAR_CHECKS: tuple[SensorCheck, ...] = (check_device, check_settings, check_stream, check_pulse, check_board)
CAMERA_CHECKS: tuple[SensorCheck, ...] = (
    check_device,
    check_stream,
    check_clock,
    check_frames_of_pulses,
    check_edges,
    check_image,
    check_events,
    check_board,
)
SYNC_CHECKS: tuple[SensorCheck, ...] = (
    check_device,
    lambda exam, _sensor: check_pulses_sent(exam),
    check_clock,
)
RIG_CHECKS: tuple[Callable[[SensorReport], Check | None], ...] = (check_offsets, check_sync)


@dataclass(frozen=True)
class DoctorOptions:
    """How to examine.

    Attributes:
        duration_s: how long the sensors are watched.
        folder: where sessions are to be written.
        web_port: of a VLP-16's web server.
    """

    duration_s: float = 5.0
    folder: Path = Path()
    web_port: int = 80


def examine(rig: Rig, options: DoctorOptions | None = None) -> list[Check]:
    """Look at the computer and every sensor of a rig; takes the duration and up to some 3 s more.

    What is absent or fails is an error; everything else is looked at all the same.

    Args:
        rig: the profile.
        options: how to examine.

    Returns:
        A line for each thing looked at: the computer's, each sensor's, the rig's.
    """
    options = options or DoctorOptions()
    computer: list[Check] = []
    with ThreadPoolExecutor(thread_name_prefix="web") as pool:
        asked = {
            name: pool.submit(read_web, rig, name, options.web_port)
            for name in rig.lidars
            if driver_of(rig, name) == "vlp16"
        }
        seen = observe(
            {sensor: partial(source_of, rig, sensor) for sensor in sensors(rig)},
            options.duration_s,
            [lambda: computer.extend(_applying(COMPUTER_CHECKS, rig, options.folder))],
        )
        web: dict[str, WebReport | SourceError] = {name: answer.result() for name, answer in asked.items()}
    exam = SensorReport(rig, seen, web, look_for_boards(rig, seen))
    checks = list(computer)
    for names, table in (
        (list(rig.lidars), LIDAR_CHECKS),
        (list(rig.cameras), CAMERA_CHECKS),
        ([BOARD] if rig.sync is not None else [], SYNC_CHECKS),
    ):
        for name in names:
            checks += _applying(table, exam, name)
    return checks + _applying(RIG_CHECKS, exam)


def _applying(table: tuple[Callable[..., Check | None], ...], *arguments: object) -> list[Check]:
    """Make the checks of a table, and keep those that apply."""
    return [line for line in (check(*arguments) for check in table) if line is not None]


def look_for_boards(rig: Rig, seen: Mapping[str, ObservedSensor]) -> dict[tuple[str, str], Finding]:
    """Look for the board in each sensor's last sample; in events only where a camera has no images."""
    sights: dict[tuple[str, str], Finding] = {}
    for sensor, observation in seen.items():
        if observation.scan is not None:
            sights[sensor, ""] = _sight_in_scan(rig, observation)
        for channel, image in observation.images.items():
            sights[sensor, channel] = _sight_in_image(rig, image)
        if observation.events and not observation.images:
            sights[sensor, "events"] = _sight_in_events(rig, observation)
    return sights


def _sight_in_scan(rig: Rig, seen: ObservedSensor) -> Finding:
    assert seen.scan is not None
    found = BoardFinder(rig).scan(seen.scan)
    if isinstance(found, Refusal):
        return found
    best = found[0].quality
    figures = {"distance_m": best.distance_m, "n_rings": best.n_rings, "n_points": best.n_points}
    return Finding("board.in_scan", "note", figures={**figures, "n_candidates": len(found)})


def _sight_in_image(rig: Rig, image: Image) -> Finding:
    try:
        found = BoardFinder(rig).image(image)
    except LceRigError as error:
        found = refusal_of("image", error)
    if isinstance(found, Refusal):
        return found
    names, figures = ("distance_m", "n_corners", "corner_rms_px", "sharpness"), found.figures()
    return Finding("board.in_image", "note", figures={name: figures[name] for name in names})


def _sight_in_events(rig: Rig, seen: ObservedSensor) -> Finding:
    camera = rig.cameras[seen.sensor]
    channel = camera.first_channel("events") or "events"
    events = join_events(list(seen.events))
    try:
        reconstructor = reconstructor_for(
            camera.channels[channel].reconstruction if channel in camera.channels else None, channel
        )
        found = find_event_board(
            events,
            int(events.t_ns[-1]) - 1,
            reconstructor,
            rig.board.to_board(),
            camera.to_intrinsics(),
            rig.quality,
        ).board
    except LceRigError as error:
        found = refusal_of("image", error)
    if isinstance(found, Refusal):
        return found
    return Finding("board.in_events", "note", figures={"distance_m": found.distance_m})
