"""The reference firmware, compiled for this computer: what it says, when, and to our own live source."""

import os
import pty
import random
import shutil
import subprocess
import time
import tty
from datetime import datetime, timezone
from itertools import pairwise
from pathlib import Path

import pytest

from lce_rig.devices.lce1 import (
    BoardError,
    BoardStatus,
    Hello,
    LineReader,
    PpsEdge,
    TimeReply,
    TriggerEdge,
    read_line,
    read_sentence,
    write_sentence,
)
from lce_rig.devices.sync_board import SyncBoard
from lce_rig.rig.profile import SyncSettings
from tests.devices.attached import attached

FIRMWARE = Path(__file__).parents[2] / "scripts" / "firmware"
STRICT = [
    "-std=c++11",
    "-Wall",
    "-Wextra",
    "-Wconversion",
    "-Wshadow",
    "-Werror",
    "-fno-exceptions",
    "-fno-rtti",
]
UTC_S = 1_753_000_000
TICK_US = 10


@pytest.fixture(scope="session")
def compiler():
    found = next((path for path in map(shutil.which, ("g++", "clang++", "c++")) if path), None)
    if found is None:
        pytest.skip("no C++ compiler: g++, clang++ or c++")
    return found


@pytest.fixture(scope="session")
def host_board(compiler, tmp_path_factory):
    program = tmp_path_factory.mktemp("firmware") / "host_board"
    sources = [*sorted((FIRMWARE / "lce1").glob("*.cpp")), FIRMWARE / "host" / "host_board.cpp"]
    built = subprocess.run([compiler, *STRICT, "-o", program, *sources], capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return program


@pytest.fixture
def virtual(host_board):
    """Run commands, each (time in us, words), and give all messages; no time passes."""

    def run(seconds, *commands):
        script = b"".join(b"%d %s\n" % (at, write_sentence(words).strip()) for at, words in commands)
        done = subprocess.run(
            [host_board, "--virtual", str(round(seconds * 1e6))],
            input=script,
            capture_output=True,
            check=True,
        )
        lines = [line.strip() for line in done.stdout.splitlines()]
        messages = [rmc_utc_s(line) if b"RMC" in line else read_line(line) for line in lines]
        assert None not in messages
        return messages

    return run


def rmc_utc_s(line):
    """The UTC second of a sentence for the LiDAR."""
    fields = read_sentence(line.strip()).decode().split(",")
    assert fields[2] == "A"
    moment = datetime.strptime(f"{fields[9]} {fields[1]}", "%d%m%y %H%M%S").replace(tzinfo=timezone.utc)
    return int(moment.timestamp())


def rising(messages, channel):
    return [m for m in messages if isinstance(m, TriggerEdge) and m.channel == channel and m.is_rising]


def of_kind(messages, kind):
    return [message for message in messages if isinstance(message, kind)]


def test_sketch_compiles_with_arduino_stub(compiler):
    stub = FIRMWARE / "host" / "Arduino.h"
    command = [
        compiler,
        *STRICT,
        *["-fsyntax-only", "-x", "c++", "-include"],
        stub,
        FIRMWARE / "lce1/lce1.ino",
    ]
    checked = subprocess.run(command, capture_output=True, text=True)
    assert checked.returncode == 0, checked.stderr


def test_firmware_sentences_cover_the_calendar(host_board):
    rng = random.Random(0)
    # Two digits of a year before 1969 are one of this century to strptime.
    last = int(datetime(2068, 12, 31, tzinfo=timezone.utc).timestamp())
    edges = [
        datetime(y, m, d, tzinfo=timezone.utc) for y, m, d in ((2024, 2, 29), (2000, 3, 1), (2068, 12, 31))
    ]
    seconds = [int(edge.timestamp()) + k for edge in edges for k in (-1, 0, 59, 3599)]
    seconds += [rng.randrange(315_532_800, last) for _ in range(2000)]
    done = subprocess.run([host_board, "--rmc", *map(str, seconds)], capture_output=True, check=True)
    assert [rmc_utc_s(line) for line in done.stdout.split()] == seconds


def test_firmware_sends_hello_and_pps(virtual):
    messages = virtual(5.5)
    assert messages[0] == Hello(1, "1.0", "virtual")
    edges = of_kind(messages, PpsEdge)
    assert [edge.seq for edge in edges] == [1, 2, 3, 4, 5]
    assert {b.t_us - a.t_us for a, b in pairwise(edges)} == {1_000_000}
    assert {edge.utc_s for edge in edges} == {None} and not of_kind(messages, int)


@pytest.mark.parametrize(("rate", "phase_us", "n"), [("20.0", 0, 20), ("30.0", 5000, 30), ("1.0", 250000, 1)])
def test_pulses_keep_phase_in_every_second(virtual, rate, phase_us, n):
    messages = virtual(5.5, (1000, f"LCERT,2,{rate},{phase_us},200"), (2000, "LCEGO"))
    seconds = [edge.t_us for edge in of_kind(messages, PpsEdge)]
    pulses = rising(messages, 2)
    assert [pulse.number for pulse in pulses] == list(range(1, len(pulses) + 1))
    for second in seconds[:-1]:
        times = [pulse.t_us - second for pulse in pulses if second <= pulse.t_us < second + 1_000_000]
        assert len(times) == n
        wanted = [phase_us + k * 1e6 / n for k in range(n)]
        assert max(abs(a - b) for a, b in zip(times, wanted, strict=True)) <= 2 * TICK_US


def test_pulses_of_any_rate_add_no_errors(virtual):
    messages = virtual(60, (1000, "LCERT,0,33.333333,0,100"), (2000, "LCEGO"))
    times = [pulse.t_us for pulse in rising(messages, 0)]
    wanted = [times[0] + k * 1e6 / 33.333333 for k in range(len(times))]
    assert len(times) == pytest.approx(59 * 33.333333, abs=1)
    assert max(abs(a - b) for a, b in zip(times, wanted, strict=True)) <= 2 * TICK_US


def test_board_given_a_second_moves_pulse(virtual):
    messages = virtual(5.9, (100_000, f"LCEUT,2345678,{UTC_S}"))
    edges = of_kind(messages, PpsEdge)
    assert [edge.utc_s for edge in edges] == [UTC_S - 1 + k for k in range(5)]
    assert all(abs(edge.t_us - 1_345_678 - 1_000_000 * k) <= TICK_US for k, edge in enumerate(edges))
    assert of_kind(messages, BoardStatus)[-1].flags == 6


def test_sentence_follows_pulse_for_a_vlp_16(virtual):
    messages = virtual(4.9, (100_000, f"LCEUT,2000000,{UTC_S}"))
    pps = [k for k, message in enumerate(messages) if isinstance(message, PpsEdge)]
    for k in pps:
        following = next(message for message in messages[k:] if isinstance(message, int))
        assert following == messages[k].utc_s
    header = (FIRMWARE / "lce1" / "board.h").read_text()
    after_us, high_us = (
        int(header.split(f"{name} = ")[1].split(";")[0]) for name in ("kSentenceAfterUs", "kPpsHighUs")
    )
    # 9600 baud, ten bits a character, at most 80 characters.
    assert high_us + 50_000 <= after_us and after_us + 80 * 10 / 9600 * 1e6 <= 600_000


def test_drifting_clock_is_followed_smoothly(virtual):
    # The computer's seconds are 30 us longer than the board's: every 10 s it is told anew.
    told = [
        (100_000 + k * 10_000_000, f"LCEUT,{2_000_000 + k * 10_000_300},{UTC_S + 10 * k}") for k in range(6)
    ]
    edges = of_kind(virtual(60, *told), PpsEdge)
    steps = [b.t_us - a.t_us for a, b in pairwise(edges)]
    assert all(abs(step - 1_000_000) <= 50 + TICK_US for step in steps)
    late = [edge.t_us - (2_000_000 + (edge.utc_s - UTC_S) * 1_000_030) for edge in edges]
    assert max(map(abs, late)) <= 300 + 2 * TICK_US
    assert [edge.utc_s for edge in edges] == list(range(edges[0].utc_s, edges[0].utc_s + len(edges)))


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("LCERT,4,10.0,0,100", 3),
        ("LCERT,0,1000.1,0,100", 4),
        ("LCERT,0,ten,0,100", 4),
        ("LCERT,0,1.0000001,0,100", 4),
        ("LCERT,0,10.0,-1,100", 5),
        ("LCERT,0,10.0,100000,100", 6),
        ("LCERT,0,10.0,0,100000", 6),
        ("LCERT,0,10.0,0,0", 6),
        ("LCERT,0,10.0,0", 2),
        ("LCEXX", 2),
        ("LCEGO,1", 2),
        ("LCETM?,99999999999", 2),
        ("A,B,C,D,E,F,G,H,I", 1),
    ],
)
def test_commands_that_cannot_be_done_are_refused_by_number(virtual, words, code):
    (error,) = of_kind(virtual(0.1, (1000, words)), BoardError)
    assert error.code == code and error.text


