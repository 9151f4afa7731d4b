"""Opening cameras that are none, and the kernel's interface against its own headers."""

import json
import os
import shutil
import subprocess
import sys
from ctypes import sizeof
from pathlib import Path

import numpy as np
import pytest

from lce_rig.core.errors import SourceError
from lce_rig.devices import v4l2_abi as abi
from lce_rig.devices.v4l2 import V4l2Source
from lce_rig.devices.video_device import serial_number
from lce_rig.rig import load_rig
from tests.devices.attached import attached
from tests.notes import has_note

HEADER = Path("/usr/include/linux/videodev2.h")


def camera(device):
    settings = load_rig("rlfs").cameras["cam"]
    return settings.model_copy(update={"driver": settings.driver.model_copy(update={"device": device})})


def refusal(device):
    with pytest.raises(SourceError) as caught, attached(V4l2Source("cam", camera(device))):
        pass
    return caught.value


def test_v4l2_absent_camera_is_named():
    error = refusal("/dev/video-of-nobody")
    assert has_note([error.what], "'cam'", "/dev/video-of-nobody", "not there")
    assert "driver.device" in error.hint or "camera's cable" in error.hint


def test_v4l2_missing_device_setting_is_reported():
    error = refusal(None)
    assert error.what.startswith("cam:") and "profile" in error.what
    assert "this computer" in error.hint


