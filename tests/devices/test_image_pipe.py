"""Pictures over real pipes from real programs."""

import shutil
import sys
import time
from itertools import islice

import numpy as np
import pytest

from lce_rig.core.data import Image
from lce_rig.core.errors import SourceError
from lce_rig.devices.pipe import ImagePipeSource
from lce_rig.rig import load_rig
from tests.devices.attached import attached
from tests.shared import has_ended, wait_until

pytestmark = pytest.mark.realtime
WIDTH, HEIGHT = 32, 18


def camera(*command, pixel_format="GREY"):
    settings = load_rig("rlfs").cameras["cam"]
    driver = settings.driver.model_copy(update={"command": command, "pixel_format": pixel_format})
    return settings.model_copy(update={"driver": driver, "resolution_px": (WIDTH, HEIGHT)})


def grey_pictures(n):
    return [np.full((HEIGHT, WIDTH), 30 + 10 * k, np.uint8) for k in range(n)]


def raw(pictures):
    return b"".join(picture.tobytes() for picture in pictures)


def levels(images):
    return [float(image.mean()) for image in images]


# What follows runs real programs at the other end of a real pipe.

WRITE = (
    "import sys, time; out = sys.stdout.buffer; data = open(sys.argv[1], 'rb').read(); "
    "out.write(data); out.flush(); "
)


def child(tmp_path, data, then="time.sleep(60)"):
    (tmp_path / "pictures").write_bytes(data)
    return [sys.executable, "-c", WRITE + then, str(tmp_path / "pictures")]


def take(samples, n):
    return [sample for sample in islice(samples, n) if isinstance(sample, Image)]


def test_image_pipe_timestamps_images_on_arrival(tmp_path):
    command = child(tmp_path, raw(grey_pictures(5)))
    before_ns = time.time_ns()
    with attached(ImagePipeSource("cam", camera(*command))) as (source, samples):
        images = take(samples, 5)
        status = source.status()
    assert [image.count for image in images] == [0, 1, 2, 3, 4]
    assert {image.pixels.shape[:2] for image in images} == {(HEIGHT, WIDTH)}
    stamps = [image.stamp_ns for image in images]
    assert stamps == sorted(stamps) == [image.host_ns for image in images]
    assert before_ns < stamps[0] and stamps[-1] < time.time_ns()
    assert (images[0].sensor, images[0].channel) == ("cam", "frames")
    assert status.n_samples == 5
    assert status.clock is not None and status.clock.code == "clock.arrival"


def test_image_pipe_reassembles_split_images(tmp_path):
    cut = "[(out.write(data[k : k + 7]), out.flush()) for k in range(0, len(data), 7)]; time.sleep(60)"
    command = child(tmp_path, raw(grey_pictures(2)), cut)
    with attached(ImagePipeSource("cam", camera(*command))) as (source, samples):
        assert levels([image.pixels for image in take(samples, 4)]) == [30, 40, 30, 40]
        assert source.status().problems == ()


def test_image_pipe_reports_output_of_dead_program(tmp_path):
    payload = raw(grey_pictures(2))[:-100]
    command = child(tmp_path, payload, "sys.stderr.write('no signal\\nbye\\n'); sys.exit(3)")
    with (
        attached(ImagePipeSource("cam", camera(*command))) as (_, samples),
        pytest.raises(SourceError) as caught,
    ):
        take(samples, 5)
    assert all(figure in caught.value.what for figure in ("code 3", "1 images"))
    assert "signal | bye" in caught.value.hint


def test_image_pipe_missing_program_is_named():
    with pytest.raises(SourceError, match="no-such-program") as caught:
        attached(ImagePipeSource("cam", camera("no-such-program"))).__enter__()
    assert "Install the program" in caught.value.hint
    with pytest.raises(SourceError, match="cam"):
        attached(ImagePipeSource("cam", camera())).__enter__()
    with pytest.raises(SourceError, match="H264"):
        attached(ImagePipeSource("cam", camera("true", pixel_format="H264"))).__enter__()


def test_image_pipe_stubborn_child_is_ended(tmp_path):
    then = (
        "import os, signal, subprocess; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
        "inner = subprocess.Popen(['sleep', '60']); "
        "open(sys.argv[1] + '.pids', 'w').write(f'{os.getpid()} {inner.pid}'); "
        "[sys.stderr.write('x' * 10000) for _ in range(100)]; time.sleep(60)"
    )
    command = child(tmp_path, raw(grey_pictures(2)), then)
    with attached(ImagePipeSource("cam", camera(*command))) as (_, samples):
        assert len(take(samples, 2)) == 2
        wait_until((tmp_path / "pictures.pids").exists)
    for pid in (tmp_path / "pictures.pids").read_text().split():
        wait_until(lambda pid=pid: has_ended(pid))


def test_ffmpeg_is_read():
    ffmpeg = shutil.which("ffmpeg")
    if ffmpeg is None:
        pytest.skip("ffmpeg is not installed")
    size = f"testsrc2=size={WIDTH}x{HEIGHT}:rate=20"
    command = (ffmpeg, *f"-loglevel error -f lavfi -i {size} -pix_fmt bgr24 -f rawvideo -".split())
    with attached(ImagePipeSource("cam", camera(*command, pixel_format=None))) as (_, samples):
        images = take(samples, 5)
    assert {image.pixels.shape for image in images} == {(HEIGHT, WIDTH, 3)}
    assert images[0].pixels.std() > 20
