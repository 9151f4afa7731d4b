"""A sync board on a real pty: heard, asked, tied to the computer's clock, and survived whatever it does."""

from itertools import pairwise

import pytest
from wire.sync_board import HELLO, FakeBoard

from lce_rig.core.errors import SourceError
from lce_rig.devices.sync_board import SyncBoard
from lce_rig.rig.profile import SyncSettings
from tests.devices.attached import attached
from tests.shared import wait_until

pytestmark = pytest.mark.realtime


def settings(path, **more):
    triggers = {"cam": {"channel": 0, "rate_hz": 100.0}}
    return SyncSettings.model_validate({"device": path, "triggers": triggers, **more})


def take(samples, n, line="cam"):
    pulses = []
    for pulse in samples:
        if pulse.sensor == line:
            pulses.append(pulse)
        if len(pulses) == n:
            break
    return pulses


def codes(status):
    return [problem.code for problem in status.problems]


def assert_tells_the_time(model, fake):
    """Compare a clock with the board's own, within the model's uncertainty: a busy computer replies late."""
    error_ns = model.convert(model.last_ns) - fake.host_ns(model.last_ns)
    assert abs(error_ns) < 5e6 + 5 * model.sigma_ns(model.last_ns)


def test_sync_board_pulses_have_board_timestamps():
    with FakeBoard() as fake, attached(SyncBoard(settings(fake.path))) as (board, samples):
        pulses = take(samples, 50)
        assert [pulse.count for pulse in pulses] == list(range(pulses[0].count, pulses[0].count + 50))
        assert all(5 * 10**9 < pulse.stamp_ns < 15 * 10**9 for pulse in pulses)
        assert all(pulse.host_ns > fake.host_ns(pulse.stamp_ns) for pulse in pulses)
        status = board.status()
    assert status.n_lost == 0 and "device.board_restarted" not in codes(status)
    assert status.rate_hz > 50 and status.device.split(", ") == ["fake", "firmware 1.0", "LCE1"]


def test_sync_board_clock_is_synchronised_by_requests():
    with FakeBoard(drift=2000e-6) as fake, attached(SyncBoard(settings(fake.path))) as (board, _):
        wait_until(lambda: (clock := board.host_clock) is not None and clock.n_used >= 8)
        model = board.host_clock
        error_ns = model.convert(model.last_ns) - fake.host_ns(model.last_ns)
        assert abs(error_ns) < 5 * model.sigma_ns(model.last_ns) + 1000
        assert model.sigma_ns(model.last_ns) < 2_000_000
        # On a busy computer any reply may be some milliseconds late.
        assert model.drift == pytest.approx(-2000e-6, abs=200e-6 + 4e6 / (model.last_ns - model.first_ns))
        told = board.status().clock
        assert told is not None and told.figure("host_drift_ppm") == pytest.approx(-2000, rel=0.5)


def test_sync_board_lines_follow_profile():
    with FakeBoard() as fake:
        given = settings(fake.path)
        given.triggers["cam"] = given.triggers["cam"].model_copy(update={"phase_us": 2500, "pulse_us": 50})
        with attached(SyncBoard(given)) as (board, _):
            wait_until(lambda: "LCEGO" in fake.commands)
            assert fake.commands.index("LCERT,0,100.000000,2500,50") < fake.commands.index("LCEGO")
            board.start_triggers(rate_hz=4.0)
            wait_until(lambda: fake.commands.count("LCEGO") == 2)
            assert "LCERT,0,4.000000,2500,50" in fake.commands


def test_sync_board_lone_is_given_the_second():
    """No receiver is attached: the computer sends the time."""
    with FakeBoard() as fake, attached(SyncBoard(settings(fake.path))):
        wait_until(lambda: any(command.startswith("LCEUT") for command in fake.commands))
        command = next(command for command in fake.commands if command.startswith("LCEUT"))
        t_us, utc_s = (int(field) for field in command.split(",")[1:])
        assert fake.host_ns(1000 * t_us) == pytest.approx(utc_s * 10**9, abs=3e6)


