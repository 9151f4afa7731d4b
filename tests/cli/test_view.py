"""view: a hint without a display, and a result that must be there."""

import pytest


@pytest.fixture(autouse=True)
def _no_display(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


def test_view_without_display_exits_with_5(lce_rig, calibrated):
    outcome = lce_rig("view", calibrated)
    assert outcome.code == 5
    assert "--output" in outcome.err


def test_without_a_result_it_exits_with_4(lce_rig, session):
    assert lce_rig("view", session).code == 4


def test_missing_capture_is_refused(lce_rig, calibrated):
    assert lce_rig("view", calibrated, "--capture", "999999").code == 4


def test_view_keeps_file_that_is_not_an_image(lce_rig, calibrated, tmp_path):
    file = tmp_path / "notes.txt"
    file.write_text("mine")
    assert lce_rig("view", calibrated, "-o", file).code == 5
    assert file.read_text() == "mine"
