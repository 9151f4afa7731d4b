"""The board in raw events: when pictures are wanted, and what they are remembered under."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lce_rig.core.errors import ProfileError
from lce_rig.detect.detection import LidarDetection
from lce_rig.detect.event_board import EventImage, EventSighting, find_event_board, reconstructor_for
from lce_rig.rig import ReconstructionSettings, Rig
from lce_rig.session import Capture, Session, check_capture


def event_channels(rig: Rig, capture: Capture, event_image: EventImage | None) -> list[tuple[str, str]]:
    """List the (camera, channel) that are seen through pictures made here, of raw events.

    A picture that a capture holds already, made by others, is taken in place of one made here, unless a way
    of making it is asked for.

    Raises:
        SessionError: the capture is damaged, or names sensors that the rig lacks.
    """
    check_capture(rig, capture)
    return [
        (camera, name)
        for camera in capture.event_cameras
        for name, channel in rig.cameras[camera].channels.items()
        if channel.kind == "events" and (event_image is not None or not capture.has_image(camera, name))
    ]


def see_events(
    session: Session,
    capture: Capture,
    camera: str,
    channel: str,
    lidars: Mapping[str, LidarDetection],
    event_image: EventImage | None,
) -> EventSighting:
    """Make a picture of a capture's events for the time at which the LiDAR saw the board, and find it there.

    Args:
        session: whose profile says how.
        capture: holds the camera's events.
        camera, channel: whose picture it is.
        lidars: what was seen in the capture's scans, by LiDAR.
        event_image: in place of the profile's method.

    Raises:
        ProfileError: the network cannot be used; with file and key.
        SessionError: the capture is damaged.
    """
    rig, events = session.rig, capture.events(camera)
    stamp_ns = picture_stamp_ns(rig, capture, camera, channel, lidars)
    if stamp_ns is None:
        stamp_ns = int(events.t_ns[-1]) if len(events) else 0
    settings = rig.cameras[camera].channels[channel].reconstruction
    try:
        return find_event_board(
            events,
            stamp_ns,
            reconstructor_for(settings, channel, event_image),
            rig.board.to_board(),
            rig.cameras[camera].to_intrinsics(),
            rig.quality,
            sweep_s=_sweep_s(rig, lidars),
        )
    except ProfileError as error:
        raise _in_profile(_profile_of(session), camera, channel, error) from error


def picture_stamp_ns(
    rig: Rig, capture: Capture, camera: str, channel: str, lidars: Mapping[str, LidarDetection]
) -> int | None:
    """Say when a LiDAR saw the board, on a channel's own clock; None where no scan carries a stamp.

    Of several LiDARs the first in the profile counts that found the board; where none did, or points carry no
    times, the middle of the sweep.
    """
    names = [name for name in rig.lidars if name in lidars]
    for name in sorted(names, key=lambda name: not isinstance(lidars[name], list)):
        settings, found = rig.lidars[name], lidars[name]
        board = found[0] if isinstance(found, list) and found else None
        stamp_ns = capture.scan(name).stamp_ns if board is None else board.stamp_ns
        if stamp_ns is None:
            continue
        seen_ns = round(0.5e9 / settings.rate_hz)
        if board is not None and board.offset_ns is not None and len(board.offset_ns):
            seen_ns = round(float(np.median(board.offset_ns)))
        own = rig.cameras[camera].channels[channel].timestamps.expected_offset_s
        return stamp_ns + seen_ns + round(1e9 * (settings.timestamps.expected_offset_s - own))
    return None


def event_digest(
    session: Session, camera: str, channel: str, event_image: EventImage | None, base: str
) -> str:
    """Name the cache after everything that pictures of events depend on beside the capture.

    Args:
        session: whose profile says how pictures are made.
        camera, channel: whose pictures they are.
        event_image: in place of the profile's method.
        base: what all detections depend on.

    Raises:
        ProfileError: the network's file cannot be read; with file and key.
    """
    from lce_rig.detect.reconstruct import model_bytes

    settings = session.rig.cameras[camera].channels[channel].reconstruction or ReconstructionSettings()
    settings = settings.model_copy(update={"method": event_image or settings.method})
    digest = hashlib.sha256(f"{base} {settings.model_dump_json()}".encode())
    if settings.method == "network":
        try:
            digest.update(model_bytes(None if settings.model is None else Path(settings.model)))
        except ProfileError as error:
            raise _in_profile(_profile_of(session), camera, channel, error) from error
    return digest.hexdigest()[:12]


def check_networks(rig: Rig, source: str) -> None:
    """Make sure that every network that a profile names can be used.

    Args:
        rig: the profile.
        source: its file, for errors.

    Raises:
        ProfileError: one cannot; with file and key.
    """
    for camera, settings in rig.cameras.items():
        for channel, stream in settings.channels.items():
            if stream.reconstruction is not None and stream.reconstruction.model is not None:
                try:
                    reconstructor_for(stream.reconstruction, channel)
                except ProfileError as error:
                    raise _in_profile(source, camera, channel, error) from error


def _sweep_s(rig: Rig, lidars: Mapping[str, LidarDetection]) -> float | None:
    """Measure how long the LiDAR saw the board; None where it did not."""
    from lce_rig.detect.event_figures import sweep_time_s

    for name, found in lidars.items():
        if isinstance(found, list) and found:
            return sweep_time_s(found[0], 1 / rig.lidars[name].rate_hz)
    return None


def _in_profile(source: str, camera: str, channel: str, error: ProfileError) -> ProfileError:
    """Name the file and the key that an error about a network comes from."""
    key = f"cameras.{camera}.channels.{channel}.reconstruction.model"
    return ProfileError(f"{source}: {key}: {error.what}", error.hint)


def _profile_of(session: Session) -> str:
    return str(session.path / "rig.yaml")
