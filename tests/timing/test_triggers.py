"""Match images to trigger pulses by number, with lost, repeated and late ones."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lce_rig.core.data import Image, Pulse
from lce_rig.timing.clock import ClockModel
from lce_rig.timing.triggers import TriggerMatcher

MS = 1_000_000
S = 1000 * MS
PIXELS = np.zeros((2, 2), np.uint8)
HOST_NS = 1_753_000_000 * S


def matcher_of(max_delay_ms=30.0):
    matcher = TriggerMatcher("cam", round(max_delay_ms * MS))
    matcher.set_clock(ClockModel(HOST_NS, 77 * S, 0.0, np.zeros((2, 2)), 0, 0, 0, 0, 0, "start"))
    return matcher


@dataclass
class Rig:
    """A board and a camera it triggers, with faults in both streams.

    Attributes:
        seed: of everything random.
        n: pulses sent.
        period_ms: between pulses, after the first `n_slow` that are 400 ms apart.
        delay_ms, jitter_ms: of a picture's stamp after its pulse.
        late: share of pictures stamped half a second late.
        drift: of the board's clock, of which the coarse model knows nothing.
        lost_lines, lost_frames, repeated: shares.
        missed: pulses that the camera makes no frame of, so that its numbers do not go on.
        extra: pulses after which the camera's driver skips a number.
        n_before: free-running pictures before the first pulse.
        first_number, first_count: of the camera's frames and the board's pulses.
        lag_ms: by how much lines and pictures may come after one another.
    """

    seed: int = 0
    n: int = 200
    period_ms: float = 33.3
    n_slow: int = 8
    delay_ms: float = 12.0
    jitter_ms: float = 1.0
    late: float = 0.0
    drift: float = 40e-6
    lost_lines: float = 0.0
    lost_frames: float = 0.0
    repeated: float = 0.0
    missed: tuple[int, ...] = ()
    extra: tuple[int, ...] = ()
    n_before: int = 0
    first_number: int = 17
    first_count: int = 1
    lag_ms: float = 100.0
    truth: dict[int, int] = field(default_factory=dict)

    def streams(self):
        """Make both streams in the order of their arrival; fills `truth`, pulse number by frame number."""
        rng = np.random.default_rng(self.seed)
        slow = np.arange(self.n_slow) * 400.0
        fast = (slow[-1] if self.n_slow else 0.0) + 33.3 + np.arange(self.n - self.n_slow) * self.period_ms
        times_ms = 1000.0 + np.concatenate([slow, fast])
        board_ns = [round(t * MS * (1 + self.drift)) + 77 * S for t in times_ms]
        came, number = [], self.first_number
        for k in range(self.n_before):
            stamp = HOST_NS + round((1000 - 40 * (self.n_before - k)) * MS)
            came.append(
                (1000 - 40.0 * (self.n_before - k), Image("cam", "frames", stamp, PIXELS, None, number))
            )
            number += 1
        for k, time_ms in enumerate(times_ms):
            count = self.first_count + k
            line_ms = time_ms + rng.uniform(0, self.lag_ms)
            if rng.uniform() >= self.lost_lines:
                came.append((line_ms, Pulse("cam", board_ns[k], count, 0)))
            if k in self.missed:
                continue
            number += k in self.extra
            late_ms = 500.0 * (rng.uniform() < self.late) if k > self.n_slow + 10 else 0.0
            stamp_ms = time_ms + self.delay_ms + rng.uniform(-1, 1) * self.jitter_ms + late_ms
            image = Image("cam", "frames", HOST_NS + round(stamp_ms * MS), PIXELS, None, number)
            self.truth[number] = count
            number += 1
            if rng.uniform() >= self.lost_frames:
                came.append((stamp_ms + 30 + rng.uniform(0, self.lag_ms), image))
        # Each stream keeps its own order; duplicates arrive together.
        ordered = []
        for kind in (Pulse, Image):
            latest = 0.0
            for at_ms, sample in came:
                if isinstance(sample, kind):
                    latest = max(latest, at_ms)
                    ordered += [(latest, sample)] * (2 if rng.uniform() < self.repeated else 1)
        return [sample for _, sample in sorted(ordered, key=lambda pair: pair[0])]

    def run(self, max_delay_ms=30.0):
        matcher = matcher_of(max_delay_ms)
        matched = []
        for sample in self.streams():
            take = matcher.take_pulse if isinstance(sample, Pulse) else matcher.take_image
            matched += take(sample)
        return matcher, matched

    def wrong(self, matched):
        return [(m.image.count, m.pulse) for m in matched if self.truth.get(m.image.count) != m.pulse]


def test_trigger_stamp_has_no_jitter():
    """It is the time of the pulse and the typical delay."""
    rig = Rig(drift=0.0, jitter_ms=4.0)
    _, matched = rig.run()
    errors_ms = [(m.stamp_ns - m.pulse_ns) / MS - 12.0 for m in matched[40:]]
    assert max(map(abs, errors_ms)) < 2.5
    assert np.std(errors_ms) < 1.0


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10**6),
    lost_lines=st.sampled_from([0.0, 0.05, 0.2]),
    lost_frames=st.sampled_from([0.0, 0.05, 0.3]),
    repeated=st.sampled_from([0.0, 0.1]),
    late=st.sampled_from([0.0, 0.02]),
    jitter_ms=st.floats(0, 6),
    n_before=st.integers(0, 30),
    first=st.tuples(st.integers(0, 10**6), st.integers(0, 10**6)),
    drift=st.floats(-100e-6, 100e-6),
)
def test_trigger_never_assigns_wrong_pulse(
    seed, lost_lines, lost_frames, repeated, late, jitter_ms, n_before, first, drift
):
    rig = Rig(
        seed=seed, lost_lines=lost_lines, lost_frames=lost_frames, repeated=repeated, late=late,
        jitter_ms=jitter_ms, n_before=n_before, first_number=first[0], first_count=first[1], drift=drift,
        n_slow=20,
    )  # fmt: skip
    _, matched = rig.run()
    assert rig.wrong(matched) == []


@settings(max_examples=10)
@given(st.integers(0, 10**6))
def test_trigger_losses_do_not_restart(seed):
    """Repeated lines and images are taken once."""
    rig = Rig(seed=seed, lost_lines=0.1, lost_frames=0.1, repeated=0.1, n_slow=25, n=400)
    matcher, matched = rig.run()
    counts = matcher.counts
    came = {sample.count for sample in rig.streams() if isinstance(sample, Image)}
    assert counts["n_matched"] == len(matched) > 250
    assert counts["n_matched"] + counts["n_unmatched"] <= len(came)
    assert counts["n_restarts"] == 0


def test_trigger_lost_line_is_interpolated():
    rig = Rig(seed=3, lost_lines=0.1, drift=40e-6)
    _, matched = rig.run()
    came = {pulse.count for pulse in rig.streams() if isinstance(pulse, Pulse)}
    whole = {pulse.count: pulse.stamp_ns for pulse in Rig(drift=40e-6).streams() if isinstance(pulse, Pulse)}
    between = [m for m in matched if m.pulse not in came and m.pulse > 10]
    assert len(between) > 5
    assert all(abs(m.pulse_ns - whole[m.pulse]) < 2 for m in between)


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.integers(30, 180))
def test_trigger_slip_gives_no_wrong_time(seed, where):
    rig = Rig(seed=seed, missed=(where,), lost_lines=0.05, lost_frames=0.1, jitter_ms=3.0, n_slow=20)
    matcher, matched = rig.run()
    assert rig.wrong(matched) == []
    assert len(matched) > 100 and matcher.counts["n_restarts"] <= 1


@pytest.mark.parametrize(
    ("faults", "n_most_unmatched", "n_restarts"),
    [
        ({"missed": (60,)}, 6, 1),
        ({"missed": (60, 61, 62)}, 8, 1),
        ({"extra": (80, 150)}, 10, 2),
        ({"seed": 5, "late": 0.05}, 20, 0),
    ],
    ids=["a pulse missed", "three pulses missed", "numbers skipped by the driver", "late timestamps"],
)
def test_trigger_slips_are_noticed(faults, n_most_unmatched, n_restarts):
    """Late timestamps are not slips."""
    rig = Rig(**faults)
    matcher, matched = rig.run()
    assert rig.wrong(matched) == []
    assert 200 - n_most_unmatched <= len(matched) and matcher.counts["n_restarts"] == n_restarts


def test_trigger_ambiguous_start_is_refused():
    rig = Rig(n_slow=0)
    matcher, matched = rig.run(max_delay_ms=100)
    assert matched == []
    assert matcher.problem.code == "pulses.ambiguous" and matcher.problem.subject == "cam"
    assert matcher.counts["n_unmatched"] > 150


def test_trigger_free_running_camera_is_refused():
    rng = np.random.default_rng(0)
    matcher = matcher_of()
    matched = []
    for k in range(600):
        matcher.take_pulse(Pulse("cam", 77 * S + round(k * 33.3 * MS), k, 0))
        stamp_ns = HOST_NS + round((k * 41.7 + rng.uniform(0, 1)) * MS)
        matched += matcher.take_image(Image("cam", "frames", stamp_ns, PIXELS, None, k))
    assert len(matched) < 60


def test_trigger_reopened_camera_is_matched_again():
    first, second = Rig(n=60), Rig(n=60, first_number=0, first_count=61)
    matcher = matcher_of()
    found = []
    for rig, later_ns in ((first, 0), (second, 60 * S)):
        for sample in rig.streams():
            if isinstance(sample, Pulse):
                moved = Pulse("cam", sample.stamp_ns + later_ns, sample.count, 0)
                found += [(rig, m) for m in matcher.take_pulse(moved)]
            else:
                moved = Image("cam", "frames", sample.stamp_ns + later_ns, PIXELS, None, sample.count)
                found += [(rig, m) for m in matcher.take_image(moved)]
    assert all(rig.truth[m.image.count] == m.pulse for rig, m in found)
    assert sum(rig is second for rig, _ in found) > 50
    assert matcher.counts["n_restarts"] == 1


def test_trigger_restarted_board_is_matched_again():
    matcher = matcher_of()
    found = []
    for k in range(100):
        count = k if k < 50 else k - 50
        matcher.take_pulse(Pulse("cam", 77 * S + k * 40 * MS, count, 0))
        found += matcher.take_image(Image("cam", "frames", HOST_NS + k * 40 * MS + 5 * MS, PIXELS, None, k))
    assert all(m.pulse == (m.image.count if m.image.count < 50 else m.image.count - 50) for m in found)
    assert matcher.counts["n_restarts"] == 1 and len(found) > 90


def test_trigger_needs_numbers_and_a_clock():
    matcher = TriggerMatcher("cam", 30 * MS)
    assert matcher.take_image(Image("cam", "frames", HOST_NS, PIXELS, None, 1)) == []
    assert matcher.problem.code == "pulses.clock_not_tied"
    assert matcher.take_image(Image("cam", "frames", HOST_NS, PIXELS)) == []
    assert matcher.problem.code == "pulses.images_not_numbered"
    assert matcher.counts["n_unmatched"] == 2


def test_trigger_images_without_pulse_expire():
    matcher = matcher_of()
    for k in range(200):
        assert matcher.take_image(Image("cam", "frames", HOST_NS + k * 33 * MS, PIXELS, None, k)) == []
    assert matcher.counts["n_unmatched"] == 200 - 64
    assert matcher.problem.code == "pulses.none"
