"""Frames of AEDAT4 files: every pixel, and the middle of the exposure whichever program wrote them."""

import re
from datetime import timedelta

import numpy as np
import pytest

from lce_rig.core.findings import Losses
from lce_rig.io.events.aedat4 import Aedat4File
from tests.io.events.aedat4_files import RawFrame, write_davis
from tests.io.events.encoders import random_events

START_US = 1_700_000_000_000_000
RNG = np.random.default_rng(0)
GREY = RNG.integers(0, 256, (260, 346), dtype=np.uint8)
COLOUR = RNG.integers(0, 256, (260, 346, 3), dtype=np.uint8)


def read(path, losses=None):
    file = Aedat4File(path)
    number = file.first_stream("frame")
    assert number is not None
    return list(file.frames(number, losses or Losses()))


@pytest.mark.parametrize("style", ["dv", "dv-processing"])
def test_frames_are_stamped_at_mid_exposure(tmp_path, style):
    frames = [RawFrame(START_US + 40_000 * k, 8001, GREY, style) for k in range(3)]
    found = read(write_davis(tmp_path / "a.aedat4", [random_events(500, 1, start_us=START_US)], frames))
    assert [f.mid_exposure_ns for f in found] == [
        (START_US + 40_000 * k) * 1000 + 4_000_500 for k in range(3)
    ]
    assert all(f.exposure_ns == 8_001_000 and np.array_equal(f.pixels, GREY) for f in found)


def test_frame_unknown_exposure_keeps_stamp(tmp_path):
    (frame,) = read(write_davis(tmp_path / "a.aedat4", [], [RawFrame(START_US, 8000, GREY, "stamp only")]))
    assert (frame.mid_exposure_ns, frame.exposure_ns) == (START_US * 1000, 0)


def test_colour_frames_are_blue_green_red(tmp_path):
    with_alpha = np.dstack([COLOUR, np.full((260, 346), 9, np.uint8)])
    frames = [RawFrame(START_US, 0, COLOUR), RawFrame(START_US + 1, 0, with_alpha)]
    for frame in read(write_davis(tmp_path / "a.aedat4", [], frames)):
        assert np.array_equal(frame.pixels, COLOUR)


def test_dv_processings_own_frames_are_read(tmp_path):
    dv = pytest.importorskip("dv_processing")
    for compression in (dv.CompressionType.NONE, dv.CompressionType.LZ4, dv.CompressionType.ZSTD):
        path = tmp_path / f"{compression.name}.aedat4"
        config = dv.io.MonoCameraWriter.Config("DAVIS346_0", compression)
        config.addEventStream((346, 260))
        config.addFrameStream((346, 260))
        writer = dv.io.MonoCameraWriter(str(path), config)
        for k, pixels in enumerate((GREY, COLOUR)):
            frame = dv.Frame(START_US + 40_000 * k, pixels)
            frame.exposure = timedelta(microseconds=8000)
            writer.writeFrame(frame)
        del writer
        grey, colour = read(path)
        assert (grey.mid_exposure_ns, grey.exposure_ns) == ((START_US + 4000) * 1000, 8_000_000)
        assert colour.mid_exposure_ns == (START_US + 44_000) * 1000
        assert np.array_equal(grey.pixels, GREY) and np.array_equal(colour.pixels, COLOUR)


def test_damaged_frame_is_skipped_and_counted(tmp_path):
    frames = [RawFrame(START_US + 40_000 * k, 8000, GREY) for k in range(3)]
    path = write_davis(tmp_path / "a.aedat4", [], frames)
    data = bytearray(path.read_bytes())
    second = [found.start() for found in re.finditer(b"FRME", data)][-2]
    data[second : second + 4] = b"????"
    path.write_bytes(data[:-100])
    losses = Losses()
    assert [f.mid_exposure_ns for f in read(path, losses)] == [(START_US + 4000) * 1000]
    assert losses.by_code() == {"recording.broken_packets": 1, "recording.torn_end": 1}


@pytest.mark.dataset
def test_real_davis_file_equals_vendor_reader(recordings):
    dv = pytest.importorskip("dv_processing")
    path = recordings / "events" / "davis346_short.aedat4"
    truth = dv.io.MonoCameraRecording(str(path))
    found = read(path)
    assert len(found) == 4
    for frame in found:
        other = truth.getNextFrame()
        # Their library moves the stamps of old files to the start of the exposure.
        exposure_us = other.exposure // timedelta(microseconds=1)
        assert frame.mid_exposure_ns == other.timestamp * 1000 + exposure_us * 500
        assert np.array_equal(frame.pixels, other.image)
