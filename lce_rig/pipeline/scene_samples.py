"""Samples of a scene, as `drift` and `calibrate --scene` choose them from recordings of any length."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.geometry import Array, transform
from lce_rig.rig import Rig
from lce_rig.scene.outline_score import OutlineView
from lce_rig.scene.rig_motion import RigMotion, estimate_motion, firing_times_s
from lce_rig.session import Capture
from lce_rig.show.overlays.canvas import accumulated
from lce_rig.timing.scan_pairing import EventCut, event_channel, rig_offset_ns, rig_time_ns, stream_of

_Item = TypeVar("_Item")

# Of events about the time at which the LiDAR looks where the camera does: long enough for edges to show.
EVENTS_NS = 20_000_000


class Thinned(list[_Item]):
    """The items of a stream of any length: every one at first, every second once there are too many, ...

    Args:
        most: items that are kept.
    """

    def __init__(self, most: int) -> None:
        super().__init__()
        self._most, self._n_taken, self._stride = most, 0, 1

    def take(self, item: _Item) -> None:
        """Keep an item if it is its turn."""
        if self._n_taken % self._stride == 0:
            self.append(item)
        self._n_taken += 1
        if len(self) > self._most:
            self[:] = self[::2]
            self._stride *= 2


def read_events(capture: Capture, rig: Rig) -> tuple[EventCut, ...]:
    """Read the events of each camera of a capture.

    Raises:
        SessionError: a file is damaged.
    """
    cuts = []
    for camera in capture.event_cameras:
        if len(events := capture.events(camera)):
            offset_ns = rig_offset_ns(stream_of(events, rig), rig)
            first_ns, last_ns = int(events.t_ns[0]), int(events.t_ns[-1])
            cuts.append(EventCut((events,), first_ns, last_ns + 1, offset_ns, 0))
    return tuple(cuts)


def events_at_scans(cuts: Sequence[EventCut], scans: Sequence[Scan], rig: Rig) -> tuple[EventCut, ...]:
    """Narrow events to the time in which scans were fired."""
    times = [
        (start_ns, start_ns + (0 if scan.offset_ns is None else int(scan.offset_ns.max(initial=0))))
        for scan in scans
        if (start_ns := rig_time_ns(scan, rig)) is not None
    ]
    if not times:
        return ()
    start_ns, end_ns = min(start for start, _ in times), max(end for _, end in times)
    narrowed = (cut.between(start_ns - EVENTS_NS, end_ns + EVENTS_NS) for cut in cuts)
    return tuple(cut for cut in narrowed if cut is not None)


def image_or_events(
    rig: Rig,
    camera: str,
    images: Sequence[Image],
    cuts: Sequence[EventCut],
    scan: Scan,
    lens: Intrinsics,
    T_cam_lidar: Array,
    late_ns: int = 0,
) -> Image | Events | None:
    """Choose what a camera shows at a scan: a frame, another image, or events about the scan, in this order.

    Args:
        rig: the profile.
        camera: its name.
        images, cuts: of all cameras about the scan.
        scan: of the LiDAR.
        lens: of the camera.
        T_cam_lidar: (4, 4) rough extrinsics: they tell when the LiDAR looks where the camera does.
        late_ns: time offset of its events beyond the one that the profile expects.

    Returns:
        None if it shows nothing.
    """
    own = [image for image in images if image.sensor == camera]
    frames = rig.cameras[camera].first_channel("frames")
    own = [image for image in own if image.channel == frames] or own
    if own:
        return own[0]
    cut = next((each for each in cuts if each.sensor == camera), None)
    scan_ns = rig_time_ns(scan, rig)
    if cut is None or scan_ns is None or scan.offset_ns is None or not len(scan.points):
        return None
    pixels, is_valid = lens.project(transform(T_cam_lidar, scan.points))
    is_seen = is_valid & lens.is_inside(pixels)
    if not is_seen.any():
        return None
    middle_ns = scan_ns + int(np.median(scan.offset_ns[is_seen])) - late_ns
    about = cut.between(middle_ns - EVENTS_NS // 2, middle_ns + EVENTS_NS // 2)
    if about is None:
        return None
    # Copies: a view of the packets would keep these in memory.
    columns = {name: getattr(about.events, name).copy() for name in ("t_ns", "x", "y", "polarity")}
    return replace(about.events, **columns)


def moving(previous: Scan | None, scan: Scan) -> RigMotion | None:
    """Estimate the rig's motion at a scan; None if it stands still or cannot be estimated."""
    motion = None if previous is None else estimate_motion(previous, scan)
    return None if motion is None or motion.is_still else motion


def at_image(
    view: OutlineView, motion: RigMotion, scan: Scan, image: Image | Events, rig: Rig, late_ns: int = 0
) -> OutlineView | None:
    """Move the outlines of a scan to the time of the image; None if times are unknown.

    Args:
        view: of the scan and the image.
        motion: the rig's at the scan.
        scan: holds the outlines' points, or returns beside them.
        image: of the camera, or the events chosen in its place.
        rig: the profile.
        late_ns: time offset of the image's channel beyond the one that the profile expects.
    """
    points = view.outlines.points
    scan_ns, image_ns = rig_time_ns(scan, rig), rig_time_ns(image, rig)
    fired_s = firing_times_s(scan, points)
    if scan_ns is None or image_ns is None or fired_s is None:
        return None
    # Events were cut about their middle.
    middle_ns = EVENTS_NS // 2 if isinstance(image, Events) else 0
    after_s = 1e-9 * (image_ns + middle_ns + late_ns - scan_ns) - fired_s
    return replace(view, outlines=replace(view.outlines, points=motion.moved(points, after_s)))


def channel_of(image: Image | Events, rig: Rig) -> str:
    """Name the channel of an image, or the camera's channel of events."""
    return image.channel if isinstance(image, Image) else event_channel(rig, image.sensor) or ""


def picture_of(image: Image | Events) -> Image:
    """Return an image as it is, and events as a picture of where they were."""
    return image if isinstance(image, Image) else Image(image.sensor, "events", None, accumulated(image))
