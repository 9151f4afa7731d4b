"""Check the samples of a capture: at most one per sensor of the rig."""

from collections.abc import Sequence

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.errors import SessionError
from lce_rig.rig import Rig
from lce_rig.session.capture import Capture


def check_samples(rig: Rig, images: Sequence[Image], scans: Sequence[Scan], events: Sequence[Events]) -> None:
    """Check that samples can be one capture of a rig.

    Raises:
        SessionError: there are none, two of one sensor, one of a sensor that the rig lacks, or events of
            another resolution than the camera's.
    """
    keys = [(i.sensor, i.channel) for i in images]
    keys += [(s.sensor, "") for s in scans] + [(e.sensor, "raw events") for e in events]
    if len(set(keys)) < len(keys) or not keys:
        raise SessionError(
            "a capture holds at most one image per camera channel, one scan per lidar and one stretch of "
            "events a camera at most, and not nothing"
        )
    _check_sensors(rig, [(i.sensor, i.channel) for i in images], [s.sensor for s in scans])
    for stretch in events:
        event_channel(rig, stretch.sensor)
        size, wanted = (stretch.width_px, stretch.height_px), rig.cameras[stretch.sensor].resolution_px
        if size != wanted:
            raise SessionError(
                f"events of {stretch.sensor} are {size[0]}x{size[1]} px; "
                f"rig {rig.name!r} gives it {wanted[0]}x{wanted[1]}",
                "Use this camera's recording, or correct resolution_px in the profile.",
            )


def check_capture(rig: Rig, capture: Capture) -> None:
    """Check that a capture that was read names sensors of its rig only.

    Raises:
        SessionError: it names another sensor, or its manifest is damaged.
    """
    images, lidars, event_cameras = capture.image_keys, capture.lidars, capture.event_cameras
    try:
        _check_sensors(rig, images, lidars)
        for camera in event_cameras:
            event_channel(rig, camera)
    except SessionError as error:
        raise SessionError(
            f"capture {capture.name} belongs to another rig: {error.what}",
            f"Remove {capture.path} and collect again; the other captures are not affected.",
        ) from None


def _check_sensors(rig: Rig, images: Sequence[tuple[str, str]], lidars: Sequence[str]) -> None:
    for name, channel in images:
        camera = rig.cameras.get(name)
        if camera is None or channel not in camera.channels:
            raise SessionError(f"rig {rig.name!r} has no camera channel {name}.{channel}")
    for name in lidars:
        if name not in rig.lidars:
            raise SessionError(f"rig {rig.name!r} has no lidar {name!r}")


def event_channel(rig: Rig, camera: str) -> str:
    """Name the channel that a camera's events belong to, its first of kind events.

    Raises:
        SessionError: the rig has no such camera, or the camera no such channel.
    """
    channel = rig.cameras[camera].first_channel("events") if camera in rig.cameras else None
    if channel is not None:
        return channel
    raise SessionError(
        f"rig {rig.name!r} has no camera {camera!r} with events",
        f"Add a channel with `kind: events` to the profile, under cameras.{camera}.channels.",
    )
