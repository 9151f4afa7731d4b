"""Pictures over real pipes from real programs, and streams cut at any byte."""

import shutil
import sys
import time
from collections.abc import Callable
from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core.data import Image
from lce_rig.core.errors import SourceError
from lce_rig.devices.pipe import ImagePipeSource, ImageStream
from lce_rig.devices.pixel_formats import PixelDecoder
from lce_rig.rig import load_rig
from tests.devices.attached import attached
from tests.shared import has_ended, wait_until

WIDTH, HEIGHT = 32, 18


def camera(*command, pixel_format=None):
    settings = load_rig("rlfs").cameras["cam"]
    driver = settings.driver.model_copy(update={"command": command, "pixel_format": pixel_format})
    return settings.model_copy(update={"driver": driver, "resolution_px": (WIDTH, HEIGHT)})


def grey_pictures(n):
    return [np.full((HEIGHT, WIDTH), 30 + 10 * k, np.uint8) for k in range(n)]


def y4m(pictures, colour="420jpeg"):
    chroma = b"" if colour == "mono" else b"\x80" * (WIDTH * HEIGHT // 2)
    frames = b"".join(b"FRAME Ip\n" + picture.tobytes() + chroma for picture in pictures)
    return f"YUV4MPEG2 W{WIDTH} H{HEIGHT} F10:1 Ip A1:1 C{colour} XNOTE\n".encode() + frames


def raw(pictures):
    return b"".join(picture.tobytes() for picture in pictures)


STREAMS: dict[str, tuple[Callable[[list[np.ndarray]], bytes], Callable[[], ImageStream]]] = {
    "y4m": (y4m, ImageStream),
    "grey y4m": (lambda pictures: y4m(pictures, "mono"), ImageStream),
    "raw": (raw, lambda: ImageStream(PixelDecoder("GREY", WIDTH, HEIGHT))),
}


def levels(images):
    return [float(image.mean()) for image in images]


@pytest.mark.parametrize("kind", STREAMS)
@given(data=st.data())
def test_the_same_pictures_come_however_the_bytes_are_cut(kind, data):
    write, make = STREAMS[kind]
    stream, whole, payload = make(), make(), write(grey_pictures(3))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(payload)), max_size=12)))
    pieces = [payload[a:b] for a, b in zip([0, *cuts], [*cuts, len(payload)], strict=True)]
    came = [pixels for piece in pieces for pixels in stream.feed(piece)]
    at_once = list(whole.feed(payload))
    assert len(came) == 3
    assert all((a == b).all() for a, b in zip(came, at_once, strict=True))


@pytest.mark.parametrize("kind", ["grey y4m", "raw"])
def test_grey_values_are_kept(kind):
    write, make = STREAMS[kind]
    assert levels(list(make().feed(write(grey_pictures(3))))) == pytest.approx([30, 40, 50], abs=0.6)


@pytest.mark.parametrize("colour", ["420", "420mpeg2"])
def test_y4m_luma_is_of_video_range(colour):
    came = levels(list(ImageStream().feed(y4m(grey_pictures(3), colour))))
    assert came == pytest.approx([(level - 16) * 255 / 219 for level in (30, 40, 50)], abs=1)


@pytest.mark.parametrize(
    "begin",
    [
        b"YUV4MPEG2 W32 H18 C411\n",
        b"YUV4MPEG2 W32 H18 C420p10\n",
        b"YUV4MPEG2 F25:1\n",
        b"YUV4MPEG2 W64 H47 F30:1 C420jpeg\n",
        b"YUV4MPEG2 W63 H48 F30:1 C420jpeg\n",
        b"YUV4MPEG2 W60000 H60000 F30:1 C420jpeg\n",
        b"YUV4MPEG2 W346 H2 Cmono\nFRAME\n" + bytes(2 * 348) + b"FRAME\n",
        b"YUV4MPEG2 W32 H18\n" + b"FROME\n",
        b"YUV4MPEG2 " + b"x" * 5000,
    ],
)
def test_streams_that_cannot_be_read_are_refused(begin):
    with pytest.raises(ValueError):
        list(ImageStream().feed(begin))


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


def test_pictures_of_a_program_are_taken_as_they_arrive(tmp_path):
    command = child(tmp_path, y4m(grey_pictures(5)))
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


def test_raw_pictures_need_their_format_in_the_profile(tmp_path):
    command = child(tmp_path, raw(grey_pictures(2)))
    with attached(ImagePipeSource("cam", camera(*command, pixel_format="GREY"))) as (source, samples):
        assert levels([image.pixels for image in take(samples, 2)]) == [30, 40]
        assert source.status().problems == ()
    with (
        attached(ImagePipeSource("cam", camera(*command))) as (source, samples),
        pytest.raises(SourceError, match="Y4M") as caught,
    ):
        take(samples, 1)
    assert "driver.pixel_format" in caught.value.hint


def test_a_program_that_dies_is_quoted_with_what_it_left(tmp_path):
    payload = y4m(grey_pictures(2))[:-100]
    command = child(tmp_path, payload, "sys.stderr.write('no signal\\nbye\\n'); sys.exit(3)")
    with (
        attached(ImagePipeSource("cam", camera(*command))) as (_, samples),
        pytest.raises(SourceError) as caught,
    ):
        take(samples, 5)
    assert all(figure in caught.value.what for figure in ("code 3", "1 images"))
    assert "signal | bye" in caught.value.hint


def test_pictures_of_another_size_are_refused(tmp_path):
    command = child(tmp_path, b"YUV4MPEG2 W32 H20 Cmono\nFRAME\n" + bytes(32 * 20))
    with (
        attached(ImagePipeSource("cam", camera(*command))) as (_, samples),
        pytest.raises(SourceError, match="32x20 px"),
    ):
        take(samples, 1)


def test_a_program_that_is_not_there_is_named():
    with pytest.raises(SourceError, match="no-such-program") as caught:
        attached(ImagePipeSource("cam", camera("no-such-program"))).__enter__()
    assert "installed" in caught.value.hint
    with pytest.raises(SourceError, match="cam"):
        attached(ImagePipeSource("cam", camera())).__enter__()
    with pytest.raises(SourceError, match="H264"):
        attached(ImagePipeSource("cam", camera("true", pixel_format="H264"))).__enter__()


def test_a_talkative_stubborn_program_and_its_children_are_stopped(tmp_path):
    then = (
        "import os, signal, subprocess; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
        "inner = subprocess.Popen(['sleep', '60']); "
        "open(sys.argv[1] + '.pids', 'w').write(f'{os.getpid()} {inner.pid}'); "
        "[sys.stderr.write('x' * 10000) for _ in range(100)]; time.sleep(60)"
    )
    command = child(tmp_path, y4m(grey_pictures(2)), then)
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
    command = (ffmpeg, *f"-loglevel error -f lavfi -i {size} -pix_fmt yuv420p".split())
    with attached(ImagePipeSource("cam", camera(*command, "-f", "yuv4mpegpipe", "-"))) as (_, samples):
        images = take(samples, 5)
    assert {image.pixels.shape for image in images} == {(HEIGHT, WIDTH, 3)}
    assert images[0].pixels.std() > 20
