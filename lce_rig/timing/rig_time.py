"""The rig's clock, the common time base of all sensors."""

from lce_rig.core.data import Events, Image, Sample, Stream
from lce_rig.rig import Rig


def event_channel(rig: Rig, camera: str) -> str | None:
    """Name a camera's channel of kind events; None where it has none."""
    return rig.cameras[camera].first_channel("events") if camera in rig.cameras else None


def stamp_of(sample: Sample) -> int | None:
    """Read a sample's timestamp, a packet's first, ns on the sensor's own clock; None without one."""
    if isinstance(sample, Events):
        return int(sample.t_ns[0]) if len(sample) else None
    return sample.stamp_ns


def stream_of(sample: Sample, rig: Rig) -> Stream:
    """Name the stream that a sample belongs to."""
    if isinstance(sample, Events):
        return Stream(sample.sensor, event_channel(rig, sample.sensor) or "", "events")
    if isinstance(sample, Image):
        return Stream(sample.sensor, sample.channel, "images")
    return Stream(sample.sensor, "", "scans")


def rig_offset_ns(stream: Stream, rig: Rig) -> int:
    """Return the profile's offset from a stream's timestamps to the rig's time."""
    if stream.kind == "scans":
        timestamps = rig.lidars[stream.sensor].timestamps
    else:
        timestamps = rig.cameras[stream.sensor].channels[stream.channel].timestamps
    return round(timestamps.expected_offset_s * 1e9)


def rig_time_ns(sample: Sample, rig: Rig) -> int | None:
    """Bring a sample's timestamp to the rig's time; None where it carries none."""
    stamp_ns = stamp_of(sample)
    return None if stamp_ns is None else stamp_ns + rig_offset_ns(stream_of(sample, rig), rig)
