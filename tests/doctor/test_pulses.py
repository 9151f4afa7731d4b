"""Missing or additional frames per pulse are reported."""

from dataclasses import replace

import pytest

from lce_rig.doctor.checks import check_frames_of_pulses, check_pulses_sent

from .observed import camera, codes, examination, look, make_rig, sync_board


def with_sync(**sync):
    return make_rig(sync={"device": "/dev/null", **sync})


def with_trigger(**trigger):
    return with_sync(triggers={"cam": {"channel": 0, "rate_hz": 20.0, **trigger}})


def test_equal_images_and_pulses_are_a_note():
    line = look(check_frames_of_pulses, examination(camera(), sync_board()), "cam")
    assert line is not None and line.severity == "note"
    counts, delay = line.findings
    assert abs(counts.figure("n_frames") - counts.figure("n_pulses")) <= 1
    # A board that is 40 ppm fast is fitted to the computer's clock, so the delay is measured correctly.
    assert delay.figure("delay_ms") == pytest.approx(15.0, abs=0.01)
    assert delay.figure("delay_scatter_ms") < 0.01


def test_late_images_match_no_pulse():
    line = look(
        check_frames_of_pulses,
        examination(camera(delay_s=0.045), sync_board(), rig=with_trigger(max_delay_s=0.03)),
        "cam",
    )
    assert line is not None and line.severity == "error" and "pulses.images_without" in codes(line)


def test_ambiguous_pulses_are_counted():
    exam = examination(camera(), sync_board(), rig=with_trigger(max_delay_s=0.1))
    line = look(check_frames_of_pulses, exam, "cam")
    assert line is not None and (line.severity, codes(line)) == ("note", ["pulses.frames"])
    free = examination(camera(rate_hz=30.0), sync_board(), rig=with_trigger(max_delay_s=0.1))
    line = look(check_frames_of_pulses, free, "cam")
    assert line is not None and line.severity == "error" and "pulses.unequal" in codes(line)


def test_lost_images_are_counted_by_sequence_number():
    seen = camera()
    seen.frames = [frame for frame in seen.frames if frame.count is not None and frame.count % 10]
    line = look(check_frames_of_pulses, examination(seen, sync_board()), "cam")
    assert line is not None and line.severity == "note"


def test_sync_board_lines_are_compared_with_profile():
    line = look(check_pulses_sent, examination(sync_board()))
    assert line is not None and line.severity == "note"
    assert codes(line) == ["pulses.line_off", "pulses.line"]
    assert line.findings[1].figure("rate_hz") == pytest.approx(20.0, rel=1e-3)
    slow = look(check_pulses_sent, examination(sync_board(rate_hz=10.0)))
    assert slow is not None and slow.severity == "warning" and "pulses.line_off" in codes(slow)
    dead = look(check_pulses_sent, examination(replace(sync_board(), pulses=[])))
    assert dead is not None and dead.severity == "error"
