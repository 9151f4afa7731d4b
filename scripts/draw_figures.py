#!/usr/bin/env python3
"""Draw the pictures of docs/images/ that show a rig, with lce-rig itself, on simulated rigs.

draw_figures.py [NAME...]   only these; report and screens need Chromium and `pip install '.[docs]'`
"""

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import matplotlib as mpl
import matplotlib.pyplot as plt

sys.path.append(str(Path(__file__).resolve().parents[1]))
from figures import board, frames, views

from lce_rig.cli.main import run
from lce_rig.rig import load_rig

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "images"


def _save(figure: plt.Figure, name: str) -> None:
    figure.savefig(FOLDER / name, dpi=110, bbox_inches="tight", pad_inches=0.08)
    plt.close(figure)


def _board() -> None:
    _save(board.draw_board(load_rig("rlfs")), "board.png")


def _placements() -> None:
    _save(views.draw_placements(load_rig("rlfs"), views.GOOD), "placements.jpg")


def _refused() -> None:
    _save(views.draw_placements(load_rig("rlfs"), views.BAD), "refused.jpg")


def _good_and_bad() -> None:
    _save(views.draw_good_and_bad(load_rig("rlfs"), 1.0, 40.0), "good_and_bad.jpg")


def _debug() -> None:
    _save_debug_picture("rlfs", ["--captures", "4", "--seed", "1"], "000003.png", "debug.jpg")


def _events() -> None:
    options = ["--captures", "2", "--seed", "2", "--motion", "moving"]
    _save_debug_picture("rles", options, "davis.events.lidar/000001.png", "events.jpg")


def _save_debug_picture(rig: str, options: list[str], picture: str, name: str) -> None:
    """Simulate a session, and keep one of the images drawn by `check --debug-images`."""
    with tempfile.TemporaryDirectory() as folder:
        session = str(Path(folder, "session"))
        assert run(["simulate", session, "--rig", rig, *options]) == 0
        assert run(["check", session, "--debug-images"]) == 0
        drawn = cv2.imread(str(Path(session, "debug", picture)))
    cv2.imwrite(str(FOLDER / name), drawn, [cv2.IMWRITE_JPEG_QUALITY, 82])


def _frames() -> None:
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder, "session")
        assert run(["simulate", str(session), "--rig", "rlfs", "--captures", "12", "--seed", "1"]) == 0
        assert run(["calibrate", str(session)]) == 0
        _save(frames.draw_frames(session / "calibration" / "rlfs.urdf"), "frames.png")


def _report() -> None:
    """Draw the report and an overlay of the demo."""
    from figures.report import draw_report

    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder, "demo")
        assert run(["simulate", str(session), "--rig", "rlfs", "--captures", "16", "--seed", "1"]) == 0
        assert run(["calibrate", str(session)]) == 0
        assert run(["verify", str(session)]) == 0
        overlay = cv2.imread(str(session / "calibration" / "overlays" / "000004.png"))
        Path(folder, "browser").mkdir()
        drawn = draw_report(session / "calibration" / "report.html", Path(folder, "browser"))
    cv2.imwrite(str(FOLDER / "report.png"), drawn, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    small = cv2.resize(
        overlay, (1200, 1200 * overlay.shape[0] // overlay.shape[1]), interpolation=cv2.INTER_AREA
    )
    cv2.imwrite(str(FOLDER / "overlay.jpg"), small, [cv2.IMWRITE_JPEG_QUALITY, 88])


def _screens() -> None:
    from figures.screens import draw_screens

    draw_screens(FOLDER)


FIGURES: dict[str, Callable[[], None]] = {
    "board": _board,
    "placements": _placements,
    "refused": _refused,
    "good_and_bad": _good_and_bad,
    "debug": _debug,
    "events": _events,
    "frames": _frames,
    "report": _report,
    "screens": _screens,
}

if __name__ == "__main__":
    mpl.use("Agg")
    plt.rcParams["font.size"] = 13
    for name in sys.argv[1:] or FIGURES:
        FIGURES[name]()
        print(name)
