"""Cameras of the kernel's video interface; a preloaded library takes the kernel's side."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

KERNEL = Path(__file__).with_name("video_kernel.c")
READ = """
import json, sys
from itertools import islice
import numpy as np
from lce_rig.devices.v4l2 import V4l2Source
from lce_rig.rig import load_rig

settings = load_rig("rlfs").cameras["cam"]
plain = {"device": "/dev/null", "controls": {}, "frame_rate_hz": None, "pixel_format": None}
driver = settings.driver.model_copy(update=plain)
settings = settings.model_copy(update={"driver": driver, "resolution_px": (64, 48)})
for _ in range(2):  # opened a second time, the buffers are given back and asked for again
    with V4l2Source("cam", settings) as source:
        images = list(islice(source.samples(), 5))
        status = source.status()
print(json.dumps({
    "pixels": [image.pixels.tolist() for image in images], "counts": [image.count for image in images],
    "stamps_ns": [image.stamp_ns for image in images], "clock": status.clock.finding.code,
    "device": status.device, "problems": [each.code for each in status.problems]}))
"""


@pytest.fixture(scope="module")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("cc")
    if compiler is None or not Path("/usr/include/linux/videodev2.h").exists():
        pytest.skip("no C compiler, or no kernel headers")
    library = tmp_path_factory.mktemp("kernel") / "video_kernel.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, KERNEL, "-ldl"], check=True)
    return library


def read(kernel: Path, form: str, is_planar: bool = False) -> subprocess.CompletedProcess[str]:
    told = {"LD_PRELOAD": str(kernel), "VIDEO_FORMAT": form, "VIDEO_PLANES": str(int(is_planar))}
    return subprocess.run(
        [sys.executable, "-c", READ], env={**os.environ, **told}, capture_output=True, text=True, timeout=60
    )


@pytest.mark.parametrize("form", ["NV12", "UYVY"])
def test_images_come_whole_counted_and_stamped(kernel: Path, form: str) -> None:
    ran = read(kernel, form)
    assert ran.returncode == 0, ran.stderr
    said: dict[str, Any] = json.loads(ran.stdout)
    assert (
        form in said["device"]
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


def test_a_camera_that_delivers_planes_only_is_refused_with_the_way_to_read_it(kernel: Path) -> None:
    ran = read(kernel, "NM12", is_planar=True)
    assert ran.returncode != 0 and "SourceError" in ran.stderr and "gst-launch" in ran.stderr
