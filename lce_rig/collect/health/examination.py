"""Everything that the checks of sensors look at."""

from collections.abc import Mapping
from dataclasses import dataclass

from lce_rig.collect.health.observing import Observation
from lce_rig.core.errors import SourceError
from lce_rig.core.results import Refusal
from lce_rig.rig import Rig
from lce_rig.sources.live.velodyne_web import WebReport


@dataclass(frozen=True)
class Sight:
    """What a sensor shows of the board.

    Attributes:
        figure: the board's figures in words; "" where it is not there.
        refusal: why it is not there; None where it is.
        values: figures by name.
    """

    figure: str
    refusal: Refusal | None
    values: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Examination:
    """What is known of a rig's sensors.

    Attributes:
        rig: the profile.
        seen: what was observed, by the sensor's name.
        web: what the web page of each VLP-16 says, or why it says nothing, by name.
        boards: the board as each sensor shows it, by (sensor, channel); a LiDAR's channel is "".
    """

    rig: Rig
    seen: Mapping[str, Observation]
    web: Mapping[str, WebReport | SourceError]
    boards: Mapping[tuple[str, str], Sight]
