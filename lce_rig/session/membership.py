"""Which samples a session takes: one of each sensor, of sensors that its rig has."""

from collections.abc import Sequence

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.errors import SessionError
from lce_rig.rig import Rig


def check_samples(rig: Rig, images: Sequence[Image], scans: Sequence[Scan], events: Sequence[Events]) -> None:
    """Make sure that samples can be one capture of a rig.

    Raises:
        SessionError: there are none, two of one sensor, one of a sensor that the rig lacks, or events of
            another resolution than the camera's.
    """
    keys = [(i.sensor, i.channel) for i in images]
    keys += [(s.sensor, "") for s in scans] + [(e.sensor, "raw events") for e in events]
    if len(set(keys)) < len(keys) or not keys:
        raise SessionError(
            "a capture needs one picture a camera channel, one scan a lidar and one stretch of events "
            "a camera at most, and not nothing"
        )
    for image in images:
        camera = rig.cameras.get(image.sensor)
        if camera is None or image.channel not in camera.channels:
            raise SessionError(f"rig {rig.name!r} has no camera channel {image.sensor}.{image.channel}")
    for scan in scans:
        if scan.sensor not in rig.lidars:
            raise SessionError(f"rig {rig.name!r} has no lidar {scan.sensor!r}")
    for stretch in events:
        event_channel(rig, stretch.sensor)
        size, wanted = (stretch.width_px, stretch.height_px), rig.cameras[stretch.sensor].resolution_px
        if size != wanted:
            raise SessionError(
                f"events of {stretch.sensor} are of {size[0]}x{size[1]} pixels; "
                f"rig {rig.name!r} gives it {wanted[0]}x{wanted[1]}",
                "Is it another camera's recording? Else correct resolution_px in the profile.",
            )


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
        f"Give it a channel of `kind: events` in the profile, under cameras.{camera}.channels.",
    )
