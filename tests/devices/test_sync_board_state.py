"""Intact and damaged lines of sync boards, and the state derived from their messages."""

import re
from functools import reduce
from operator import xor

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.devices.lce1 import (
    Arrival,
    BoardError,
    BoardState,
    BoardStatus,
    Hello,
    LineReader,
    PpsEdge,
    TimeReply,
    TriggerEdge,
    write_sentence,
)

S = 1_000_000_000
DAY_NS = 1_753_000_000 * S
HELLO = Hello(1, "1.0", "fake")


def arrival(steady_s, set_by_s=0.0):
    return Arrival(DAY_NS + round((steady_s + set_by_s) * S), round(steady_s * S))


def pulses(state, numbers, start_s=0.0, board_s=100.0, period_s=0.05):
    """Feed pulses whose board time and arrival go with their numbers, and give those handed on."""
    found = []
    for number in numbers:
        t_us = round((board_s + number * period_s) * 1e6)
        found += state.take(TriggerEdge(0, number, t_us, True), arrival(start_s + number * period_s + 0.001))
    return [pulse.count for pulse in found]


def problems(state, now_s=10.0, heard_s=10.0):
    state.heard_ns = round(heard_s * S)
    return state.problems(round(now_s * S))


def test_board_state_late_read_is_no_restart():
    state = BoardState({0: "cam"})
    pulses(state, range(20))
    for number in range(20, 120):
        state.take(TriggerEdge(0, number, 100_000_000 + number * 50_000, True), arrival(6.0))
    assert pulses(state, range(120, 140)) == list(range(120, 140))
    assert state.n_restarts == 0


def test_board_state_restart_is_detected_at_first_message():
    for hello in (HELLO, None):
        state = BoardState({0: "cam"})
        pulses(state, range(20))
        if hello:
            state.take(hello, arrival(2.0))
        assert pulses(state, range(1, 10), start_s=2.0, board_s=0.0) == list(range(1, 10))
        assert state.n_restarts == 1


def ask(state, steady_s, set_by_s=0.0, there_s=80e-6, back_s=80e-6, board_start_s=100.0, cookie=7):
    state.asked(cookie, arrival(steady_s, set_by_s).host_ns)
    board_us = round((board_start_s + steady_s + there_s) * 1e6)
    state.take(
        TimeReply(cookie, board_us, board_us + 10), arrival(steady_s + there_s + back_s + 1e-5, set_by_s)
    )


def test_board_state_old_answers_are_skipped():
    state = BoardState({})
    state.asked(3, DAY_NS)
    state.take(TimeReply(2, 100_000_000, 100_000_010), arrival(0.001))
    assert not state.has_answered
    state.take(TimeReply(3, 100_000_000, 100_000_010), arrival(0.001, set_by_s=-3600))
    assert state.has_answered and state.host_tracker.model is None


def test_board_state_clock_step_is_followed():
    state = BoardState({})
    for k in range(200):
        ask(state, 0.1 * k, set_by_s=3.0 * (k >= 100), cookie=k)
    assert state.n_restarts == 0
    assert [round(step.size_ns / S) for step in state.host_tracker.steps] == [3]
    assert abs(state.host_tracker.model.convert(115 * S) - DAY_NS - 18 * S) < 5000
    (jumped,) = [found for found in problems(state) if found.code == "clock.computer_jumped"]
    assert (jumped.figures["n"], jumped.figure("last_s")) == (1, pytest.approx(3, abs=1e-3))


def test_utc_is_taken_from_pulses_with_utc_second():
    state = BoardState({})
    found = []
    for k in range(10):
        edge = PpsEdge(k, 100_000_000 + 1_000_040 * k, 1_753_000_000 + k, "G")
        found += state.take(edge, arrival(k + 0.001))
    assert [pulse.sensor for pulse in found] == ["pps"] * 10
    assert state.utc_tracker.model.drift == pytest.approx(-40e-6, abs=0.1e-6)
    assert abs(state.utc_tracker.model.convert(100 * S) - DAY_NS) < 1000
    told = state.clock_state()
    assert told.code == "clock.board" and told.figure("utc_drift_ppm") == pytest.approx(-40, abs=0.1)


def test_falling_edges_and_unknown_channels_give_no_pulses():
    state = BoardState({0: "cam"})
    assert state.take(TriggerEdge(0, 1, 5, False), arrival(0)) == []
    assert state.take(TriggerEdge(3, 1, 5, True), arrival(0)) == []


