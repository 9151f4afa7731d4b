"""Everything that the checks of sensors look at."""

from collections.abc import Mapping
from dataclasses import dataclass

from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.devices.vlp16.web import WebReport
from lce_rig.doctor.observing import ObservedSensor
from lce_rig.rig import Rig


@dataclass(frozen=True, eq=False)
class SensorReport:
    """What is known of a rig's sensors.

    Attributes:
        rig: the profile.
        seen: what was observed, by the sensor's name.
        web: what the web page of each VLP-16 says, or why it says nothing, by name.
        boards: the board as each sensor shows it, by (sensor, channel), a LiDAR's channel is "": a note with
            its figures, or why it is not there.
    """

    rig: Rig
    seen: Mapping[str, ObservedSensor]
    web: Mapping[str, WebReport | SourceError]
    boards: Mapping[tuple[str, str], Finding]
