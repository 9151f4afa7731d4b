"""Channels of the profile that no capture holds."""

from dataclasses import replace

import numpy as np

from lce_rig.calibrate import CalibrateOptions
from lce_rig.core.findings import Refusal
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.pipeline.findings import absent_channels
from tests.calibrate.boards import simulate

SEEN = {"000000": Refusal("image.none")}


def test_absent_channels_events_without_captures_are_named(rles):
    detections = Detections({("davis", "frames"): SEEN}, {"lidar": SEEN})
    ((finding,),) = absent_channels(rles, detections, None).values()
    assert finding.subject == "davis.events" and finding.severity == "warning"
    assert "`lce-rig calibrate s --channels frames`" in finding.advice_at("s")
    assert not any(absent_channels(rles, detections, ["frames"]).values())


def test_absent_channels_unused_is_none(rles):
    assert absent_channels(rles, Detections({}, {"lidar": SEEN}), None) == {}


def test_calibrate_mirrored_channel_is_named(rlfs):
    camera = rlfs.cameras["cam"]
    channels = {"frames": camera.channels["frames"], "events": camera.channels["frames"]}
    rig = rlfs.model_copy(update={"cameras": {"cam": camera.model_copy(update={"channels": channels})}})
    captures = simulate(12, 3)
    frames = {item.capture: item.image for item in captures}
    flip, in_plane = np.array([-1.0, 1, 1, 1])[:, None], np.array([-1.0, 1, 1, 1])
    events = {
        name: replace(image, T_cam_board=flip * image.T_cam_board * in_plane)
        for name, image in frames.items()
    }
    images = {("cam", "frames"): frames, ("cam", "events"): events}
    scans = {"lidar": {item.capture: list(item.places) for item in captures}}
    (c,), _ = calibrate_detections(rig, Detections(images, scans), CalibrateOptions("paper"))
    found = [(f.subject, f.severity) for f in c.findings if f.code == "shortage.channel_rejected"]
    assert c.channels == ("frames",) and found == [("cam.events", "note")]
