"""Is this computer, with these sensors, fit to collect? Every check in a table, and how they are made."""

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from lce_rig.core import velodyne
from lce_rig.core.data import Image, join_events
from lce_rig.core.errors import LceRigError, SourceError, refusal_of
from lce_rig.core.findings import Finding, Refusal
from lce_rig.detect.events.search import find_event_board, reconstructor_for
from lce_rig.detect.finder import BoardFinder
from lce_rig.devices.velodyne_web import VelodyneWeb, WebReport
from lce_rig.doctor import clocks, computer, findings, streams
from lce_rig.doctor.examination import Check, Examination, driver_of, sensors, source_of
from lce_rig.doctor.observing import ObservedSensor, observe
from lce_rig.rig import Rig
from lce_rig.rig.sync_settings import BOARD

_WEB_TIMEOUT_S = 1.0

COMPUTER_CHECKS: dict[str, Callable[[Examination], Iterable[Finding]]] = {
    "python": computer.check_python,
    "packages": computer.check_packages,
    "libraries": computer.check_libraries,
    "disk": computer.check_disk,
    "buffer": computer.check_socket_buffer,
    "udev rules": computer.check_udev_rules,
    "clock": computer.check_clock,
}
SENSOR_CHECKS: dict[str, dict[str, Callable[[Examination, str], Iterable[Finding]]]] = {
    "lidar": {
        "device": streams.check_device,
        "settings": streams.check_settings,
        "stream": streams.check_stream,
        "PPS": clocks.check_pps,
        "board": streams.check_board,
    },
    "camera": {
        "device": streams.check_device,
        "stream": streams.check_stream,
        "clock": clocks.check_clock,
        "pulses": clocks.check_frames_of_pulses,
        "edges": clocks.check_edges,
        "picture": streams.check_image,
        "events": streams.check_events,
        "board": streams.check_board,
    },
    "sync": {
        "device": streams.check_device,
        "pulses": clocks.check_pulses_sent,
        "clock": clocks.check_clock,
    },
    "rig": {"clocks": clocks.check_offsets, "sync": clocks.check_sync},
}
"""Every check by its line's name; a line without findings is left out."""


class DoctorOptions(NamedTuple):
    """How to examine: for how long, where sessions are to be written, port of a VLP-16's web server."""

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
    exam, checks = Examination(rig, options.folder), list[Check]()

    def look_at_computer() -> None:
        for name, check in COMPUTER_CHECKS.items():
            checks.append(Check("computer", name, tuple(check(exam))))

    with ThreadPoolExecutor(thread_name_prefix="web") as pool:
        names = [name for name in rig.lidars if driver_of(rig, name) == "vlp16"]
        asked = {name: pool.submit(_read_web, rig, name, options.web_port) for name in names}
        sources = {sensor: partial(source_of, rig, sensor) for sensor in sensors(rig)}
        seen = observe(sources, options.duration_s, [look_at_computer])
        web = {name: answer.result() for name, answer in asked.items()}
    exam = replace(exam, seen=seen, web=web, boards=look_for_boards(rig, seen))
    subjects = [*((name, "lidar") for name in rig.lidars), *((name, "camera") for name in rig.cameras)]
    subjects += [(BOARD, "sync")] if rig.sync is not None else []
    for subject, kind in (*subjects, ("rig", "rig")):
        for name, look in SENSOR_CHECKS[kind].items():
            checks.append(Check(subject, name, tuple(look(exam, subject))))
    return [check for check in checks if check.findings]


def _read_web(rig: Rig, lidar: str, port: int) -> WebReport | SourceError:
    """Ask the web page of a VLP-16; why it says nothing where it does not."""
    address = rig.lidars[lidar].driver.address or velodyne.FACTORY_ADDRESS
    try:
        return VelodyneWeb(address, port, _WEB_TIMEOUT_S).read()
    except SourceError as error:
        return error


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
    boards = BoardFinder(rig).scan(seen.scan)
    if isinstance(boards, Refusal):
        return boards
    best = boards[0].quality
    return findings.BOARD_IN_SCAN(
        distance_m=best.distance_m,
        n_rings=best.n_rings,
        n_points=best.n_points,
        n_candidates=len(boards),
    )


def _sight_in_image(rig: Rig, image: Image) -> Finding:
    try:
        board = BoardFinder(rig).image(image)
    except LceRigError as error:
        board = refusal_of("image", error)
    if isinstance(board, Refusal):
        return board
    names, figures = ("distance_m", "n_corners", "corner_rms_px", "sharpness"), board.figures()
    shown: dict[str, Any] = {name: figures[name] for name in names}
    return findings.BOARD_IN_IMAGE(**shown)


def _sight_in_events(rig: Rig, seen: ObservedSensor) -> Finding:
    camera = rig.cameras[seen.sensor]
    channel = camera.first_channel("events") or "events"
    events = join_events(list(seen.events))
    try:
        reconstructor = reconstructor_for(
            camera.channels[channel].reconstruction if channel in camera.channels else None, channel
        )
        board = find_event_board(
            events,
            int(events.t_ns[-1]) - 1,
            reconstructor,
            rig.board.to_board(),
            camera.to_intrinsics(),
            rig.quality,
        ).board
    except LceRigError as error:
        board = refusal_of("image", error)
    if isinstance(board, Refusal):
        return board
    return findings.BOARD_IN_EVENTS(distance_m=board.distance_m)
