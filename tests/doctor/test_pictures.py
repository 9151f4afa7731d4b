"""Exposure, sharpness and events are judged by what they do to corners."""

import cv2
import numpy as np
import pytest

from lce_rig.core.data import Events, Image
from lce_rig.core.findings import Finding, Refusal
from lce_rig.doctor.examination import Examination
from lce_rig.doctor.streams import check_board, check_events, check_image

from .observed import START_NS, S, camera, codes, examination, look, make_rig

SHAPE = (260, 346)


def chequered() -> np.ndarray:
    rows, cols = np.indices(SHAPE) // 26
    return np.where((rows + cols) % 2, 200, 40).astype(np.uint8)


def judged(pixels: np.ndarray):
    seen = camera(duration_s=0.5)
    seen.images["frames"] = Image("cam", "frames", START_NS, pixels)
    line = look(check_image, examination(seen), "cam")
    assert line is not None
    return line


def test_a_sharp_picture_in_good_light_is_green() -> None:
    line = judged(chequered())
    assert line.severity == "note" and (line.figures["grey_1"], line.figures["grey_99"]) == (40, 200)
    assert line.figures["edge_px"] == pytest.approx(1.4, abs=0.05)


@pytest.mark.parametrize(
    ("pixels", "severity", "code"),
    [
        (np.full(SHAPE, 17, np.uint8), "error", "exposure.nothing_visible"),
        ((chequered() // 6), "warning", "exposure.dark"),
        (
            np.where(np.indices(SHAPE)[1] < 120, 255, chequered()).astype(np.uint8),
            "warning",
            "exposure.bright",
        ),
        (cv2.GaussianBlur(chequered(), (0, 0), 6), "warning", "exposure.blurred"),
    ],
)
def test_what_spoils_a_picture_is_named(pixels: np.ndarray, severity: str, code: str) -> None:
    line = judged(pixels)
    assert line.severity == severity and codes(line) == ["exposure.grey", code]


def events(seed: int, n: int) -> Events:
    rng = np.random.default_rng(seed)
    t_ns = START_NS + np.sort(rng.integers(0, S, n)) // 1000 * 1000
    x, y = rng.integers(0, SHAPE[1], n).astype(np.uint16), rng.integers(0, SHAPE[0], n).astype(np.uint16)
    return Events("cam", t_ns, x, y, rng.random(n) < 0.5, SHAPE[1], SHAPE[0], START_NS + S)


def test_events_of_a_busy_scene_are_green_and_a_flickering_lamp_is_named() -> None:
    busy = camera(duration_s=0.5)
    busy.take(events(1, 900_000))
    line = look(check_events, examination(busy), "cam")
    assert line is not None and line.severity == "note"
    lamp = camera(duration_s=0.5)
    steady = events(1, 900_000)
    is_bright = (steady.t_ns // 5_000_000) % 2 == 0
    lamp.take(Events("cam", steady.t_ns, steady.x, steady.y, is_bright, SHAPE[1], SHAPE[0], steady.host_ns))
    line = look(check_events, examination(lamp), "cam")
    assert (
        line is not None and line.severity == "warning" and line.figures["frequency_hz"] == pytest.approx(100)
    )


def test_the_board_is_green_where_any_channel_sees_it() -> None:
    unseen = Refusal("image.no_events")
    seen = Finding("board.in_events", "note", figures={"distance_m": 2.1})

    def line(*sights: Finding):
        boards = {("cam", f"channel{n}"): sight for n, sight in enumerate(sights)}
        return look(check_board, Examination(make_rig(), boards=boards), "cam")

    assert line() is None
    both, none = line(unseen, seen), line(unseen)
    assert both is not None and both.severity == "note" and both.figures["distance_m"] == 2.1
    assert none is not None and (none.severity, codes(none)) == ("warning", ["image.no_events"])
