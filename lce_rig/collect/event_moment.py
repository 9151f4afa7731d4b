"""Whether a detection is worth a capture for an event camera.

Events need motion, LiDAR wants stillness. A detection will do where, in a camera that sends events, the board

- is not faster than `quality.max_board_speed_mps`,
- made at least `quality.min_events_px` events a pixel of it in the second before,
- and moves at 3 cm/s or more, or made plenty of events all the same: it has just stopped, or the rig moves.
  Light that flickers does not count.
"""

from collections.abc import Sequence

import numpy as np

from lce_rig.collect.board_tracker import BoardDetection, CaptureMoment, ImageKey
from lce_rig.collect.findings import IMAGE_MADE_FEW_EVENTS, IMAGE_STOOD_STILL, READ_NO_EVENTS_AT_SCAN
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.detect.events.event_limits import explain_missing_board, look_for_flicker, too_fast
from lce_rig.detect.events.figures import MEMORY_NS, event_quality, outline_px
from lce_rig.rig import Rig
from lce_rig.timing.event_buffer import EventCut
from lce_rig.timing.rig_time import rig_time_ns

SPEED_WINDOW_S = 0.5
# Neither too few events nor smear.
BEST_SPEED_MPS = 0.1

_LEAST_DETECTIONS = 3
# Slower boards make no events, unless there are as many a pixel in a second as below.
_MIN_SPEED_MPS = 0.03
_PLENTY_EVENTS_PX = 4.0


def judge_detection(
    detection: BoardDetection, around: Sequence[BoardDetection], rig: Rig
) -> CaptureMoment | Refusal | None:
    """Check whether a detection is worth a capture.

    Args:
        detection: the board in its frame.
        around: all detections shortly before and after, itself among them.
        rig: the profile.

    Returns:
        The moment; why it is none; or None where the tracker has counted why.
    """
    cuts = {cut.sensor: cut for cut in detection.frame.events}
    if detection.images and not cuts:
        return READ_NO_EVENTS_AT_SCAN.refusal()
    watched = [key for key in sorted(detection.images) if key[0] in cuts]
    if not watched:
        # The events explain why their images do not show the board.
        for (camera, channel), refusal in sorted(detection.unseen.items()):
            if rig.cameras[camera].channels[channel].kind == "events" and camera in cuts:
                stamp_ns = detection.frame.time_ns - cuts[camera].offset_ns
                recent = cuts[camera].events.between(stamp_ns - MEMORY_NS, stamp_ns)
                return explain_missing_board(recent, stamp_ns, refusal, rig.quality)
        return None
    if not detection.lidars:
        return None
    judged = [_judge_camera(key, detection, around, cuts[key[0]], rig) for key in watched]
    return next((verdict for verdict in judged if isinstance(verdict, CaptureMoment)), judged[0])


def _judge_camera(
    key: ImageKey,
    detection: BoardDetection,
    around: Sequence[BoardDetection],
    cut: EventCut,
    rig: Rig,
) -> CaptureMoment | Refusal | None:
    if key in detection.unfit:
        return detection.unfit[key]
    motion = _follow(key, around)
    if motion is None:
        return None
    image = next(i for i in detection.frame.images if (i.sensor, i.channel) == key)
    # Frames and events of one camera may have clocks, or delays, of their own.
    time_ns = rig_time_ns(image, rig)
    stamp_ns = (detection.frame.time_ns if time_ns is None else time_ns) - cut.offset_ns
    # Count the events per pixel of the board in the second before its image.
    recent = cut.events.between(stamp_ns - MEMORY_NS, stamp_ns)
    camera, board = rig.cameras[key[0]], detection.images[key]
    outline = outline_px(board.T_cam_board, rig.board.to_board(), camera.to_intrinsics())
    (speed_mps, unsteady_m), events_px = motion, event_quality(recent, stamp_ns, outline).events_px
    limits = rig.quality
    made = {"events_px": events_px, "min_events_px": limits.min_events_px}
    if speed_mps > limits.max_board_speed_mps:
        return too_fast(speed_mps, limits)
    is_slow = speed_mps < _MIN_SPEED_MPS
    if is_slow and events_px < max(_PLENTY_EVENTS_PX, limits.min_events_px):
        return IMAGE_STOOD_STILL.refusal(**made)
    if events_px < limits.min_events_px:
        return IMAGE_MADE_FEW_EVENTS.refusal(**made, speed_mps=speed_mps)
    if is_slow:
        lamps = look_for_flicker(recent)
        if lamps is not None:
            return lamps
    figures = {"speed_mps": speed_mps, "unsteady_m": unsteady_m, "events_px": events_px}
    return CaptureMoment(detection, {name: round(figure, 5) for name, figure in figures.items()})


def _follow(key: ImageKey, around: Sequence[BoardDetection]) -> tuple[float, float] | None:
    """Fit a straight and steady way to the plate's middle: speed in m/s, and the rms distance from it in m.

    The middle is well known even where the tilt is not. None where the board was seen too seldom.
    """
    seen = [s for s in around if key in s.images]
    if len(seen) < _LEAST_DETECTIONS:
        return None
    time_s = 1e-9 * np.array([s.frame.time_ns - seen[0].frame.time_ns for s in seen])
    way: Array = np.stack([s.images[key].T_cam_board[:3, 3] for s in seen])
    time_s, way = time_s - time_s.mean(), way - way.mean(axis=0)
    velocity = time_s @ way / (time_s @ time_s)
    rest = way - time_s[:, None] * velocity
    return float(np.linalg.norm(velocity)), float(np.sqrt(np.mean(np.sum(rest**2, axis=1))))
