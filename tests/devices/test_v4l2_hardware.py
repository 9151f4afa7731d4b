"""A real video device, named by LCE_RIG_VIDEO: any camera, or the kernel's own (`sudo modprobe vivid`)."""

import os
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from lce_rig.core.data import Image
from lce_rig.core.errors import SourceError
from lce_rig.devices.pixel_formats import FORMATS
from lce_rig.devices.v4l2 import V4l2Source
from lce_rig.devices.video_device import VideoDevice, list_controls, read_control
from lce_rig.rig import load_rig
from tests.devices.attached import attached

pytestmark = pytest.mark.hardware
DEVICE = os.environ.get("LCE_RIG_VIDEO", "/dev/video0")
SIZE = tuple(int(n) for n in os.environ.get("LCE_RIG_VIDEO_SIZE", "640x360").split("x"))
# Its stamps of an end of frame lie in the future; those of a start of exposure do not.
VIVID = {"timestamp_source": 1, "osd_text_mode": 2}


@pytest.fixture(autouse=True)
def device_name():
    """The driver's name; skips where there is no device."""
    if not Path(DEVICE).exists():
        pytest.skip(f"{DEVICE} is not there: set LCE_RIG_VIDEO")
    device = VideoDevice(DEVICE, "cam")
    try:
        return device.driver
    finally:
        device.close()


@pytest.fixture
def vivid(device_name):
    """Skips where the device is not the kernel's virtual camera."""
    if device_name != "vivid":
        pytest.skip(f"{DEVICE} is a {device_name}, not vivid")


def camera(controls=None, **driver):
    settings = load_rig("rlfs").cameras["cam"]
    changed = settings.driver.model_copy(update={"device": DEVICE, "controls": controls or {}, **driver})
    return settings.model_copy(update={"driver": changed, "resolution_px": SIZE})


def take(samples, n):
    return [sample for sample in islice(samples, n) if isinstance(sample, Image)]


def test_v4l2_images_are_counted_timestamped_ordered(device_name):
    with attached(V4l2Source("cam", camera(VIVID if device_name == "vivid" else {}))) as (source, samples):
        images = take(samples, 20)
        status = source.status()
    assert {image.pixels.shape[:2] for image in images} == {SIZE[::-1]}
    counts = np.array([image.count for image in images])
    assert (np.diff(counts) >= 1).all()
    stamps = np.array([image.stamp_ns for image in images])
    assert (np.diff(stamps) > 0).all()
    ages_s = np.array([image.host_ns for image in images if image.host_ns is not None]) * 1.0 - stamps
    assert (ages_s > -50e6).all() and (ages_s < 2e9).all()
    assert status.clock is not None and status.clock.code == "clock.mid_exposure"
    assert status.n_samples >= 20


def test_a_running_camera_is_busy_for_others():
    with attached(V4l2Source("cam", camera())):
        with pytest.raises(SourceError, match=DEVICE) as caught, attached(V4l2Source("cam", camera())):
            pass
        assert "fuser -v" in caught.value.hint


@pytest.mark.parametrize(
    ("controls", "hint"),
    [
        ({"brightnes": 1}, "brightness"),
        ({"brightness": 1.5}, "v4l2-ctl"),
        ({"timestamp_source": "Dawn"}, "v4l2-ctl"),
        ({"menu": 2}, "v4l2-ctl"),
        ({"read_only_integer_32_bits": 1}, "v4l2-ctl"),
    ],
)
def test_v4l2_unsupported_controls_are_named(controls, hint, vivid):
    with (
        pytest.raises(SourceError, match=next(iter(controls))) as caught,
        attached(V4l2Source("cam", camera(controls))),
    ):
        pass
    assert hint in caught.value.hint


def test_controls_are_set_by_number(vivid):
    wanted = {"brightness": 77, "integer_64_bits": 1 << 40, "menu": 4, "gain_automatic": False}
    with attached(V4l2Source("cam", camera(wanted))) as (source, _):
        assert source.status().problems == ()
    device = VideoDevice(DEVICE, "cam")
    known = list_controls(device)
    assert [read_control(device, known[name]) for name in wanted] == [77, 1 << 40, 4, 0]
    device.close()


def test_v4l2_all_formats_give_same_image(vivid):
    still = VIVID | {"test_pattern": 0, "brightness": 128}
    pictures = {}
    device = VideoDevice(DEVICE, "cam")
    offered = [code for code in device.formats() if code in FORMATS]
    device.close()
    for code in offered:
        with attached(V4l2Source("cam", camera(still, pixel_format=code))) as (_, samples):
            pictures[code] = take(samples, 1)[0].pixels
    true = pictures["BGR3"].astype(int)
    assert len(pictures) >= 10
    for code, pixels in pictures.items():
        if pixels.ndim == 3:
            apart = np.abs(pixels.astype(int) - true).max(2)
            # Coarse chroma mixes the colours beside an edge of the bars.
            assert np.median(apart) <= 4, code
            assert np.mean(apart > 4) <= 0.05, code


def test_v4l2_triggered_camera_without_pulses_is_silent(vivid):
    with attached(V4l2Source("cam", camera({"percentage_of_dropped_buffers": 100}), silence_s=1.5)) as (
        _,
        samples,
    ):
        with pytest.raises(SourceError, match=r"1\.5 s") as caught:
            take(samples, 5)
        assert "FSYNC" in caught.value.hint
    with attached(V4l2Source("cam", camera({"percentage_of_dropped_buffers": 0}))):
        pass
