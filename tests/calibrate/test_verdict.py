"""The verdict: a sound result passes, and each kind of doubt is named with its figure."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.calibrate import CalibrateOptions, ChannelsEstimate, calibrate
from lce_rig.calibrate.report import NO_CERTIFICATE
from lce_rig.calibrate.scale import compare_scales
from lce_rig.calibrate.verdict import judge
from lce_rig.core.geometry import perturb
from lce_rig.core.results import Certificate, Refusal
from lce_rig.rig import load_rig
from tests.calibrate.boards import BOARD, simulate

RIG = load_rig("rlfs")


@pytest.fixture(scope="module")
def estimate():
    return calibrate(simulate(20, seed=1), BOARD, CalibrateOptions(n_draws=3))


def verdict_of(estimate, rig=RIG, n_captures=20):
    return judge(ChannelsEstimate(estimate, ()), rig, "cam", "lidar", n_captures)


def test_a_sound_result_passes_without_reasons(estimate):
    assert verdict_of(estimate) == ("pass", ())


def test_a_result_without_certificate_fails(estimate):
    verdict, reasons = verdict_of(replace(estimate, certificate=Certificate(False, 0.3)))
    assert verdict == "fail"
    assert "gap 3.0e-01" in reasons[0]


def test_a_method_without_certificates_is_marginal_and_named(estimate):
    verdict, reasons = verdict_of(replace(estimate, certificate=NO_CERTIFICATE, method="other"))
    assert verdict == "marginal"
    assert "method other has no certificate" in reasons[0]


@pytest.mark.parametrize(("factor", "expected"), [(0.5, "pass"), (2.0, "marginal"), (9.0, "fail")])
def test_a_deviation_above_the_target_is_marginal_and_far_above_it_fails(estimate, factor, expected):
    target_deg = RIG.calibration.target_sigma_deg
    cov = np.diag([1e-8] * 3 + [(np.radians(factor * target_deg)) ** 2 / 3] * 3)
    verdict, reasons = verdict_of(replace(estimate, cov=cov))
    assert verdict == expected
    assert all("weakest" in reason for reason in reasons)


def test_where_the_lidar_itself_misses_the_target_more_captures_are_not_advised(estimate):
    cov = np.diag([0.015**2 / 3] * 3 + [1e-8] * 3)
    by_scatter = replace(estimate, cov=cov)
    figures = dict(estimate.diagnostics) | {"sigma_systematic_translation_m": 0.014}
    by_lidar = replace(by_scatter, diagnostics=figures)
    assert "collect more captures" in verdict_of(by_scatter)[1][0]
    assert "collect more captures" not in verdict_of(by_lidar)[1][0]
    assert "range_offset_sigma_m" in verdict_of(by_lidar)[1][0]


def test_a_result_far_from_the_nominal_extrinsic_fails_with_both_figures(estimate):
    moved = perturb(estimate.T_cam_lidar, np.array([0.3, 0, 0, 0, 0, np.radians(20)]))
    verdict, reasons = verdict_of(replace(estimate, T_cam_lidar=moved))
    assert verdict == "fail"
    assert "deg and" in reasons[0]
    assert "tolerance 5 deg, 50 mm" in reasons[0]


def test_sensors_that_disagree_in_many_captures_are_a_doubt(estimate):
    refused = {f"x{k}": Refusal("pair", "elsewhere", "hold still") for k in range(10)}
    assert verdict_of(replace(estimate, refused=refused))[0] == "marginal"
    refused |= {f"y{k}": Refusal("calibrate", "off", "hold still") for k in range(20)}
    verdict, reasons = verdict_of(replace(estimate, refused=refused))
    assert verdict == "fail"
    assert "30 of 50 captures" in reasons[0]


def test_boards_that_moved_between_picture_and_scan_are_a_doubt(estimate):
    moving = dict(estimate.diagnostics) | {"fit_plane_rms_m": 0.025}
    verdict, reasons = verdict_of(replace(estimate, diagnostics=moving))
    assert verdict == "marginal"
    assert "25 mm apart" in reasons[0]


def test_few_usable_captures_of_many_are_a_doubt(estimate):
    verdict, reasons = verdict_of(estimate, n_captures=50)
    assert verdict == "marginal"
    assert reasons[0].startswith("only 20 of 50 captures")


@pytest.mark.parametrize(("factor", "expected"), [(1.01, "pass"), (1.04, "marginal"), (0.9, "fail")])
def test_a_plate_of_another_size_than_the_profiles_is_named(estimate, factor, expected):
    def resized(seen):
        quality = {"width_m": factor * BOARD.width_m, "width_sigma_m": 0.01}
        return replace(seen, lidar=replace(seen.lidar, quality=quality))

    other = {name: resized(seen) for name, seen in estimate.observations.items()}
    verdict, reasons = verdict_of(replace(estimate, observations=other))
    assert verdict == expected
    assert expected == "pass" or "the plate's width is" in reasons[0]


def test_large_residuals_fail_and_name_their_limit(estimate):
    bad = replace(estimate, metrics=replace(estimate.metrics, mpe_m=0.08))
    verdict, reasons = verdict_of(bad)
    assert verdict == "fail"
    assert "80 mm on average, limit 30 mm" in reasons[0]


def test_the_worst_reason_comes_first(estimate):
    doubtful = replace(estimate, certificate=Certificate(False, 1.0), held_out_m=1.0)
    verdict, reasons = verdict_of(doubtful)
    assert verdict == "fail"
    assert reasons[0].startswith("not certified")
    assert len(reasons) == 2


def test_squares_of_the_wrong_size_are_told_from_the_distances():
    """The camera believes in 70 mm squares where they measure 73.5 mm: it sees the boards 5 % too near."""
    captures = []
    for item in simulate(20, seed=2):
        T = item.image.T_cam_board.copy()
        T[:3, 3] /= 1.05
        image = replace(item.image, T_cam_board=T, T_cam_board_alternative=None)
        captures.append(replace(item, image=image))
    wrong = calibrate(captures, BOARD, CalibrateOptions(n_draws=3))
    check = compare_scales([wrong.observations[name] for name in wrong.used])
    assert abs(check.ratio - 1 / 1.05) < 0.005
    verdict, reasons = verdict_of(wrong)
    assert verdict == "fail"
    assert any("the squares measure 73." in reason for reason in reasons)


def test_scales_agree_within_their_sigma_where_the_board_is_right():
    errors = []
    for seed in range(10):
        found = calibrate(simulate(15, seed), BOARD, CalibrateOptions(n_draws=1))
        check = compare_scales([found.observations[name] for name in found.used])
        errors.append((check.ratio - 1) / check.sigma)
    assert np.sqrt(np.mean(np.square(errors))) < 2.0
