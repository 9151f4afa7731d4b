"""Lines of sync boards: sound ones are understood, damaged ones refused and counted."""

import re
from functools import reduce
from operator import xor

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.devices.lce1 import (
    BoardError,
    BoardStatus,
    Hello,
    LineReader,
    PpsEdge,
    TimeReply,
    TriggerEdge,
    write_sentence,
)

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
def test_every_sentence_is_understood(body, message):
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
def test_sentences_with_a_right_sum_and_wrong_fields_are_malformed(body):
    assert read(write_sentence(body)) == ([], 1)


def test_wrong_sums_are_counted_and_unknown_sentences_told_apart():
    data = b"$LCETG,0,1,2,R*00\n" + write_sentence("LCEXX,1") + b"hello\n" + write_sentence("GPGGA,1,2")
    assert read(data) == ([], 1)


@given(st.lists(st.sampled_from(sorted(BODIES)), min_size=1, max_size=20), st.randoms(use_true_random=False))
def test_lines_cut_anywhere_are_joined_again(bodies, random):
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
def test_a_damaged_line_makes_no_message_that_its_sum_denies(body, damages):
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


def test_a_line_without_an_end_is_cut_off_and_the_next_one_read():
    reader = LineReader()
    for _ in range(1000):
        assert reader.feed(b"9" * 1000) == []
    assert reader.feed(b"\n" + write_sentence("LCETG,0,1,2,R")) == [TriggerEdge(0, 1, 2, True)]
    assert reader.n_damaged == 1
