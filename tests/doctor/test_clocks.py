"""Clocks: offsets and drifts are recovered, and boards may move only where every clock is tied."""

from dataclasses import replace

import pytest

from lce_rig.core.data import Pulse
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.doctor.checks import check_clock, check_edges, check_sync, tie
from lce_rig.doctor.observing import ObservedSensor
from lce_rig.rig import Rig

from .observed import LOCKED, START_NS, S, camera, codes, examination, lidar, look, make_rig, sync_board


def with_utc(board):
    """The board has UTC, equal to the computer's."""
    assert board.host_clock is not None
    return replace(board, utc_clock=board.host_clock)


def davis_rig():
    document = make_rig().model_dump()
    document["cameras"]["cam"] |= {"model": "DAVIS346", "driver": {"type": "davis"}}
    return Rig.model_validate(document)


def davis(drift=-2.5e-05, offset_ns=3000000, n=20, **status):
    """A camera that sees each of the board's pulses, by a clock of its own."""
    seen = camera(**status)
    for number in range(n):
        sent_ns = number * S // 4
        stamp_ns = START_NS + offset_ns + round((1 + drift) * sent_ns)
        seen.take(Pulse("cam", stamp_ns // 1000 * 1000, number, stamp_ns))
    return seen


def test_doctor_davis_clock_is_fitted_to_edges():
    exam = examination(davis(), sync_board(4.0, drift=0.0), rig=davis_rig())
    line = look(check_edges, exam, "cam")
    assert line is not None and line.severity == "note"
    assert line.figures["drift_ppm"] == pytest.approx(-25, abs=1)
    assert line.findings[0].figure("rms_us") < 2


def test_davis_without_edges_is_an_error():
    line = look(check_edges, examination(davis(n=0), sync_board(4.0), rig=davis_rig()), "cam")
    assert line is not None and line.severity == "error"
    assert codes(line) == ["edges.not_fitted", "edges.none_seen"]
    assert (line.figures["n_edges"], line.figures["n_pulses"]) == (0, 20)


def test_doctor_synchronised_clocks_allow_moving_boards():
    exam = examination(lidar(clock=LOCKED), camera(), with_utc(sync_board()))
    line = look(check_sync, exam)
    assert line is not None and (line.severity, codes(line)) == ("note", ["sync.boards_may_move"])
    model = tie(exam).models.get("cam")
    assert model.convert(START_NS + S) == pytest.approx(START_NS + S, abs=1000)


def test_doctor_unsynchronised_clock_has_action():
    line = look(check_sync, examination(lidar(clock=LOCKED), camera(), rig=make_rig(sync=None)))
    assert line is not None and line.severity == "warning"
    verdict, reason = line.findings
    assert (verdict.code, verdict.action) == ("sync.boards_must_stand", "add_board")
    assert reason.code == "sync.no_board"


def test_no_sync_in_profile_is_a_note():
    rig = make_rig(
        sync=None,
        lidars={"lidar": {}},
        cameras={"cam": {**make_rig().model_dump()["cameras"]["cam"], "channels": {"frames": {}}}},
    )
    line = look(check_sync, examination(lidar(), camera(), rig=rig))
    assert line is not None and line.severity == "note" and codes(line)[0] == "sync.boards_must_stand"


def test_doctor_ignores_absent_sensors_for_sync():
    absent = ObservedSensor("cam", failure=SourceError("it is not there"))
    assert look(check_sync, examination(lidar(clock=LOCKED), absent, with_utc(sync_board()))) is None


def test_driver_clock_problems_stand_in_line():
    problem = Finding("clock.missing", "warning", figures={"clock": "tsc"})
    arrival = Finding("clock.arrival", "note")
    line = look(check_clock, examination(camera(clock=arrival, problems=(problem,))), "cam")
    assert line is not None and line.severity == "warning"
    assert codes(line) == ["clock.arrival", "clock.missing"]
