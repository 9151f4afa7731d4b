"""Lines of sync boards: sound ones are understood, damaged ones refused and counted."""

import re
from datetime import datetime, timezone
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.devices.sync_board.lines import DIALECTS, LineReader
from lce_rig.devices.sync_board.lines.dialect import MAX_LINE, LineSplitter, write_sentence
from lce_rig.devices.sync_board.lines.lce1 import READERS, Lce1
from lce_rig.devices.sync_board.lines.messages import (
    MAX_COUNT,
    MAX_US,
    BoardError,
    BoardStatus,
    Exposure,
    Hello,
    LineFault,
    PpsEdge,
    TimeReply,
    TriggerEdge,
    UtcTime,
)

RMC = b"$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A"


def read(dialect, data):
    reader = LineReader(DIALECTS[dialect]())
    return reader.feed(data + b"\n"), dict(reader.faults)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("LCEHI,1,1.0,teensy40,1000000", Hello(1, "1.0", "teensy40", 1_000_000)),
        ("LCEPP,7,123456,1753000000,G", PpsEdge(7, 123456, 1_753_000_000, "G")),
        ("LCEPP,7,123456,,N", PpsEdge(7, 123456, None, "N")),
        ("LCETG,2,41,99,R", TriggerEdge(2, 41, 99, True)),
        ("LCETG,2,41,100,F", TriggerEdge(2, 41, 100, False)),
        ("LCEEX,0,41,120,4000", Exposure(0, 41, 120, 4000)),
        ("LCETM,5,100,130", TimeReply(5, 100, 130)),
        ("LCEST,3,60,0,1200,600", BoardStatus(3, 60, 0, (1200, 600))),
        ("LCEST,0,0,0", BoardStatus(0, 0, 0, ())),
        ("LCEER,4,channel 9, unknown", BoardError(4, "channel 9, unknown")),
        (f"LCETG,15,{MAX_COUNT},{MAX_US},R", TriggerEdge(15, MAX_COUNT, MAX_US, True)),
    ],
)
def test_every_sentence_of_lce1_is_understood(body, message):
    assert read("lce1", write_sentence(body)) == ([message], {})


@pytest.mark.parametrize(
    "body",
    [
        "LCEHI,1,1.0,teensy40",
        "LCEPP,7,123456,,X",
        "LCETG,16,1,1,R",
        "LCETG,-1,1,1,R",
        "LCETG,1,01,1,R",
        "LCETG,1,1.0,1,R",
        "LCETG,1,1,1,R,",
        f"LCETG,1,{MAX_COUNT + 1},1,R",
        f"LCETG,1,1,{MAX_US + 1},R",
        "LCETM,5,131,130",
        "LCEER,4",
        "LCEST,1,2",
        "LCEHI,1,\t,x,1",
    ],
)
def test_sentences_with_a_right_sum_and_wrong_fields_are_malformed(body):
    assert read("lce1", write_sentence(body)) == ([], {LineFault.MALFORMED: 1})


def test_wrong_sums_are_counted_and_unknown_sentences_told_apart():
    data = b"$LCETG,0,1,2,R*00\n" + write_sentence("LCEXX,1") + b"hello\n" + write_sentence("GPGGA,1,2")
    assert read("lce1", data) == ([], {LineFault.CHECKSUM: 1, LineFault.UNKNOWN: 3})


def test_sums_of_one_digit_and_small_letters_are_accepted():
    body = next(f"LCETG,0,{n},2,R" for n in range(999) if write_sentence(f"LCETG,0,{n},2,R")[-4:-3] == b"0")
    sentence = write_sentence(body)
    short = sentence.replace(b"*0", b"*").lower().replace(b"lcetg", b"LCETG").replace(b"r*", b"R*")
    assert len(read("lce1", short)[0]) == 1
    assert read("nmea", RMC.replace(b"*6A", b"*6a"))[0] == read("nmea", RMC)[0] != []


def test_a_board_that_begins_anew_in_the_middle_of_a_line_is_understood():
    hello = write_sentence("LCEHI,1,1.0,teensy40,1000000")
    assert read("lce1", b"\xff\x00$LCETG,0,12,34" + hello)[0] == [Hello(1, "1.0", "teensy40", 1_000_000)]


def test_rmc_gives_the_second_in_utc_whoever_talks():
    expected = UtcTime(int(datetime(1994, 3, 23, 12, 35, 19, tzinfo=timezone.utc).timestamp()) * 10**9, True)
    assert read("nmea", RMC) == ([expected], {})
    assert read("lce1", RMC) == ([expected], {})
    assert read("tline", RMC) == ([expected], {})
    other = write_sentence("GNRMC,123519.25,V,,,,,,,230326,,,N")
    moment = int(datetime(2026, 3, 23, 12, 35, 19, tzinfo=timezone.utc).timestamp()) * 10**9 + 250_000_000
    assert read("nmea", other) == ([UtcTime(moment, False)], {})


@pytest.mark.parametrize(("digits", "year"), [("80", 1980), ("99", 1999), ("00", 2000), ("79", 2079)])
def test_two_digits_of_the_year_lie_between_1980_and_2079(digits, year):
    (message,), _ = read("nmea", write_sentence(f"GPRMC,000000,A,,,,,,,0101{digits},,"))
    assert message.utc_ns == int(datetime(year, 1, 1, tzinfo=timezone.utc).timestamp()) * 10**9


def test_a_receiver_without_a_fix_says_that_it_has_no_time():
    assert read("nmea", write_sentence("GNRMC,,V,,,,,,,,,,N"))[0] == [UtcTime(None, False)]


