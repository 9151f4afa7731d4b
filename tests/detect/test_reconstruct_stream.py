"""Pictures from a whole stream: at any stamp, one answer per stamp, the same however the stream arrives."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from moving_board import COLS, ROWS, Motion, board_events, cut, events_of, inner_corners_px

from lce_rig.core.data import Image
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Refusal
from lce_rig.detect.events.reconstructor import Reconstructor

MS = 1_000_000
DURATION_S = 1.6
STAMPS = [round((0.9 + 0.07 * k) * 1e9) for k in range(10)]
STEADY = Motion()
PAUSE = Motion(pause_s=1.0)


@pytest.fixture(scope="module")
def stream():
    return board_events(STEADY, DURATION_S)


def corner_rms_px(image, truth_px):
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(image.grey, (COLS - 1, ROWS - 1), flags=flags)
    if not found:
        return np.inf
    corners = corners.reshape(-1, 2)
    return min(np.sqrt(np.square(corners - order).sum(1).mean()) for order in (truth_px, truth_px[::-1]))


def errors_px(events, motion=STEADY, stamps=STAMPS):
    pictures = Reconstructor().reconstruct([events], stamps)
    truth = [inner_corners_px(motion, stamp / 1e9) for stamp in stamps]
    return np.array([corner_rms_px(image, corners) for image, corners in zip(pictures, truth, strict=True)])


def test_reconstructed_board_matches_truth_at_each_timestamp(stream):
    errors = errors_px(stream)
    assert np.isfinite(errors).mean() >= 0.9
    assert np.sqrt(np.mean(errors[np.isfinite(errors)] ** 2)) < 0.5


def test_reconstructed_image_persists_for_still_board():
    events = board_events(PAUSE, DURATION_S)
    stamps = [1_200 * MS, 1_500 * MS]
    errors = errors_px(events, PAUSE, stamps)
    assert (errors < 1.0).all()


def test_reconstruct_ignores_batch_boundaries(stream):
    whole, parts = (
        list(Reconstructor().reconstruct(batches, STAMPS[:4])) for batches in ([stream], cut(stream, 37))
    )
    for one, other in zip(whole, parts, strict=True):
        np.testing.assert_array_equal(one.pixels, other.pixels)


def test_reconstruct_uses_no_later_events(stream):
    stamp = STAMPS[3]
    early = stream.between(0, stamp + 1)
    whole = next(Reconstructor().reconstruct([stream], [stamp]))
    seen = next(Reconstructor().reconstruct([early], [int(early.t_ns[-1])]))
    assert isinstance(whole, Image) and isinstance(seen, Image)
    assert np.abs(whole.pixels.astype(int) - seen.pixels).mean() < 3


def test_reconstruct_answers_every_timestamp(stream):
    """Timestamps in the warm-up are refused."""
    stamps = [100 * MS, 300 * MS, *STAMPS]
    answers = list(Reconstructor().reconstruct([stream], stamps))
    assert len(answers) == len(stamps)
    assert isinstance(answers[0], Refusal)
    assert answers[0].code == "read.network_settling"
    assert answers[0].figure("seen_s") == pytest.approx(0.1, abs=0.01)
    assert all(isinstance(answer, Image) for answer in answers[2:])
    assert [answer.stamp_ns for answer in answers[2:]] == STAMPS
    assert {answer.channel for answer in answers[2:]} == {"events"}


def test_reconstruct_bad_events_are_an_error(stream):
    """Another resolution, or times that go back."""
    other = replace(stream.between(0, 10 * MS), width_px=640, height_px=480)
    for batches in ([stream, other], [stream, stream]):
        with pytest.raises(SourceError):
            list(Reconstructor().reconstruct(batches, [9_000 * MS]))


def test_reconstruct_skips_long_silence(stream):
    first, rest = stream.between(0, 800 * MS), stream.between(800 * MS, 10_000 * MS)
    hour_ns = 3_600 * 1_000 * MS
    later = replace(rest, t_ns=rest.t_ns + hour_ns)
    reconstructor = Reconstructor()
    answers = list(reconstructor.reconstruct([first, later], [hour_ns + 1_500 * MS]))
    assert isinstance(answers[0], Image)
    assert reconstructor.n_steps < 100


def test_reconstruct_recovers_from_flicker(stream):
    lamp = np.arange(0, 400 * MS, 10 * MS) + 400 * MS
    y, x = (a.ravel() for a in np.mgrid[0:120:2, 0:160:2])
    storm = events_of(
        np.repeat(lamp, len(x)),
        np.tile(x, len(lamp)),
        np.tile(y, len(lamp)),
        np.arange(len(lamp) * len(x)) % 2,
    )
    parts = [
        np.concatenate(pair)
        for pair in zip(*((e.t_ns, e.x, e.y, e.polarity) for e in (stream, storm)), strict=True)
    ]
    errors = errors_px(events_of(*parts), stamps=[1_300 * MS, 1_500 * MS])
    assert (errors < 1.0).all()
