"""How a live collection is to go, and how it went."""

from dataclasses import dataclass, field
from typing import Literal

from lce_rig.core.errors import SourceError

Ending = Literal["enough", "frames", "timeout", "exhausted", "stopped", "lost"]
"""enough: the target is predicted to be met; frames: as many captures as wanted; timeout: the time is over;
exhausted: nothing new was shown for `LiveOptions.idle_s`; stopped: by the user; lost: a sensor is gone."""

Key = Literal["stop", "capture", "next"]
"""stop: end; capture: take what is seen now; next: propose another placement."""

#: How long a board stands still before it is captured, beyond the first half second.
HOLD_S = 1.5


@dataclass(frozen=True)
class LiveOptions:
    """How a live collection goes.

    Attributes:
        n_wanted: captures that the session is to hold; None until the target is predicted to be met.
        timeout_s: ends after so long; None never.
        hold_s: how long a board stands still before it is captured, beyond the first half second.
        lost_s: how long a lost sensor is waited for.
        goes_on: whether to go on when the target is met, until told to stop.
        idle_s: ends after so long without a capture, for runs that nobody looks after; None never.
        search_interval_s: how often a whole picture is searched while no board is in sight.
    """

    n_wanted: int | None = None
    timeout_s: float | None = None
    hold_s: float = HOLD_S
    lost_s: float = 60.0
    goes_on: bool = False
    idle_s: float | None = None
    search_interval_s: float = 0.3

    @property
    def is_open(self) -> bool:
        """Whether to go on when the target is predicted to be met."""
        return self.goes_on or self.n_wanted is not None


@dataclass
class LiveReport:
    """How a live collection went.

    Attributes:
        ending: why it ended.
        is_enough: whether the session holds enough for the profile's target, as far as is known.
        captured: names of the new captures, in order.
        latencies_s: from each decision until its capture was safe on the disk.
        n_frames: frames looked at.
        n_skipped: frames that came while one before was looked at.
        n_lost: what sensors lost or nobody took, by sensor.
        lost: sensors that were lost when it ended, and why, by name.
        error: the sensor that is lost for good; None where none is.
        notes: what else was odd.
        n_recorded: samples of the raw streams on the disk; None where they were not recorded.
    """

    ending: Ending = "stopped"
    is_enough: bool = False
    captured: list[str] = field(default_factory=list)
    latencies_s: list[float] = field(default_factory=list)
    n_frames: int = 0
    n_skipped: int = 0
    n_lost: dict[str, int] = field(default_factory=dict)
    lost: dict[str, SourceError] = field(default_factory=dict)
    error: SourceError | None = None
    notes: list[str] = field(default_factory=list)
    n_recorded: int | None = None
