"""The check that streams overlap in time, by their own clocks."""

from collections.abc import Mapping

from lce_rig.core.data import Stream
from lce_rig.core.errors import SourceError
from lce_rig.io.protocol import Span
from lce_rig.rig import Rig
from lce_rig.timing.rig_time import rig_offset_ns

_MAX_OFFSET_S = 3600.0
# Spans are read from a recording's ends, without reading what lies between.
_ROUGH_S = 0.2
# Sensors are switched on and off one after the other.
_USUAL_LAG_S = 2.0


def check_overlap(
    scans: Mapping[Stream, Span | None], others: Mapping[Stream, Span | None], rig: Rig
) -> list[str]:
    """Make sure that images and events run while the LiDAR does.

    Args:
        scans: streams of LiDARs.
        others: streams of cameras.
        rig: its `expected_offset_s` are added to the timestamps.

    Returns:
        Notes on streams that cover only a part of the scans.

    Raises:
        SourceError: a stream lies wholly before or after the scans; it says how far, and the remedy.
    """
    notes = []
    for lidar, lidar_span in sorted(scans.items()):
        for camera, camera_span in sorted(others.items()):
            if lidar_span is not None and camera_span is not None:
                lidar_ns, camera_ns = _on_rig(lidar, lidar_span, rig), _on_rig(camera, camera_span, rig)
                notes += _compare(camera, camera_ns, lidar, lidar_ns)
    return notes


def _compare(camera: Stream, camera_ns: Span, lidar: Stream, lidar_ns: Span) -> list[str]:
    overlap_s = (min(camera_ns[1], lidar_ns[1]) - max(camera_ns[0], lidar_ns[0])) * 1e-9
    if overlap_s < -_ROUGH_S:
        raise _apart(camera, camera_ns, lidar, lidar_ns, -overlap_s)
    length_s = (lidar_ns[1] - lidar_ns[0]) * 1e-9
    if length_s - overlap_s <= _USUAL_LAG_S:
        return []
    return [
        f"{camera}: {camera.kind} cover {max(overlap_s, 0.0):.1f} of the {length_s:.1f} s of {lidar}'s scans"
    ]


def _apart(camera: Stream, camera_ns: Span, lidar: Stream, lidar_ns: Span, apart_s: float) -> SourceError:
    key = f"cameras.{camera.sensor}.channels.{camera.channel}.timestamps.expected_offset_s"
    starts_s = (lidar_ns[0] - camera_ns[0]) * 1e-9
    hint = f"If they were recorded together, add the difference of their clocks to {key} in the profile"
    if abs(starts_s) <= _MAX_OFFSET_S:
        hint += f" ({starts_s:+.1f} s if both were started at once)."
    else:
        hint = "Record both at the same time on one computer's clock, preferably into one bag."
    return SourceError(
        f"{camera}: {camera.kind} run from {_said(camera_ns[0])} to {_said(camera_ns[1])} s, "
        f"scans from {_said(lidar_ns[0])} to {_said(lidar_ns[1])} s: {apart_s:.1f} s apart",
        hint,
    )


def _on_rig(stream: Stream, span_ns: Span, rig: Rig) -> Span:
    offset_ns = rig_offset_ns(stream, rig)
    return span_ns[0] + offset_ns, span_ns[1] + offset_ns


def _said(t_ns: int) -> str:
    return f"{t_ns * 1e-9:.3f}"
