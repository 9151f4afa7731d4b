"""Channels of the profile that no capture holds."""

from lce_rig.core.findings import Refusal
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.findings import absent_channels

SEEN = {"000000": Refusal("image.none")}


def test_absent_channels_events_without_captures_are_named(rles):
    detections = Detections({("davis", "frames"): SEEN}, {"lidar": SEEN})
    (finding,) = absent_channels(rles, detections, None)
    assert finding.subject == "davis.events" and finding.severity == "warning"
    assert "`lce-rig calibrate s --channels frames`" in finding.advice_at("s")
    assert absent_channels(rles, detections, ["frames"]) == []


def test_absent_channels_unused_is_none(rles):
    assert absent_channels(rles, Detections({}, {"lidar": SEEN}), None) == []