def test_a_time_request_is_answered_with_its_cookie(virtual):
    (reply,) = of_kind(virtual(0.1, (50_000, "LCETM?,4294967295")), TimeReply)
    assert reply.cookie == 4294967295 and 50_000 <= reply.rx_us <= reply.tx_us <= 50_100


@pytest.fixture
def running(host_board):
    """The board behind a pty, with a clock that drifts; its sentences for the LiDAR are `lidar`."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    arguments = [host_board, "--drift-ppm", "300", "--start-us", "5000000"]
    process = subprocess.Popen(arguments, stdin=master, stdout=master, stderr=subprocess.PIPE)
    process.path = os.ttyname(slave)
    yield process
    process.terminate()
    process.communicate()
    os.close(master)
    os.close(slave)


@pytest.mark.realtime
def test_firmware_works_with_live_source(running):
    given = {"device": running.path, "triggers": {"cam": {"channel": 1, "rate_hz": 50.0, "phase_us": 3000}}}
    with attached(SyncBoard(SyncSettings.model_validate(given))) as (board, samples):
        pulses, told, end_s = [], [], time.monotonic() + 30
        for pulse in samples:
            pulses += [pulse] if pulse.sensor == "cam" else []
            told += [pulse] if pulse.sensor == "pps" else []
            if (len(told) >= 3 and len(pulses) > 50) or time.monotonic() > end_s:
                break
        assert [pulse.count for pulse in pulses] == list(range(1, len(pulses) + 1))
        model, status = board.host_clock, board.status()
        # On a busy machine any answer may come some milliseconds late.
        assert model.drift == pytest.approx(-300e-6, abs=60e-6 + 4e6 / (model.last_ns - model.first_ns))
        # The last pulse per second began a second of this computer's clock.
        off_ns = (model.convert(told[-1].stamp_ns) + 500_000_000) % 1_000_000_000 - 500_000_000
        assert abs(off_ns) < 30_000_000
    assert status.n_lost == 0
    codes = {problem.code for problem in status.problems}
    assert not codes & {"stream.damaged_lines", "device.board_error", "device.board_restarted"}


@pytest.mark.realtime
def test_firmware_survives_input_noise(running):
    """A computer that does not read costs lines only."""
    descriptor = os.open(running.path, os.O_RDWR | os.O_NOCTTY)
    try:
        rng = random.Random(1)
        for command in [*(f"LCERT,{channel},900.0,0,100" for channel in range(4)), "LCEGO"]:
            os.write(descriptor, rng.randbytes(50) + b"\n" + write_sentence(command))
        time.sleep(2.0)  # some thousand lines a second and nobody reads
        reader, messages, end_s = LineReader(), [], time.monotonic() + 5
        while time.monotonic() < end_s:
            messages += reader.feed(os.read(descriptor, 4096))
            if any(status.n_lost for status in of_kind(messages, BoardStatus)):
                break
        assert any(status.n_lost > 0 for status in of_kind(messages, BoardStatus))
        assert {error.code for error in of_kind(messages, BoardError)} <= {1}
        assert len(rising(messages, 0)) > 10 and len(rising(messages, 3)) > 10
    finally:
        os.close(descriptor)