def test_v4l2_device_without_capture_is_refused(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    os.mkfifo(tmp_path / "fifo")
    for path in (tmp_path / "file", tmp_path / "fifo", tmp_path, Path("/dev/null")):
        assert has_note([refusal(str(path)).what], "'cam'", str(path))


STRUCTURES = {
    "v4l2_capability": abi.Capability,
    "v4l2_fmtdesc": abi.FormatDescription,
    "v4l2_pix_format": abi.PixFormat,
    "v4l2_format": abi.Format,
    "v4l2_streamparm": abi.CaptureParameters,
    "v4l2_requestbuffers": abi.BufferRequest,
    "v4l2_buffer": abi.Buffer,
    "v4l2_query_ext_ctrl": abi.ControlQuery,
    "v4l2_ext_control": abi.V4l2Control,
    "v4l2_ext_controls": abi.V4l2Controls,
}
NUMBERS = {
    "V4L2_BUF_TYPE_VIDEO_CAPTURE": abi.VIDEO_CAPTURE,
    "VIDIOC_QUERYCAP": abi.QUERY_CAPABILITY,
    "VIDIOC_ENUM_FMT": abi.ENUMERATE_FORMATS,
    "VIDIOC_S_FMT": abi.SET_FORMAT,
    "VIDIOC_REQBUFS": abi.REQUEST_BUFFERS,
    "VIDIOC_QUERYBUF": abi.QUERY_BUFFER,
    "VIDIOC_QBUF": abi.QUEUE_BUFFER,
    "VIDIOC_DQBUF": abi.DEQUEUE_BUFFER,
    "VIDIOC_STREAMON": abi.STREAM_ON,
    "VIDIOC_STREAMOFF": abi.STREAM_OFF,
    "VIDIOC_S_PARM": abi.SET_PARAMETERS,
    "VIDIOC_G_EXT_CTRLS": abi.GET_CONTROLS,
    "VIDIOC_S_EXT_CTRLS": abi.SET_CONTROLS,
    "VIDIOC_QUERY_EXT_CTRL": abi.QUERY_CONTROL,
    "V4L2_CAP_VIDEO_CAPTURE": abi.CAP_VIDEO_CAPTURE,
    "V4L2_CAP_STREAMING": abi.CAP_STREAMING,
    "V4L2_CAP_DEVICE_CAPS": abi.CAP_DEVICE_CAPS,
    "V4L2_BUF_FLAG_ERROR": abi.BUFFER_ERROR,
    "V4L2_BUF_FLAG_TSTAMP_SRC_MASK": abi.STAMP_SOURCE_MASK,
    "V4L2_BUF_FLAG_TSTAMP_SRC_SOE": abi.STAMP_SOURCE_SOE,
    "V4L2_CTRL_FLAG_NEXT_CTRL": abi.NEXT_CONTROL,
    "V4L2_CTRL_TYPE_INTEGER64": abi.INTEGER64,
    "V4L2_CTRL_TYPE_INTEGER_MENU": abi.INTEGER_MENU,
    "V4L2_CID_EXPOSURE_ABSOLUTE": abi.EXPOSURE_ABSOLUTE_ID,
}
OFFSETS = {
    "v4l2_buffer, timestamp": abi.Buffer.timestamp.offset,
    "v4l2_buffer, sequence": abi.Buffer.sequence.offset,
    "v4l2_buffer, m": abi.Buffer.m.offset,
    "v4l2_buffer, length": abi.Buffer.length.offset,
    "v4l2_format, fmt": abi.Format.fmt.offset,
    "v4l2_streamparm, parm.capture.timeperframe": abi.CaptureParameters.numerator.offset,
    "v4l2_query_ext_ctrl, minimum": abi.ControlQuery.minimum.offset,
    "v4l2_query_ext_ctrl, flags": abi.ControlQuery.flags.offset,
    "v4l2_ext_control, value64": abi.V4l2Control.value.offset,
    "v4l2_ext_controls, controls": abi.V4l2Controls.controls.offset,
}


def test_v4l2_structures_match_the_kernel(tmp_path):
    compiler = shutil.which("cc")
    if compiler is None or not HEADER.exists():
        pytest.skip("no C compiler, or no kernel headers")
    asked = [f"sizeof(struct {name})" for name in STRUCTURES]
    asked += [f"offsetof(struct {place})" for place in OFFSETS] + list(NUMBERS)
    lines = "\n".join(f'printf("%lu\\n", (unsigned long)({text}) & 0xfffffffful);' for text in asked)
    source = tmp_path / "ask.c"
    source.write_text(
        f"#include <stdio.h>\n#include <stddef.h>\n#include <linux/videodev2.h>\nint main(void){{{lines}}}"
    )
    subprocess.run([compiler, "-o", tmp_path / "ask", source], check=True, capture_output=True)
    said = subprocess.run([tmp_path / "ask"], check=True, capture_output=True, text=True).stdout.split()
    ours = [sizeof(kind) for kind in STRUCTURES.values()] + list(OFFSETS.values()) + list(NUMBERS.values())
    assert dict(zip(asked, map(int, said), strict=True)) == dict(zip(asked, ours, strict=True))


def test_v4l2_serial_is_that_of_usb_device(tmp_path):
    # As the kernel lists a webcam and a camera of a CSI port.
    interface = tmp_path / "devices" / "usb1" / "1-4" / "1-4:1.0"
    interface.mkdir(parents=True)
    (interface.parent / "idVendor").write_text("046d\n")
    (interface.parent / "serial").write_text("2FE3A1B0\n")
    (tmp_path / "devices" / "usb1" / "serial").write_text("0000:00:14.0\n")  # of the hub
    (tmp_path / "devices" / "csi").mkdir()
    for name, device in (("video0", interface), ("video2", tmp_path / "devices" / "csi")):
        (tmp_path / "class" / name).mkdir(parents=True)
        (tmp_path / "class" / name / "device").symlink_to(device)
    found = {name: serial_number(name, tmp_path / "class") for name in ("video0", "video2", "video9")}
    assert found == {"video0": "2FE3A1B0", "video2": "", "video9": ""}


KERNEL = Path(__file__).with_name("video_kernel.c")
READ = """
import json, sys
from itertools import islice
import numpy as np
from lce_rig.devices.v4l2 import V4l2Source
from lce_rig.rig import load_rig
from tests.devices.attached import attached

settings = load_rig("rlfs").cameras["cam"]
plain = {"device": "/dev/null", "controls": {}, "frame_rate_hz": None, "pixel_format": None}
driver = settings.driver.model_copy(update=plain)
settings = settings.model_copy(update={"driver": driver, "resolution_px": (64, 48)})
for _ in range(2):  # opened a second time, the buffers are given back and asked for again
    with attached(V4l2Source("cam", settings)) as (source, samples):
        images = list(islice(samples, 5))
        status = source.status()
print(json.dumps({
    "pixels": [image.pixels.tolist() for image in images], "counts": [image.count for image in images],
    "stamps_ns": [image.stamp_ns for image in images], "clock": status.clock.code,
    "device": status.device, "problems": [each.code for each in status.problems]}))
"""


@pytest.fixture(scope="module")
def kernel(tmp_path_factory):
    compiler = shutil.which("cc")
    if compiler is None or not Path("/usr/include/linux/videodev2.h").exists():
        pytest.skip("no C compiler, or no kernel headers")
    library = tmp_path_factory.mktemp("kernel") / "video_kernel.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, KERNEL, "-ldl"], check=True)
    return library


def read(kernel, form, is_planar=False):
    told = {"LD_PRELOAD": str(kernel), "VIDEO_FORMAT": form, "VIDEO_PLANES": str(int(is_planar))}
    return subprocess.run(
        [sys.executable, "-c", READ], env={**os.environ, **told}, capture_output=True, text=True
    )


def test_v4l2_images_are_complete_counted_timestamped(kernel):
    ran = read(kernel, "UYVY")
    assert ran.returncode == 0, ran.stderr
    said = json.loads(ran.stdout)
    assert (
        "UYVY" in said["device"]
        and said["clock"] == "clock.mid_exposure"
        and said["problems"] == ["clock.exposure_unknown"]
    )
    counts = np.array(said["counts"])
    assert (np.diff(counts) >= 1).all() and (np.diff(said["stamps_ns"]) > 0).all()
    for pixels, count in zip(said["pixels"], counts, strict=True):
        # Luma of video range, no colour: grey = (Y - 16) 255 / 219.
        luma = 20 + np.arange(64) // 2 + count
        grey = np.clip((luma - 16.0) * 255 / 219, 0, 255)
        assert np.array(pixels).shape == (48, 64, 3)
        assert np.abs(np.array(pixels) - grey[None, :, None]).max() <= 2


def test_v4l2_planes_only_is_refused(kernel):
    ran = read(kernel, "NM12", is_planar=True)
    assert ran.returncode != 0 and "SourceError" in ran.stderr and "gst-launch" in ran.stderr