def test_sync_board_garbage_is_counted_and_reported():
    with FakeBoard(garbage_every=3) as fake, attached(SyncBoard(settings(fake.path))) as (board, samples):
        pulses = take(samples, 60)
        assert [b.count - a.count for a, b in pairwise(pulses)] == [1] * 59
        status = board.status()
    (damaged,) = [each for each in status.problems if each.code == "stream.damaged_lines"]
    assert damaged.figure("n") >= 19


def test_lost_pulse_lines_are_counted_and_reported():
    with FakeBoard() as fake, attached(SyncBoard(settings(fake.path))) as (board, samples):
        pulses = take(samples, 10)
        fake.n_to_lose = 4
        wait_until(lambda: board.status().n_lost == 4)
        while pulses[-1].count < fake.n_sent - 1:
            pulses += take(samples, 1)
        assert sorted(b.count - a.count for a, b in pairwise(pulses))[-2:] == [1, 5]
        status = board.status()
    assert status.n_lost == status.n_lost_by_line["cam"] == 4
    (lost,) = [problem for problem in status.problems if problem.code == "stream.pulse_lines_lost"]
    assert lost.figures == {"n": 4, "by_line": "cam 4"}


@pytest.mark.parametrize("says_hello", [True, False])
def test_restarted_board_is_reconfigured_and_reported(says_hello):
    with FakeBoard() as fake, attached(SyncBoard(settings(fake.path))) as (board, samples):
        take(samples, 20)
        fake.reset(says_hello)
        wait_until(lambda: fake.commands.count("LCEGO") == 2)
        wait_until(lambda: board.host_clock is not None and board.host_clock.n_used >= 4)
        model, status = board.host_clock, board.status()
        assert_tells_the_time(model, fake)
    (restarted,) = [each for each in status.problems if each.code == "device.board_restarted"]
    assert restarted.figures["n"] == 1


def test_sync_board_unplugged_error_names_port():
    with FakeBoard() as fake, attached(SyncBoard(settings(fake.path))) as (board, samples):
        take(samples, 10)
        fake.unplug()
        with pytest.raises(SourceError, match=fake.path) as caught:
            take(samples, 10**6)
        assert "cable" in caught.value.hint
        board.status()


def test_sync_board_silence_is_an_error_with_hint():
    with FakeBoard(is_mute=True) as fake:
        with pytest.raises(SourceError, match=r"0\.3 s") as caught:
            attached(SyncBoard(settings(fake.path), hello_s=0.3)).__enter__()
        assert "firmware" in caught.value.hint
        wait_until(lambda: "LCEHI?" in fake.commands)


@pytest.mark.parametrize(
    ("hello", "named"), [("READY", "/dev/"), (HELLO.replace("LCEHI,1", "LCEHI,2"), "version 2")]
)
def test_sync_board_with_other_protocol_is_refused(hello, named):
    with FakeBoard(hello=hello) as fake, pytest.raises(SourceError, match=named):
        attached(SyncBoard(settings(fake.path), hello_s=3.0)).__enter__()


def test_sync_board_unusable_port_is_explained(tmp_path):
    with pytest.raises(SourceError, match="/dev/ttyLCE9") as caught:
        attached(SyncBoard(settings("/dev/ttyLCE9"))).__enter__()
    assert "sync.device" in caught.value.hint
    (tmp_path / "file").write_text("")
    with pytest.raises(SourceError, match="file"):
        attached(SyncBoard(settings(str(tmp_path / "file")))).__enter__()
    with FakeBoard() as fake, attached(SyncBoard(settings(fake.path))):
        with pytest.raises(SourceError, match=fake.path) as caught:
            attached(SyncBoard(settings(fake.path))).__enter__()
        assert "fuser" in caught.value.hint
