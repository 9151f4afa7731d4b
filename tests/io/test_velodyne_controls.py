"""What the profile may ask of a VLP-16's packets."""

import numpy as np
import pytest

from lce_rig.core.errors import SourceError
from lce_rig.io.velodyne.stream import Vlp16Stream, read_controls
from lce_rig.rig.sensors import DriverSettings

from .vlp16_room import packets_of, push, room_scans, settings


@pytest.mark.parametrize(
    ("controls", "cause"),
    [
        ({"rpm": 600}, "no 'rpm'; it has position_port, cut_deg"),
        ({"position_port": "8308"}, "not a port"),
        ({"position_port": 0}, "not a port"),
        ({"cut_deg": True}, "not an angle"),
        ({"cut_deg": 500.0}, "not an angle"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_its_key(controls: dict[str, object], cause: str) -> None:
    driver = DriverSettings.model_validate({"controls": controls})
    with pytest.raises(SourceError, match=cause):
        read_controls("lidar", settings(driver=driver))


@pytest.mark.parametrize("cut_deg", [-90, 0, 37.5])
def test_the_seam_lies_where_the_profile_wants_it(cut_deg: float) -> None:
    driver = DriverSettings(controls={"cut_deg": cut_deg})
    stream = Vlp16Stream("lidar", settings(driver=driver))
    scans = push(stream, packets_of(room_scans(4)))
    assert len(scans) == 3 and stream.losses.n("scan.partial") == 2
    for scan in scans:
        azimuth_deg = np.degrees(np.unwrap(np.arctan2(scan.points[:, 1], scan.points[:, 0])))
        off_deg = (azimuth_deg[0] - cut_deg + 180) % 360 - 180
        assert -0.45 < off_deg <= 0.01
        assert np.ptp(azimuth_deg) == pytest.approx(359.8, abs=0.4)
