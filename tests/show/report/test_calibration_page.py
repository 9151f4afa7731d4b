"""The report of a calibration: without requests, its links lead somewhere, and its sums add up."""

import re
from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.geometry import invert
from lce_rig.rig import load_rig
from lce_rig.show.report.calibration_drawings import gather
from tests.export.conftest import calibration as without_boards

from .conftest import RLFS

_DRAWINGS = 5


@pytest.mark.parametrize("which", ["one_page", pytest.param("two_page", marks=pytest.mark.long)])
def test_page_is_small_and_self_contained(which, request):
    text = request.getfixturevalue(which)
    assert len(text) < 3_000_000
    assert "http:" not in text and "https:" not in text and "<script" not in text
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', text)
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'" and "script-src" not in rules
    assert not any("http" in sources or "*" in sources for sources in rules.values())
    ids = re.findall(r' id="([^"]+)"', text)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'href="#([^"]+)"', text) + re.findall(r"url\(#([^)]+)\)", text)) <= set(ids)


def test_every_capture_s_marks_lead_to_its_overlay(one, one_page):
    for k, residual in enumerate(one.residuals):
        # Outline, plate from above, residual by range, image; and the table.
        assert one_page.count(f'href="#pair-0-capture-{k}"') == 5
        assert f'src="overlays/{residual.capture}.png"' in one_page


def test_drawn_points_agree_with_residuals(one):
    board, lens = RLFS.board.to_board(), RLFS.cameras["cam"].to_intrinsics()
    evidence = gather(one, board, lens)
    for k, residual in enumerate(one.residuals):
        own = evidence.plane_m[evidence.capture == k]
        assert np.abs(own).mean() == pytest.approx(residual.plane_mean_m)
    # Farther from the camera than its board: behind.
    far = replace(one, T_cam_lidar=one.T_cam_lidar + np.pad([[0.0, 0, 0, 0.1]], ((2, 1), (0, 0))))
    assert gather(far, board, lens).plane_m.mean() > 0.05


def test_page_pose_is_camera_in_lidar_frame(one, one_page):
    found = re.findall(r"<td>([xyz])</td><td class=\"figure\">(\S+) m</td>", one_page)
    assert [float(value) for _, value in found] == pytest.approx(invert(one.T_cam_lidar)[:3, 3], abs=1e-4)


def test_a_failed_result_is_explained(one, page):
    reasons = (
        Finding("verdict.text", "error", stored=("the <board> moved", "hold it `still`")),
        Finding("verdict.not_certified", "warning", figures={"gap": 0.1}),
    )
    text = page(RLFS, replace(one, verdict="fail", findings=reasons))
    assert "&lt;board&gt;" in text
    assert "<code>still</code>" in text
    assert text.count("<svg ") == _DRAWINGS


@pytest.mark.parametrize("has_previous", [True, False])
def test_page_names_previous_if_there_is_one(one, page, has_previous):
    failed = replace(one, verdict="fail")
    text = page(RLFS, failed, has_previous=has_previous)
    assert ("previous/" in text) is has_previous


def test_page_of_file_lacks_only_boards(page):
    text = page(load_rig("rles"), without_boards())
    assert "<svg " not in text
    assert "näher – ¼ m" in text


def test_causes_of_refusal_are_named(one, page):
    refused = {"<000007>": Refusal("image.too_dark", figures={"grey_99": 20.0})}
    text = page(RLFS, replace(one, captures_refused=refused))
    assert "&lt;000007&gt;" in text and "<000007>" not in text
