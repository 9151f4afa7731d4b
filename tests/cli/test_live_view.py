"""A live collection in a terminal of 80x24, and in plain lines."""

import io

import numpy as np
import pytest
from rich.console import Console

from lce_rig.collect.guidance.planner import Coverage
from lce_rig.collect.live.state import Cue, Drawing, LiveState, StreamState
from lce_rig.show.screen.live_view import Bell, PlainView, draw_outlines, qr_lines, render

SQUARE = np.array([[300.0, 200.0], [700, 240], [660, 500], [280, 470], [300, 200]])
STREAMS = (
    StreamState("davis.frames", 24.9, 0, True, "", "2.1 m, 0.12 px"),
    StreamState("davis.events", 1.2e6),
    StreamState("lidar", 10.0, 3, False, "2 rings on the board: come 0.8 m closer"),
    StreamState("sync", 12.0),
)
STATE = LiveState(
    rig="rles",
    session="/home/somebody/with/a/long/path/to/a/session-of-today",
    elapsed_s=75.2,
    phase="holding",
    headline="hold still",
    detail="",
    hold_s=1.24,
    n_captures=7,
    n_wanted=15,
    streams=STREAMS,
    drawing=Drawing("davis.frames", np.zeros((720, 1280), np.uint8), SQUARE, 0.8 * SQUARE + [500, 100]),
    coverage=Coverage(0.3, 0.5, 1.0, 0.25, 0.0),
    sigma_deg=0.12,
    sigma_mm=8.3,
    target_deg=0.2,
    target_mm=10.0,
    cues=(Cue(1, "captured"), Cue(2, "refused")),
    log=("01:02 captured 000006 (0.12 s)", "01:04 not captured: " + 4 * "it stands there already "),
    notes=("boards must stand still: " + 6 * "no clock is tied ", "second", "third"),
)


def drawn(state, links=(), width=80, height=24):
    console = Console(width=width, height=height, file=io.StringIO(), force_terminal=False)
    console.print(render(state, links=links, height=height, width=width))
    return console.file.getvalue().rstrip("\n").split("\n")


def test_everything_fits_into_80_by_24():
    lines = drawn(STATE)
    assert len(lines) <= 24
    assert max(len(line) for line in lines) <= 80
    text = "\n".join(lines)
    for wanted in ("HOLD STILL", "1.2 s", "7 of 15", "0.8 m", "3 lost", "1.20M/s", "0.12 deg", "01:04"):
        assert wanted in text


def test_live_view_labels_image_of_several_cameras():
    (first, *others) = STREAMS
    two = (first._replace(name="left.frames"), first._replace(name="right.frames"), *others[:1])
    drawing = STATE.drawing._replace(camera="right.frames")
    text = "\n".join(drawn(STATE._replace(streams=two, drawing=drawing)))
    assert "┌─ right.frames ─" in text
    assert len(drawn(STATE._replace(streams=two, drawing=drawing))[0]) <= 80


SAID = STATE._replace(
    detail="cannot be used here: the board at 4.3 m is tilted 62 deg (limit 60 deg), half of it is hidden",
    streams=(*STREAMS[:2], STREAMS[2]._replace(reason=STREAMS[2].reason + " or lower it by 12 cm, slowly")),
    notes=(
        "boards must stand still: no sync board ties the cameras' clocks, whatever they are, to the LiDAR's",
    ),
    log=(
        "01:02 captured 000006",
        "01:09 000007 taken back (lce-rig captures /a/b/of-today --restore 000007)",
    ),
    goes_on="about 3 more (held-out 0.19 > 0.18 deg)",
)


@pytest.mark.parametrize(("width", "height"), [(80, 24), (100, 30), (120, 40)])
def test_live_view_long_text_is_not_cut(width, height):
    """A wide terminal has a larger drawing."""
    lines = drawn(SAID, width=width, height=height)
    assert len(lines) <= height and max(len(line) for line in lines) <= width
    # The streams' columns are side by side, as are bars and drawing.
    words = " ".join(" ".join(lines).split())
    for sentence in (SAID.detail, *SAID.notes, SAID.log[-1], SAID.goes_on):
        assert sentence in words
    assert all(word in words for word in SAID.streams[2].reason.split())
    drawing = next(line for line in lines if "┌" in line)
    assert drawing.index("┐") - drawing.index("┌") >= (20 if height == 24 else 0.45 * width)


