"""`lce-rig board` as a user runs it."""

import pytest
import yaml

from lce_rig.rig import BoardSettings, load_rig
from lce_rig.rig.board_settings import board_block


@pytest.mark.parametrize(
    ("words", "board"),
    [
        (["--type", "charuco", "--squares", "9x7", "--size", "0.07"], "charuco:9x7,0.07,0.0525,5X5_50"),
        (["--type", "aprilgrid", "--squares", "4x3", "--size", "0.13"], "aprilgrid:4x3,0.13,0.3"),
        (["--squares", "9x7", "--size", "0.07"], "8x6,0.07"),
    ],
)
def test_the_block_that_it_prints_is_that_of_a_new_profile(lce_rig, tmp_path, words, board):
    outcome = lce_rig("board", *words, "--plate", "0.8x0.7", "-o", tmp_path / "board.pdf")
    assert outcome.code == 0
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    settings = BoardSettings.model_validate(yaml.safe_load(outcome.out)["board"])
    profile = tmp_path / "mine.yaml"
    assert (
        lce_rig("rigs", "new", "mine", "--from", "rlfs", "--board", f"{board},0.8x0.7", "-o", profile).code
        == 0
    )
    assert load_rig(profile).board.to_board() == settings.to_board()
    assert BoardSettings.model_validate(board_block(settings.to_board())).to_board() == settings.to_board()
    # And back to a checkerboard.
    again = tmp_path / "again.yaml"
    words = ("rigs", "new", "again", "--from", profile, "--board", "9x6,0.068,0.8x0.6", "-o", again)
    assert lce_rig(*words).code == 0
    assert load_rig(again).board.to_board().cols == 9


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--squares", "9", "--size", "0.07"], 2),
        (["--squares", "9x7", "--size", "0.07", "-o", "board.doc"], 2),
        (["--squares", "9x7", "--size", "70"], 3),
        (["--squares", "9x7", "--size", "0.07", "--plate", "0.5x0.4"], 3),
        (["--type", "charuco", "--squares", "9x7", "--size", "0.07", "--dictionary", "5X5"], 3),
        (["--type", "charuco", "--squares", "9x7", "--size", "0.07", "--marker", "0.08"], 3),
        (["--type", "aprilgrid", "--squares", "30x30", "--size", "0.05"], 3),
        (["--squares", "9x7", "--size", "0.07", "--marker", "0.05"], 3),
        (["--squares", "9x7", "--size", "0.07", "-o", "/nowhere/board.pdf"], 8),
    ],
)
def test_what_cannot_be_drawn_is_refused(lce_rig, words, code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert lce_rig("board", *words).code == code
    assert not list(tmp_path.iterdir())
