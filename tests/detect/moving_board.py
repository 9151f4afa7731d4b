"""A small event camera that looks at a moving checkerboard: events with exact truth, in plain NumPy."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lce_rig.core.data import Events

COLS, ROWS = 7, 5  # squares
SQUARE_PX = 14.0
WIDTH_PX, HEIGHT_PX = 160, 120
CENTRE_PX = np.array([79.3, 59.6])


@dataclass(frozen=True)
class Motion:
    """A circle of the board's centre, once per turn_s, standing still from pause_s on."""

    radius_px: float = 7.0
    turn_s: float = 1.0
    pause_s: float = np.inf

    def shift_px(self, t_s):
        angle = 2 * np.pi * min(t_s, self.pause_s) / self.turn_s
        return self.radius_px * np.array([np.cos(angle), np.sin(2 * angle) * 0.7])


def inner_corners_px(motion, t_s):
    x = (np.arange(1, COLS) - COLS / 2) * SQUARE_PX
    y = (np.arange(1, ROWS) - ROWS / 2) * SQUARE_PX
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2) + CENTRE_PX + motion.shift_px(t_s)


def picture(motion, t_s):
    """Render the light on each pixel, (H, W) in (0, 1]: every part is a product of a column and a row."""
    centre = CENTRE_PX + motion.shift_px(t_s)
    board_x, print_x, checks_x = _profiles(WIDTH_PX, centre[0], COLS)
    board_y, print_y, checks_y = _profiles(HEIGHT_PX, centre[1], ROWS)
    dark = (np.outer(print_y, print_x) - np.outer(checks_y, checks_x)) / 2
    return 0.3 + 0.55 * np.outer(board_y, board_x) - 0.77 * dark


def _profiles(size_px, centre_px, n_squares):
    """Average board, print and alternating squares (+-1) over each pixel of a line, 16 samples a pixel."""
    offset = (np.arange(16) - 7.5) / 16
    u = ((np.arange(size_px)[:, None] + offset) - centre_px) / SQUARE_PX + n_squares / 2
    on_print = (u >= 0) & (u < n_squares)
    on_board = (u > -0.4) & (u < n_squares + 0.4)
    checks = np.where(np.floor(u) % 2 == 0, 1.0, -1.0) * on_print
    return on_board.mean(1), on_print.mean(1), checks.mean(1)


def board_events(motion, duration_s, seed=0, threshold=0.22, noise_hz=0.3, frames_hz=250):
    """Simulate the events of [0, duration_s): threshold crossings of the log intensity."""
    rng = np.random.default_rng(seed)
    thresholds = threshold * (1 + 0.06 * rng.standard_normal((HEIGHT_PX, WIDTH_PX)))
    level = np.log(picture(motion, 0.0) + 0.02)
    memory = level.copy()
    parts = []
    step_ns = round(1e9 / frames_hz)
    for index in range(round(duration_s * frames_hz)):
        after = np.log(picture(motion, (index + 1) / frames_hz) + 0.02)
        sign = np.sign(after - memory)
        fired = np.floor(np.abs(after - memory) / thresholds).astype(int)
        y, x = np.nonzero(fired)
        count = fired[y, x]
        which = np.repeat(np.arange(len(y)), count)
        nth = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count) + 1
        y, x = y[which], x[which]
        crossing = memory[y, x] + sign[y, x] * nth * thresholds[y, x]
        fraction = np.clip((crossing - level[y, x]) / (after[y, x] - level[y, x] + 1e-12), 0, 0.999)
        parts.append((index * step_ns + (fraction * step_ns).astype(np.int64), x, y, sign[y, x] > 0))
        memory += sign * fired * thresholds
        level = after
    n_noise = rng.poisson(noise_hz * duration_s * WIDTH_PX * HEIGHT_PX)
    parts.append(
        (
            rng.integers(0, round(duration_s * 1e9), n_noise),
            rng.integers(0, WIDTH_PX, n_noise),
            rng.integers(0, HEIGHT_PX, n_noise),
            rng.random(n_noise) < 0.5,
        )
    )
    t, x, y, polarity = (np.concatenate(column) for column in zip(*parts, strict=True))
    return events_of(t // 1000 * 1000, x, y, polarity)


def events_of(t_ns, x, y, polarity, width_px=WIDTH_PX, height_px=HEIGHT_PX):
    """Make Events from any sequences, sorting by time."""
    t = np.asarray(t_ns, np.int64)
    order = np.argsort(t, kind="stable")
    return Events(
        "cam",
        t[order],
        np.asarray(x, np.uint16)[order],
        np.asarray(y, np.uint16)[order],
        np.asarray(polarity, bool)[order],
        width_px,
        height_px,
    )


def cut(events, n_batches, seed=0):
    """Cut a stream into batches at random places, some of them empty."""
    rng = np.random.default_rng(seed)
    bounds = [0, *np.sort(rng.integers(0, len(events), n_batches - 1)), len(events)]
    return [
        Events(
            events.sensor,
            *(a[first:last] for a in (events.t_ns, events.x, events.y, events.polarity)),
            events.width_px,
            events.height_px,
        )
        for first, last in pairwise(bounds)
    ]


def noise(rate_hz=0.5, duration_s=1.4, seed=1):
    """Generate events of either polarity at a rate per second and pixel, anywhere."""
    rng = np.random.default_rng(seed)
    n = round(rate_hz * duration_s * WIDTH_PX * HEIGHT_PX)
    t_us = rng.integers(0, round(duration_s * 1e6), n)
    return events_of(
        t_us * 1000, rng.integers(0, WIDTH_PX, n), rng.integers(0, HEIGHT_PX, n), rng.random(n) < 0.5
    )


def lamps(frequency_hz, duration_s=1.4, n_each=600):
    """Let all pixels brighten in one half of each period, and darken in the other."""
    rng = np.random.default_rng(0)
    half_ns = round(0.5e9 / frequency_hz)
    start_ns = np.repeat(np.arange(0, round(duration_s * 1e9), half_ns), n_each)
    return events_of(
        start_ns + rng.integers(0, half_ns * 4 // 5000, len(start_ns)) * 1000,
        rng.integers(0, WIDTH_PX, len(start_ns)),
        rng.integers(0, HEIGHT_PX, len(start_ns)),
        (start_ns // half_ns) % 2 == 0,
    )


def join(*streams):
    """Put streams into one."""
    columns = [[getattr(s, name) for s in streams] for name in ("t_ns", "x", "y", "polarity")]
    return events_of(*(np.concatenate(column) for column in columns))