@pytest.mark.parametrize("time, date", [("240000", "010126"), ("126019", "010126"), ("120000", "310226")])
def test_times_that_do_not_exist_are_malformed(time, date):
    assert read("nmea", write_sentence(f"GPRMC,{time},A,,,,,,,{date},,"))[1] == {LineFault.MALFORMED: 1}


def test_minutes_and_days_roll_over_as_the_calendar_does():
    texts = [("235958", "280224"), ("235959", "280224"), ("000000", "290224"), ("000001", "290224")]
    data = b"".join(write_sentence(f"GPRMC,{time},A,,,,,,,{date},,") for time, date in texts)
    times = [message.utc_ns // 10**9 for message in read("nmea", data)[0]]
    assert [time - times[0] for time in times] == [0, 1, 2, 3]


def test_simplesensorsync_tells_each_channel_of_a_trigger():
    messages, _ = read("simplesensorsync", b'{"f":"t","s":5,"t":123456,"c":7}')
    assert messages == [TriggerEdge(0, 7, 123456, True), TriggerEdge(2, 7, 123456, True)]


def test_simplesensorsync_answers_about_the_time_in_two_lines():
    assert DIALECTS["simplesensorsync"]().time_request(9) == b'{"f":"a","a":9}\n'
    reader = LineReader(DIALECTS["simplesensorsync"]())
    assert reader.feed(b'{"f":"a","a":9,"b":1000}\n') == []
    assert reader.feed(b'{"f":"b","a":1040}\n') == [TimeReply(9, 1000, 1040)]
    # Without its first half, or with one older than it, an answer is none.
    assert reader.feed(b'{"f":"b","a":1040}\n{"f":"a","a":9,"b":1000}\n{"f":"b","a":999}\n') == []
    assert reader.faults[LineFault.MALFORMED] == 2


@pytest.mark.parametrize(
    "line",
    [
        b'{"f":"t","s":5,"t":123456}',
        b'{"f":"t","s":5,"t":1.5,"c":7}',
        b'{"f":"t","s":5,"t":true,"c":7}',
        b'{"f":"t","s":5,"t":-1,"c":7}',
        b'{"f":"t","s":5,"t":1,"t":2,"c":7}',
        b'{"f":"t","s":5,"t":1,"c":7',
        b'{"f":"t","s":70000,"t":1,"c":7}',
        b"{" * 500,
        b"{\xff}",
    ],
)
def test_json_that_is_not_quite_right_is_malformed(line):
    assert read("simplesensorsync", line) == ([], {LineFault.MALFORMED: 1})


def test_tline_takes_pulses_with_and_without_blanks_and_nothing_else():
    assert read("tline", b"READY\nT,12,345678\nT, 13, 395678\r")[0] == [
        Hello(0, "", "tline", 0),
        TriggerEdge(0, 12, 345678, True),
        TriggerEdge(0, 13, 395678, True),
    ]
    data = b"T,12\nT,12,34,56\nT,1 2,3\nT,012,3\nEXP,0,4"
    assert read("tline", data) == ([], {LineFault.MALFORMED: 4, LineFault.UNKNOWN: 1})


@given(st.lists(st.integers(0, 10**6), min_size=1, max_size=20), st.randoms(use_true_random=False))
def test_lines_cut_anywhere_are_joined_again(times_us, random):
    data = b"".join(write_sentence(f"LCETG,0,{k},{t_us},R") for k, t_us in enumerate(times_us))
    reader, messages = LineReader(Lce1()), []
    while data:
        size = random.randint(1, 40)
        messages += reader.feed(data[:size])
        data = data[size:]
    assert messages == [TriggerEdge(0, k, t_us, True) for k, t_us in enumerate(times_us)]
    assert not reader.faults


@given(st.lists(st.binary(max_size=2000), max_size=10))
def test_a_splitter_keeps_no_more_than_a_line_whatever_comes(pieces):
    splitter = LineSplitter()
    for piece in pieces:
        assert all(len(line) <= MAX_LINE and b"\n" not in line for line in splitter.feed(piece))
        assert len(splitter._rest) <= MAX_LINE


def test_a_line_without_an_end_is_cut_off_and_the_next_one_read():
    reader = LineReader(Lce1())
    for _ in range(1000):
        assert reader.feed(b"9" * 1000) == []
    assert reader.feed(b"\n" + write_sentence("LCETG,0,1,2,R")) == [TriggerEdge(0, 1, 2, True)]
    assert dict(reader.faults) == {LineFault.TOO_LONG: 1}


def test_every_example_of_the_protocol_is_understood_and_every_sentence_described():
    text = (Path(__file__).parents[2] / "docs" / "sync-protocol.md").read_text(encoding="utf-8")
    said = [line.strip()[2:].encode() for line in text.splitlines() if line.startswith("    < ")]
    asked = [line.strip()[2:].encode() for line in text.splitlines() if line.startswith("    > ")]
    reader = LineReader(Lce1())
    assert len(reader.feed(b"\n".join(said) + b"\n")) == len(said) > 5 and not reader.faults
    lce1 = Lce1()
    ours = [lce1.set_trigger(0, 20, 2500, 100), lce1.start(), lce1.time_request(41)]
    ours.append(lce1.set_utc(19000017, 1753000014))
    assert [line.strip() for line in ours] == asked
    described = set(re.findall(r"`(LCE[A-Z]{2}\??)", text))
    assert described >= {name.decode() for name in READERS} | {"LCEHI?", "LCETM?", "LCERT", "LCEUT", "LCESP"}
