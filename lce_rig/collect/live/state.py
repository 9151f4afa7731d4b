"""Options of a live collection, a snapshot of its state for the views, and its report."""

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.collect.guidance.planner import Coverage
from lce_rig.core.errors import LceRigError, SourceError
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array

Ending = Literal["enough", "frames", "timeout", "exhausted", "stopped", "lost"]
"""enough: the target is predicted to be met; frames: as many captures as wanted; timeout: the time is over;
exhausted: nothing new was shown for `LiveOptions.idle_s`; stopped: by the user; lost: a sensor is gone."""

Key = Literal["stop", "capture", "next"]
"""stop: end; capture: take what is seen now; next: propose another placement."""


@dataclass(frozen=True)
class TakeBack:
    """A request to reject the last capture of this run.

    Attributes:
        name: name of the capture shown to the user: another one stays; "" for the last one.
    """

    name: str = ""


#: Time for which a board must rest before its capture, beyond the first half second, s.
HOLD_S = 1.5


@dataclass(frozen=True)
class LiveOptions:
    """Options of a live collection.

    Attributes:
        n_wanted: number of captures in the session at which to end; None to end at the target accuracy.
        timeout_s: longest duration; None without limit.
        hold_s: time for which a board stands still before its capture, beyond the first half second.
        lost_s: time to wait for a lost sensor.
        goes_on: whether to continue after the target is met, until asked to stop.
        idle_s: longest time without a capture, for unattended runs; None without limit.
    """

    n_wanted: int | None = None
    timeout_s: float | None = None
    hold_s: float = HOLD_S
    lost_s: float = 60.0
    goes_on: bool = False
    idle_s: float | None = None

    @property
    def is_open(self) -> bool:
        """Whether to continue once the target is predicted to be met."""
        return self.goes_on or self.n_wanted is not None


@dataclass
class LiveReport:
    """Outcome of a live collection.

    Attributes:
        ending: cause of its end.
        is_enough: whether the profile's target is predicted to be met.
        captured: names of the new captures, in order, without those taken back.
        taken_back: names of the captures that were taken back, in order.
        latencies_s: time from each decision until its capture was safe on the disk.
        n_frames: frames processed.
        n_lost: samples lost or dropped, by sensor.
        error: error of the permanently lost sensor; None if there is none.
        notes: other remarks.
        predicted: the predicted standard deviations, for each camera and LiDAR with a prediction.
        n_recorded: samples of the raw streams on the disk; None if they were not recorded.
        recording_error: why the recording ended before the collection; None if it did not.
    """

    ending: Ending = "stopped"
    is_enough: bool = False
    captured: list[str] = field(default_factory=list)
    taken_back: list[str] = field(default_factory=list)
    latencies_s: list[float] = field(default_factory=list)
    n_frames: int = 0
    n_lost: dict[str, int] = field(default_factory=dict)
    error: SourceError | None = None
    notes: list[str] = field(default_factory=list)
    predicted: list[Finding] = field(default_factory=list)
    n_recorded: int | None = None
    recording_error: LceRigError | None = None


Phase = Literal["starting", "searching", "moving", "holding", "saving", "refused", "enough", "lost", "ended"]
"""starting: no sensor has sent yet; searching: not every sensor sees the board; moving: the board has to go
elsewhere, or moves; holding: it stands still and is about to be captured; saving: it is being written;
refused: it stands still where it adds nothing; enough: you may stop; lost: a sensor is gone; ended."""

Sound = Literal["tick", "captured", "taken_back", "refused", "enough", "lost"]


class StreamState(NamedTuple):
    """State of one stream, and whether it shows the board.

    Attributes:
        name: "cam.frames", "lidar".
        rate_hz: samples per second.
        n_lost: samples lost or dropped.
        sees_board: None if no search was made.
        reason: why the board is not seen, or the sensor's fault, with the action; "" while all is well.
        figures: short values of the detection: "2 rings, 3.1 m", "0.05 px".
    """

    name: str
    rate_hz: float = 0.0
    n_lost: int = 0
    sees_board: bool | None = None
    reason: str = ""
    figures: str = ""


class Cue(NamedTuple):
    """An event with a sound.

    Attributes:
        number: rises with every cue, so that a view plays each once.
        sound: name of the sound.
    """

    number: int
    sound: Sound


class Drawing(NamedTuple):
    """The camera's last image, with the present and the target outline of the board.

    Attributes:
        camera: name of the stream.
        pixels: (H, W) or (H, W, 3) BGR uint8.
        present_px: (K, 2) closed outline of the board; None if it is not seen.
        wanted_px: (K, 2) closed outline of the placement wanted next; None without one. Points outside the
            lens's field of view are NaN.
        is_there: whether the board is at the wanted placement.
        present, wanted: (4, 4) T_cam_board of both; None like their outlines.
    """

    camera: str
    pixels: NDArray[np.uint8]
    present_px: Array | None = None
    wanted_px: Array | None = None
    is_there: bool = False
    present: Array | None = None
    wanted: Array | None = None


class LiveState(NamedTuple):
    """Snapshot of a live collection.

    Attributes:
        rig, session: the profile's name and the session's folder.
        elapsed_s: time since the start of the collection.
        phase: phase of the collection.
        headline: the one thing to do, large: "one step left, 0.5 m closer".
        detail: reason or progress, smaller; "" without either.
        hold_s: time that the board must still be held; None unless it is being held.
        n_captures: number of captures in the session.
        n_wanted: target number of captures; None if the target accuracy decides.
        goes_on: approximate number of further captures, and why; "" if there are enough.
        last_capture: name of the capture that would be taken back; "" without one.
        streams: every stream.
        drawing: the guiding camera's image; None before the first.
        coverage: coverage of the reachable placements by the captures; None without guidance.
        sigma_deg, sigma_mm: predicted 1-sigma of rotation and translation now; NaN with few captures.
        target_deg, target_mm: the profile's targets.
        cues: the latest few, oldest first.
        log: the latest messages, oldest first.
        notes: lasting remarks, in words.
        requires_still_boards: whether boards must stand still, see `SyncVerdict`.
        n_logged: messages since the beginning, of which `log` holds the latest.
    """

    rig: str
    session: str
    elapsed_s: float
    phase: Phase
    headline: str
    detail: str
    hold_s: float | None
    n_captures: int
    n_wanted: int | None
    streams: tuple[StreamState, ...]
    drawing: Drawing | None
    coverage: Coverage | None
    sigma_deg: float
    sigma_mm: float
    target_deg: float
    target_mm: float
    cues: tuple[Cue, ...] = ()
    log: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    n_logged: int = 0
    last_capture: str = ""
    goes_on: str = ""
    requires_still_boards: bool = True