def test_live_view_empty_state_is_drawn():
    nothing = {"drawing": None, "coverage": None, "sigma_deg": np.nan, "sigma_mm": np.nan, "hold_s": None}
    assert "HOLD STILL" in "\n".join(drawn(STATE._replace(streams=(), **nothing)))
    beyond = np.array([[-500.0, 100.0], [np.nan, np.nan], [3000, 400], [100, 5000], [-500, 100]])
    assert len(draw_outlines((346, 260), beyond, beyond, (40, 9))) == 9


def test_bell_rings_once_for_capture_twice_for_refusal():
    clock = [0.0]
    rung = []

    def heard(state, n_states=20, is_silent=False):
        bell = Bell(is_silent, lambda: rung.append(clock[0]), lambda: clock[0])
        rung.clear()
        for _ in range(n_states):
            clock[0] += 0.05
            bell.take(state)
        return rung

    assert len(heard(STATE._replace(cues=(Cue(1, "captured"),)))) == 1
    twice = heard(STATE._replace(cues=(Cue(2, "refused"),)))
    assert len(twice) == 2 and twice[1] - twice[0] >= 0.2 - 1e-9
    assert heard(STATE._replace(cues=(Cue(3, "tick"),))) == []
    # The last sound counts: a capture right after a refused one must not sound refused.
    assert len(heard(STATE._replace(cues=(Cue(1, "refused"), Cue(2, "captured"))))) == 1
    assert heard(STATE, is_silent=True) == []


def test_qr_code_fits_and_encodes_link():
    import cv2

    link = "http://192.168.100.200:8765/?token=q3Zk9Xw0aB4_"
    lines = qr_lines(link)
    assert len(lines) + 2 <= 24 and max(map(len, lines)) <= 80
    # Each character shows two modules, light ones drawn.
    halves = {" ": (0, 0), "▀": (1, 0), "▄": (0, 1), "█": (1, 1)}
    rows = [[halves[character][k] for character in line] for line in lines for k in (0, 1)]
    picture = np.kron(255 * np.array(rows[: len(lines[0])], np.uint8), np.ones((8, 8), np.uint8))
    assert cv2.QRCodeDetector().detectAndDecode(picture)[0] == link
    assert qr_lines("http://127.0.0.1:8765/") == [] == qr_lines("http://localhost:8765/")


def test_plain_lines_report_each_change_once(capsys):
    view = PlainView(Bell(is_silent=True))
    moving = STATE._replace(
        phase="moving", headline="one step left", hold_s=None, cues=(), log=(), notes=("a note",)
    )
    view.show(moving)
    view.show(moving._replace(elapsed_s=75.4, headline="30 cm left"))
    view.show(moving._replace(elapsed_s=79.0, headline="20 cm left", detail="2 rings"))
    captured = {"cues": (Cue(1, "captured"),), "log": ("01:19 captured 000001",), "n_logged": 1}
    view.show(moving._replace(elapsed_s=79.1, headline="20 cm left", **captured))
    # A message without a sound, such as a reconnected sensor, is printed as well.
    told = ("01:19 captured 000001", "01:19 lidar is back")
    view.show(moving._replace(elapsed_s=79.2, phase="ended", headline="over", log=told, n_logged=2))
    out, err = capsys.readouterr()
    assert out == ""
    lines = err.splitlines()
    assert [line.split()[0] for line in lines] == ["note:", "01:15", "01:19", "01:19", "01:19"]
    assert "moving:" in lines[1] and "20 cm" in lines[2] and "2 rings" in lines[2]
    assert tuple(lines[3:]) == told


def test_live_view_drawing_keeps_its_size():
    before = STATE._replace(goes_on="", notes=("boards must stand still: no sync board",), log=())
    after = before._replace(goes_on="captures to go: 10 (minimum 6, below 0.18 deg, 9 mm)")
    borders = [[line.find("┌") for line in drawn(state)] for state in (before, after)]
    widths = [max(len(line) for line in drawn(state) if "┐" in line) for state in (before, after)]
    assert borders[0] == borders[1] and widths[0] == widths[1]