MESSAGES = st.one_of(
    st.just(HELLO),
    st.builds(PpsEdge, st.integers(0, 2**32 - 1), st.integers(0, 2**40), st.none(), st.sampled_from("GIN")),
    st.builds(
        TriggerEdge, st.integers(0, 15), st.integers(0, 2**32 - 1), st.integers(0, 2**40), st.booleans()
    ),
    st.builds(TimeReply, st.integers(0, 5), st.integers(0, 10**6), st.integers(10**6, 2**40)),
    st.builds(BoardStatus, st.integers(0, 99), st.integers(0, 99)),
)


@given(st.lists(st.tuples(MESSAGES, st.integers(0, 10**10)), max_size=60))
def test_board_state_survives_any_messages(said):
    state, steady_ns = BoardState({0: "cam", 3: "davis"}), 0
    for index, (message, later_ns) in enumerate(said):
        steady_ns += later_ns
        if index % 5 == 0:
            state.asked(index % 6, DAY_NS + steady_ns)
        for pulse in state.take(message, Arrival(DAY_NS + steady_ns, steady_ns)):
            assert pulse.sensor in ("cam", "davis", "pps")
    shown = problems(state, now_s=steady_ns / S, heard_s=steady_ns / S)
    assert all(finding.sentence for finding in (state.clock_state(), *shown))


BODIES = {
    "LCEHI,1,1.0,teensy40,1000000": Hello(1, "1.0", "teensy40"),
    "LCEPP,7,123456,1753000000,G": PpsEdge(7, 123456, 1_753_000_000, "G"),
    "LCEPP,7,123456,,N": PpsEdge(7, 123456, None, "N"),
    "LCETG,2,41,99,R": TriggerEdge(2, 41, 99, True),
    "LCETG,2,41,100,F": TriggerEdge(2, 41, 100, False),
    "LCETM,5,100,130": TimeReply(5, 100, 130),
    "LCEST,3,60,0,1200,600": BoardStatus(3, 0),
    "LCEST,0,0,0": BoardStatus(0, 0),
    "LCEER,4,channel 9, unknown": BoardError(4, "channel 9, unknown"),
}


def read(data):
    reader = LineReader()
    return reader.feed(data + b"\n"), reader.n_damaged


@pytest.mark.parametrize(("body", "message"), BODIES.items())
def test_sync_every_sentence_round_trips(body, message):
    ((understood,), n_damaged) = read(write_sentence(body))
    assert (type(understood), understood, n_damaged) == (type(message), message, 0)


@pytest.mark.parametrize(
    "body",
    [
        "LCEHI,1,1.0,teensy40",
        "LCEPP,7,123456,,X",
        "LCETG,16,1,1,R",
        "LCETG,-1,1,1,R",
        "LCETG,1,1.0,1,R",
        "LCETG,1,1,1,R,",
        f"LCETG,1,1,{10**15},R",
        "LCEST,1,2",
    ],
)
def test_sync_wrong_fields_are_malformed(body):
    assert read(write_sentence(body)) == ([], 1)


def test_sync_wrong_sums_are_counted():
    """Unknown sentences are not."""
    data = b"$LCETG,0,1,2,R*00\n" + write_sentence("LCEXX,1") + b"hello\n" + write_sentence("GPGGA,1,2")
    assert read(data) == ([], 1)


@given(st.lists(st.sampled_from(sorted(BODIES)), min_size=1, max_size=20), st.randoms(use_true_random=False))
def test_sync_split_lines_are_rejoined(bodies, random):
    data = b"".join(map(write_sentence, bodies))
    reader, messages = LineReader(), []
    while data:
        size = random.randint(1, 40)
        messages += reader.feed(data[:size])
        data = data[size:]
    assert messages == [BODIES[body] for body in bodies]
    assert reader.n_damaged == 0


@given(
    st.sampled_from(sorted(BODIES)),
    st.lists(st.tuples(st.integers(0, 60), st.integers(0, 4), st.binary(max_size=8)), min_size=1, max_size=3),
)
def test_sync_damaged_lines_give_no_message(body, damages):
    data = write_sentence(body)
    for at, n_cut, put in damages:
        data = data[:at] + put + data[at + n_cut :]
    sums = [(said, int(digits, 16)) for said, digits in re.findall(rb"\$([^$*]+)\*([0-9A-Fa-f]{1,2})", data)]
    sound = [said for said, digits in sums if reduce(xor, said, 0) == digits]
    messages, _ = read(data)
    assert len(messages) <= len(sound)
    for message in messages:
        digits = {str(field) for field in message if type(field) is int}
        assert any(digits <= set(said.decode("latin-1").split(",")) for said in sound)


def test_sync_endless_line_is_cut_off():
    reader = LineReader()
    for _ in range(1000):
        assert reader.feed(b"9" * 1000) == []
    assert reader.feed(b"\n" + write_sentence("LCETG,0,1,2,R")) == [TriggerEdge(0, 1, 2, True)]
    assert reader.n_damaged == 1
