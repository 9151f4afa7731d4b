"""A live collection in a terminal: one screen, of 80x24 or larger, or plain lines for scripts and logs."""

import io
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from typing import Any, Protocol
from urllib.parse import urlsplit

import numpy as np

from lce_rig.collect.live.state import LiveState, Phase, StreamState
from lce_rig.core.geometry import Array
from lce_rig.show.screen.keys import HELP, PAGE_HELP

# Outlines drawn with braille characters: two by four dots each, which every terminal shows.

# Bits of the dots of a braille character, by row and column; Unicode block U+2800.
_BITS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
_STEPS = 400


def draw_outlines(
    picture_px: tuple[int, int], solid_px: Array | None, dotted_px: Array | None, size: tuple[int, int]
) -> list[str]:
    """Draw two closed polygons into a frame of the image's shape.

    Args:
        picture_px: (width, height) of the image.
        solid_px: (K, 2) polygon drawn as a line; None for none; NaN breaks it.
        dotted_px: (K, 2) polygon drawn dotted.
        size: (columns, rows) of characters, the frame's border included, at most.

    Returns:
        The lines.
    """
    # A character is about twice as high as wide: its dots are square.
    columns = min(size[0] - 2, round(2 * (size[1] - 2) * picture_px[0] / picture_px[1]))
    rows = min(size[1] - 2, max(round(columns * picture_px[1] / picture_px[0] / 2), 1))
    dots = np.zeros((4 * rows, 2 * columns), dtype=bool)
    scale = np.array(dots.shape[::-1]) / np.array(picture_px)
    for polygon, stride in ((solid_px, 1), (dotted_px, _STEPS // max(12, 2 * rows))):
        if polygon is not None:
            _draw(dots, polygon * scale, stride)
    bits = dots.reshape(rows, 4, columns, 2).transpose(0, 2, 1, 3) * _BITS
    lines = ["".join(chr(0x2800 + int(code)) for code in row) for row in bits.sum(axis=(2, 3))]
    return [f"┌{'─' * columns}┐", *(f"│{line}│" for line in lines), f"└{'─' * columns}┘"]


def _draw(dots: np.ndarray, polygon: Array, stride: int) -> None:
    """Set the dots along a polygon, each edge sampled densely, every stride-th sample."""
    share = np.linspace(0, 1, max(_STEPS // max(len(polygon), 1), 8))[:, None]
    samples = np.concatenate([a + share * (b - a) for a, b in pairwise(polygon)])
    samples = samples[np.isfinite(samples).all(axis=1)][::stride]
    at = np.floor(samples).astype(int)
    is_inside = np.all((at >= 0) & (at < np.array(dots.shape[::-1])), axis=1)
    dots[at[is_inside, 1], at[is_inside, 0]] = True


CODE_STYLE = "bright_white on black"
_STYLES: dict[Phase, str] = {
    "starting": "white on grey30",
    "searching": "white on dark_red",
    "moving": "black on yellow",
    "holding": "black on green",
    "saving": "black on green",
    "refused": "black on dark_orange",
    "enough": "black on green",
    "lost": "white on red",
    "ended": "white on grey30",
}
# Minimum time between rings, s: faster ones sound like one, and only their number differs.
_BELL_EVERY_S = 0.2
_BELLS = {"captured": 1, "taken_back": 1, "refused": 2, "enough": 3, "lost": 3, "tick": 0}
_HEIGHT, _WIDTH = 24, 80
# Width of bars and figures, characters; the drawing is beside them.
_SIDE_WIDTH = 40
# Units stay lower case in the headline, too: 8 M would mean something else.
_UNITS = ("m", "cm", "mm", "deg", "s", "cm/s")
_PLAIN_EVERY_S = 3.0
_BARS = ("left_right", "up_down", "near_far", "tilt", "roll")


class View(Protocol):
    """Shows states."""

    def show(self, state: LiveState) -> None:
        """Show a state."""
        ...


@contextmanager
def open_view(
    *,
    is_plain: bool,
    has_keys: bool,
    links: tuple[str, ...] = (),
    wants_code: Callable[[], bool] = lambda: False,
) -> Iterator[View]:
    """Open a full screen if stderr is a terminal that can draw one, else plain lines.

    Args:
        is_plain: print plain lines in any case.
        has_keys: whether keys can be pressed.
        links: links of the page, the likeliest first; a screen covers the links printed earlier.
        wants_code: asked whether to show the page's QR code in place of the guidance.
    """
    bell = Bell(is_silent=not sys.stderr.isatty())
    if is_plain or not sys.stderr.isatty():
        yield PlainView(bell)
        return
    from rich.console import Console
    from rich.live import Live

    console = Console(stderr=True, highlight=False)
    if console.is_dumb_terminal:
        yield PlainView(bell)
        return
    live = Live(console=console, screen=True, auto_refresh=False)
    live.start()
    try:
        yield ScreenView(live, console, bell, has_keys=has_keys, links=links, wants_code=wants_code)
    finally:
        with suppress(OSError):  # The terminal may be gone.
            live.stop()


class Bell:
    """Rings the terminal's bell for new cues in states: once for a capture, twice for a refused one."""

    def __init__(
        self,
        is_silent: bool = False,
        ring: Callable[[], object] = lambda: print("\a", end="", file=sys.stderr, flush=True),  # noqa: T201
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._is_silent, self._ring, self._now_s = is_silent, ring, now_s
        self._n_cued = self._n_due = 0
        self._rung_s = -math.inf

    def take(self, state: LiveState) -> None:
        """Note the cues of a state, and ring once if a ring is due; states come several times a second."""
        for cue in state.cues:
            if cue.number > self._n_cued and _BELLS[cue.sound]:
                self._n_due = _BELLS[cue.sound]
        self._n_cued = state.cues[-1].number if state.cues else 0
        if self._n_due and not self._is_silent and self._now_s() - self._rung_s >= _BELL_EVERY_S:
            self._n_due, self._rung_s = self._n_due - 1, self._now_s()
            self._ring()


class PlainView:
    """Prints a line on stderr for each change; instructions, which change constantly, only now and then."""

    def __init__(self, bell: Bell) -> None:
        self._bell = bell
        self._said: tuple[str, str] | None = None
        self._said_s = -_PLAIN_EVERY_S
        self._n_logged = 0
        self._notes: set[str] = set()
        self._n_explained = 0

    def show(self, state: LiveState) -> None:
        """Print the news since the last state."""
        self._bell.take(state)
        for note in state.notes:
            if note not in self._notes:
                self._notes.add(note)
                _print(f"note: {note}")
        n_new = min(state.n_logged - self._n_logged, len(state.log))
        for text in state.log[len(state.log) - n_new :]:
            _print(text)
        self._n_logged = state.n_logged
        # Only once per capture, though the figures also change in between.
        if state.goes_on and state.n_captures != self._n_explained:
            self._n_explained = state.n_captures
            _print(f"{_clock(state)} {state.goes_on}")
        texts = (state.phase, state.headline)
        is_due = (
            self._said is None or texts[0] != self._said[0] or state.elapsed_s - self._said_s > _PLAIN_EVERY_S
        )
        if texts != self._said and is_due and state.phase != "ended":
            self._said, self._said_s = texts, state.elapsed_s
            detail = f" ({state.detail})" if state.detail else ""
            _print(f"{_clock(state)} {state.phase}: {state.headline}{detail}")


class ScreenView:
    """One screen, redrawn with every state."""

    def __init__(
        self,
        live: Any,
        console: Any,
        bell: Bell,
        *,
        has_keys: bool,
        links: tuple[str, ...] = (),
        wants_code: Callable[[], bool] = lambda: False,
    ) -> None:
        self._live = live
        self._console = console
        self._bell = bell
        self._has_keys = has_keys
        self._links = links
        self._wants_code = wants_code

    def show(self, state: LiveState) -> None:
        """Draw a state, or the page's QR code before the sensors send, and ring the bell."""
        self._bell.take(state)
        height, width = self._console.height, self._console.width
        code = None
        if self._links and (state.phase == "starting" or self._wants_code()):
            code = render_code(self._links[0], state, height=height, width=width)
        self._live.update(
            code or render(state, has_keys=self._has_keys, links=self._links, height=height, width=width),
            refresh=True,
        )


def render_code(link: str, state: LiveState, *, height: int = _HEIGHT, width: int = _WIDTH) -> Any:
    """Lay out a page's QR code with its link and the headline; None if they do not fit, or without a code."""
    from rich.console import Group
    from rich.text import Text

    code = qr_lines(link)
    texts = [f"page: {link}", state.headline]
    lines = [text[k : k + width] for text in texts for k in range(0, len(text), width)]
    if not code or len(code) + len(lines) > height or len(code[0]) > width:
        return None
    return Group(*(Text(line, style=CODE_STYLE) for line in code), *map(Text, lines))


def qr_lines(link: str) -> list[str]:
    """Draw a QR code of a link with two modules per character; None for a link that phones cannot open.

    Light modules are drawn, dark ones are the background: the colours must be set, see `CODE_STYLE`.
    """
    host = urlsplit(link).hostname or ""
    if host in ("localhost", "::1") or host.startswith("127."):
        return []
    import segno

    drawn = io.StringIO()
    segno.make(link, error="l", micro=False).terminal(drawn, border=2, compact=True)
    return drawn.getvalue().rstrip("\n").split("\n")


def render(
    state: LiveState,
    *,
    has_keys: bool = True,
    links: tuple[str, ...] = (),
    height: int = _HEIGHT,
    width: int = _WIDTH,
) -> Any:
    """Lay a state out for a terminal; only the likeliest of the page's links is shown.

    Sentences wrap. The remaining room goes to messages and to a larger drawing; on a short terminal, the
    banner's edges and then the coverage bars are dropped.
    """
    from rich.console import Console, Group
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    console = Console(width=width, file=io.StringIO())

    def n_lines(parts: Iterable[Any], among: int = width) -> int:
        options = console.options.update_width(among)
        return sum(len(console.render_lines(part, options, pad=False)) for part in parts)

    wanted = f" of {state.n_wanted}" if state.n_wanted is not None else ""
    shown = state.n_captures if state.n_wanted is None else state.n_wanted
    title = Text.assemble(
        (f"lce-rig {state.rig}", "bold"),
        f"  {_clock(state)}  ",
        (f"{state.n_captures}{wanted} {'capture' if shown == 1 else 'captures'}", "bold"),
        f"  {state.session}",
        no_wrap=True,
        overflow="ellipsis",
    )
    words = state.headline.split(" ")
    headline = " ".join(word if word.strip(",") in _UNITS else word.upper() for word in words)
    if state.hold_s is not None:
        headline += f"   {state.hold_s:.1f} s"
    banner = Text(headline, style="bold", justify="center")
    above = [Text(state.detail or " ", style="italic"), _stream_table(state.streams)]
    # A truncated link is useless, so long ones wrap.
    below = [Text(f"page: {link}", overflow="fold") for link in links[:1]]
    if has_keys:
        keys = HELP + (PAGE_HELP if links and qr_lines(links[0]) else "")
        below.append(Text(keys, style="bold dim"))
    newest, *older = [Text(message, style="dim") for message in reversed(state.log)] or [Text("")]
    notes = [Text(f"! {note}", style="yellow") for note in state.notes]

    side = _progress(state)
    n_free = height - n_lines([title, Padding(banner, (0, 2)), *above, *below])
    n_newest, n_beside = n_lines([newest]), n_lines(side, _SIDE_WIDTH)
    n_room = n_free - n_newest - n_lines(notes[:1])
    # The lines of a prediction are kept free before there is one, so that the drawing keeps its size.
    n_blank = max(min(n_room, len(_BARS) + 4) - n_beside, 0)
    side, n_beside = side + [Text(" ")] * n_blank, n_beside + n_blank
    edge = 1 if n_room - n_beside >= 2 else 0
    if n_room < n_beside:
        side = side[len(_BARS) :]
        n_beside = n_lines(side, _SIDE_WIDTH)
    n_room = n_free - 2 * edge
    if height > _HEIGHT:  # the same size for any number of messages
        n_beside = max(min(height - 14, n_room - 3), n_beside)
    # The newest message, notes, then older messages, up to the free lines.
    n_left = n_room - n_beside - n_newest
    kept = []
    for part in [*notes, *older]:
        n_left -= n_lines([part])
        if n_left < 0:
            break
        kept.append(part)
    messages = [*kept[: len(notes)], *reversed(kept[len(notes) :]), newest]
    drawing = _drawing(state, (width - _SIDE_WIDTH - 2, n_beside))
    beside = Table.grid(padding=(0, 1, 0, 0))
    beside.add_column(width=min(_SIDE_WIDTH, width))
    beside.add_row(Group(*side), *([] if drawing is None or width < _WIDTH else [drawing]))
    banner_box = Padding(banner, (edge, 2), style=_STYLES[state.phase])
    return Group(title, banner_box, *above, beside, *messages, *below)


def _stream_table(streams: tuple[StreamState, ...]) -> Any:
    """Format the streams: name, rate, losses, and figures of the board or the fault."""
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 1, 0, 0), pad_edge=False, expand=True)
    table.add_column(min_width=14, no_wrap=True)
    table.add_column(min_width=7, justify="right", no_wrap=True)
    table.add_column(style="red", no_wrap=True)
    table.add_column(ratio=1)
    for stream in streams:
        is_bad = stream.sees_board is False or bool(stream.reason)
        mark, style = (
            ("x", "bold red") if is_bad else ("o", "bold green") if stream.sees_board else ("-", "dim")
        )
        rate = f"{stream.rate_hz:.1f}/s" if stream.rate_hz < 1000 else f"{stream.rate_hz / 1e6:.2f}M/s"
        lost = f"{stream.n_lost} lost" if stream.n_lost else ""
        reason = Text(stream.reason or stream.figures, style="red" if is_bad else "")
        table.add_row(Text(f"{mark} {stream.name}", style=style), rate, lost, reason)
    return table


def _progress(state: LiveState) -> list[Any]:
    """Show coverage as bars, predicted standard deviations against their targets, and remaining work."""
    from rich.text import Text

    lines: list[Any] = []
    for name in _BARS:
        share = 0.0 if state.coverage is None else float(getattr(state.coverage, name))
        filled = round(14 * share)
        style = "green" if share >= 0.99 else "yellow"
        empty = "░" * (14 - filled) + f" {100 * share:3.0f} %"
        lines.append(Text.assemble(f"{name.replace('_', '-'):<11}", ("█" * filled, style), (empty, "dim")))
    for name, sigma, target, unit in (
        ("rotation", state.sigma_deg, state.target_deg, "deg"),
        ("position", state.sigma_mm, state.target_mm, "mm"),
    ):
        is_known = np.isfinite(sigma)
        shown = f"{sigma:.2g}" if sigma < 10 else f"{sigma:.0f}"
        # Conservative with few captures: a result reports less.
        figure = f"below {shown} {unit}" if is_known else "-"
        style = "green" if is_known and sigma <= target else "yellow"
        lines.append(Text.assemble(f"{name:<11}", (figure, style), f" (target {target:g})"))
    return [*lines, Text(state.goes_on)] if state.goes_on else lines


def _drawing(state: LiveState, most: tuple[int, int]) -> Any:
    """Draw the board's present outline (dotted) and its target; `most` is (columns, lines) at most."""
    from rich.text import Text

    drawing = state.drawing
    if drawing is None or most[0] < 10 or most[1] < 4:
        return None
    height, width = drawing.pixels.shape[:2]
    rows = draw_outlines((width, height), drawing.wanted_px, drawing.present_px, most)
    # Guidance switches between cameras, so the border names the camera.
    name = f" {drawing.camera} "[: len(rows[0]) - 3]
    rows[0] = f"┌─{name}{rows[0][2 + len(name) :]}"
    return Text("\n".join(rows), style="green" if drawing.is_there else "", no_wrap=True)


def _clock(state: LiveState) -> str:
    elapsed_s = int(state.elapsed_s)
    return f"{elapsed_s // 60:02d}:{elapsed_s % 60:02d}"


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)  # noqa: T201
