"""The verdict: a sound result passes, and each kind of finding is named with its figure."""

import functools
import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lce_rig.calibrate import EstimateSettings, fit_extrinsic
from lce_rig.core.calibration import Certificate, ChannelResult
from lce_rig.core.findings import KINDS, Finding, Refusal
from lce_rig.core.geometry import PoseDifference, difference, invert, perturb
from lce_rig.detect.findings import LIDAR_OTHER_SIZE
from lce_rig.judge.findings import (
    INTRINSICS,
    LAST_REJECTED,
    MOVED,
    NOT_CERTIFIED,
    PLANE_RESIDUAL,
    PLANES_APART,
    PLATE_SIZE,
    RANGE_OFFSET,
    ROTATION_UNCERTAIN,
    SCALE_OFF,
    SCATTERED,
    TIME_OFFSET,
    arrange,
    causes_of,
)
from lce_rig.judge.validate import validate
from lce_rig.judge.verdict import distance_findings, judge, plate_findings
from lce_rig.lens.models import LensPrior
from lce_rig.rig import NominalExtrinsic, load_rig
from tests.calibrate.boards import BOARD, CAMERA, T_FORWARD, simulate
from tests.calibrate.test_tolerances import KNOWN, REAL

RIG = load_rig("rlfs")


@pytest.fixture(scope="module")
def estimate():
    return fit_extrinsic(simulate(20, seed=1), BOARD, EstimateSettings())


@functools.cache
def examined(estimate, lens=CAMERA):
    return validate(estimate, RIG, "cam", "lidar", lens)


@pytest.fixture(scope="module")
def verdict_of(estimate):
    """Judge a changed estimate with the checks of the unchanged one."""

    def judged(changed, n_captures=20, rig=RIG):
        cov = changed.cov
        examination = replace(examined(estimate), cov=cov, cov_agreed=cov)
        return judge(changed, examination, rig, "cam", "lidar", n_captures)

    return judged


def examined_verdict_of(estimate, lens=CAMERA):
    return judge(estimate, examined(estimate, lens), RIG, "cam", "lidar", len(estimate.used))


def test_consistent_result_passes_without_reasons(estimate, verdict_of):
    assert verdict_of(estimate) == ("pass", ())


@pytest.mark.parametrize(
    ("change", "verdict", "code", "figures"),
    [
        ({"certificate": Certificate(False, 0.3)}, "fail", "verdict.not_certified", {"gap": 0.3}),
        (
            {"diagnostics": {"fit_plane_rms_m": 0.025}},
            *("marginal", "verdict.planes_apart", {"rms_m": 0.025}),
        ),
        (
            {"residuals": {"plane_mean_m": 0.08}},
            *("fail", "verdict.plane_residual", {"mean_m": 0.08, "limit_m": 0.03}),
        ),
    ],
)
def test_single_failed_check_decides_verdict(estimate, verdict_of, change, verdict, code, figures):
    if "diagnostics" in change:
        change = {"diagnostics": replace(estimate.diagnostics, **change["diagnostics"])}
    if "residuals" in change:
        change = {"residuals": tuple(r._replace(**change["residuals"]) for r in estimate.residuals)}
    found, reasons = verdict_of(replace(estimate, **change))
    assert (found, reasons[0].code) == (verdict, code)
    assert reasons[0].figures == pytest.approx(figures)


def test_few_usable_captures_lower_the_verdict(estimate, verdict_of):
    verdict, reasons = verdict_of(estimate, n_captures=50)
    assert verdict == "marginal" and reasons[0].figures == {"n_used": 20, "n_captures": 50}


@pytest.mark.parametrize(("factor", "expected"), [(0.5, "pass"), (2.0, "marginal"), (9.0, "fail")])
def test_verdict_follows_the_deviation(estimate, factor, expected, verdict_of):
    target_deg = RIG.calibration.target_sigma_deg
    cov = np.diag([1e-8] * 3 + [(np.radians(factor * target_deg)) ** 2 / 3] * 3)
    verdict, reasons = verdict_of(replace(estimate, cov=cov))
    assert verdict == expected
    told = {"pass": set(), "marginal": {"verdict.may_be_off"}, "fail": set()}[expected]
    assert {reason.code for reason in reasons} - {"verdict.rotation_uncertain"} == told


def test_contradiction_alone_does_not_fail(estimate):
    """It widens the reported covariance."""
    cov = np.diag([1e-8] * 3 + [np.radians(9.0 * RIG.calibration.target_sigma_deg) ** 2 / 3] * 3)
    examination = replace(examined(estimate), cov=cov, cov_agreed=estimate.cov)
    verdict, reasons = judge(estimate, examination, RIG, "cam", "lidar", 20)
    assert verdict == "marginal"
    assert [reason.code for reason in reasons] == ["verdict.rotation_uncertain", "verdict.may_be_off"]
    # Three independent axes of sigma / sqrt(3) each: chi with three degrees of freedom.
    assert reasons[1].figures["rotation_deg"] == pytest.approx(
        9.0 * RIG.calibration.target_sigma_deg / np.sqrt(3) * 2.795, rel=1e-3
    )


def test_lidar_limit_advises_range_check(estimate, verdict_of):
    cov = np.diag([0.015**2 / 3] * 3 + [1e-8] * 3)
    by_scatter = replace(estimate, cov=cov)
    figures = replace(estimate.diagnostics, sigma_systematic_translation_m=0.014)
    by_lidar = replace(by_scatter, diagnostics=figures)
    assert verdict_of(by_scatter)[1][0].action == ""
    assert verdict_of(by_lidar)[1][0].action == "measure_ranges"


def test_far_from_nominal_fails(estimate, verdict_of):
    moved = perturb(estimate.T_cam_lidar, np.array([0.3, 0, 0, 0, 0, np.radians(20)]))
    cad = [pose.model_copy(update={"source": "cad"}) for pose in RIG.nominal_extrinsics]
    drawn = RIG.model_copy(update={"nominal_extrinsics": cad})
    assert verdict_of(replace(estimate, T_cam_lidar=moved))[0] == "pass"
    verdict, reasons = verdict_of(replace(estimate, T_cam_lidar=moved), rig=drawn)
    assert verdict == "fail"
    assert reasons[0].code == "verdict.far_from_nominal"
    assert (reasons[0].figures["tolerance_deg"], reasons[0].figures["tolerance_m"]) == (5, 0.05)


@pytest.mark.parametrize("error", ["inverted", "reordered", "reordered_inverted"])
def test_nominal_with_a_usual_error_is_corrected(estimate, verdict_of, error):
    T = estimate.T_cam_lidar if error == "reordered" else invert(estimate.T_cam_lidar)
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    entry = RIG.nominal("cam", "lidar").model_dump(exclude={"matrix", "rpy_deg"}) | {
        "source": "cad",
        "translation_m": tuple(T[:3, 3]),
        "quaternion_wxyz": (w, x, y, z) if error == "inverted" else (x, y, z, w),
    }
    drawn = RIG.model_copy(update={"nominal_extrinsics": [NominalExtrinsic.model_validate(entry)]})
    verdict, reasons = verdict_of(estimate, rig=drawn)
    assert (verdict, reasons[0].code, reasons[0].action) == ("fail", "verdict.far_from_nominal", error)
    figures = reasons[0].figures
    printed = ", ".join(f"{value:.4f}" for value in figures["enter_translation_m"])
    assert f"translation_m: [{printed}]" in reasons[0].advice
    entry |= {key: figures[f"enter_{key}"] for key in ("quaternion_wxyz", "translation_m")}
    corrected = NominalExtrinsic.model_validate(entry).to_matrix()
    np.testing.assert_allclose(corrected, estimate.T_cam_lidar, atol=1e-9)


def test_nominal_inverted_as_a_matrix_is_corrected(estimate, verdict_of):
    T = invert(estimate.T_cam_lidar)
    pose = {"translation_m": T[:3, 3].tolist(), "matrix": T[:3, :3].tolist()}
    entry = NominalExtrinsic.model_validate({"camera": "cam", "lidar": "lidar", **pose})
    reasons = verdict_of(estimate, rig=RIG.model_copy(update={"nominal_extrinsics": [entry]}))[1]
    assert reasons[0].action == "inverted"
    assert len(reasons[0].figures["enter_quaternion_wxyz"]) == 4


def test_many_disagreeing_captures_lower_the_verdict(estimate, verdict_of):
    refused = {f"x{k}": Refusal("pair.no_candidate") for k in range(10)}
    assert verdict_of(replace(estimate, refused=refused))[0] == "marginal"
    refused |= {f"y{k}": Refusal("calibrate.outlier") for k in range(20)}
    verdict, reasons = verdict_of(replace(estimate, refused=refused))
    assert verdict == "fail"
    assert (reasons[0].figures["n_refused"], reasons[0].figures["n_captures"]) == (30, 50)


@pytest.mark.parametrize(("factor", "expected"), [(1.01, "pass"), (1.04, "marginal"), (0.9, "fail")])
def test_plate_size_unlike_profile_is_named(estimate, factor, expected, verdict_of):
    def resized(seen):
        quality = replace(seen.lidar.quality, width_m=factor * BOARD.width_m, width_sigma_m=0.01)
        return replace(seen, surface=replace(seen.lidar, quality=quality))

    other = {name: resized(seen) for name, seen in estimate.observations.items()}
    verdict, reasons = verdict_of(replace(estimate, observations=other))
    assert verdict == expected
    assert expected == "pass" or (reasons[0].code, reasons[0].figures["side"]) == (
        "verdict.plate_size",
        "width",
    )


def test_a_plate_refused_for_its_size_counts_as_measured():
    figures = {"side": "width", "measured_m": 0.9, "sigma_m": 0.01, "profile_m": BOARD.width_m}
    refused = [LIDAR_OTHER_SIZE.refusal(**figures)] * 3
    (finding,) = plate_findings(refused, BOARD)
    assert (finding.code, finding.severity) == ("verdict.plate_size", "error")
    assert (finding.figures["n_captures"], finding.figures["measured_m"]) == (3, 0.9)
    assert plate_findings(refused[:2], BOARD) == []


def test_plate_too_large_has_an_empty_edge(estimate):
    def enlarged(seen, n_dropped):
        sizes = {"width_m": BOARD.width_m, "width_sigma_m": 0.1}
        sizes |= {"height_m": BOARD.height_m, "height_sigma_m": 0.01}
        quality = replace(seen.lidar.quality, **sizes, n_ring_ends_dropped=n_dropped)
        return replace(seen.lidar, quality=quality)

    scans = [enlarged(seen, seen.lidar.quality.n_ring_ends) for seen in estimate.observations.values()]
    (finding,) = plate_findings(scans, BOARD)
    assert (finding.code, finding.figures["side"]) == ("verdict.plate_edge", "width")
    # A mounting may show no ring ends on two edges either; then none are off the outline.
    assert not plate_findings([enlarged(seen, 0) for seen in estimate.observations.values()], BOARD)


@pytest.mark.parametrize(
    ("factor", "codes"), [(1.01, []), (8 / 7, ["verdict.scale"]), (0.7, ["verdict.scale"])]
)
def test_distances_name_squares_or_lens(factor, codes):
    rng = np.random.default_rng(0)
    boards = rng.uniform([-1, -1, 1], [1, 1, 5], (8, 3))
    in_lidar = boards @ T_FORWARD[:3, :3] + rng.normal(0, 0.005, boards.shape)
    findings = distance_findings(factor * boards, in_lidar, 0.07)
    assert [finding.code for finding in findings] == codes
    for finding in findings:
        assert finding.figure("square_m") == pytest.approx(0.07 / factor, rel=0.01)
        assert finding.action == ""
    for finding in distance_findings(factor * boards, in_lidar, 0.07, n_misfits=4):
        assert finding.action == "lens", "squares of another size fit the corners just as well"
    order = rng.permutation(8)
    assert not distance_findings(boards, in_lidar[order], 0.07), "mixed up, distances say nothing"
    assert not distance_findings(boards[:2], in_lidar[:2], 0.07)


def test_the_worst_reason_comes_first(estimate, verdict_of):
    cov = np.diag([1e-8] * 3 + [1e-9, np.radians(0.3) ** 2, 1e-9])
    verdict, reasons = verdict_of(replace(estimate, certificate=Certificate(False, 1.0), cov=cov))
    assert verdict == "fail"
    assert [reason.code for reason in reasons] == ["verdict.not_certified", "verdict.rotation_uncertain"]


def squares_off(severity):
    return SCALE_OFF(severity=severity, scale=0.01, scale_sigma=0.001, square_m=0.069, profile_square_m=0.07)


def test_arrange_symptoms_follow_the_cause():
    plane = PLANE_RESIDUAL(mean_m=0.05, limit_m=0.03)
    note = LAST_REJECTED(capture="000014")
    listed = arrange([note, plane, squares_off("warning")])
    assert [(f.code, f.severity, f.follows) for f in listed] == [
        # The cause has the severity of its consequences.
        ("verdict.scale", "error", ""),
        ("verdict.plane_residual", "error", "verdict.scale"),
        ("verdict.last_rejected", "note", ""),
    ]


def test_arrange_worse_cause_is_first():
    certificate = NOT_CERTIFIED(severity="error", gap=0.1)
    listed = arrange([squares_off("warning"), certificate])
    assert [f.code for f in listed] == ["verdict.not_certified", "verdict.scale"]
    assert [f.follows for f in listed] == ["", ""]


@pytest.mark.parametrize(("action", "follows"), [("resolve", "verdict.scale"), ("", "")])
def test_arrange_sigmas_follow_a_contradiction_only(action, follows):
    figures = {"sigma_deg": 1.0, "target_deg": 0.2, "by_axis_deg": (1.0, 0.0, 0.0), "weakest": "rotation_x"}
    sigma = ROTATION_UNCERTAIN(severity="warning", action=action, **figures)
    listed = arrange([sigma, squares_off("warning")])
    assert [f.follows for f in listed if f.code == sigma.code] == [follows]


def test_channels_rotated_by_180_deg_are_the_cause(estimate, verdict_of):
    channels = tuple(ChannelResult(name, 20, 0.2, -0.3, 0.05) for name in ("frames", "frames"))
    turned = PoseDifference(np.array([0.1, 0, 0, 0, 0, np.pi]), 1e-6 * np.eye(6))
    verdict, listed = verdict_of(replace(estimate, channels=channels, channel_difference=turned))
    assert verdict == "fail" and [f.code for f in causes_of(listed)][:1] == ["verdict.channels_turned"]
    follows = {f.code: f.follows for f in listed}
    assert follows["verdict.channels_differ"] == follows["verdict.time_offset"] == "verdict.channels_turned"


def test_arrange_scatter_follows_late_timestamps():
    figures = {"channel": "events", "offset_s": -0.3, "sigma_s": 0.01, "enter_s": -0.3}
    late = TIME_OFFSET("davis", severity="warning", **figures)
    listed = arrange([SCATTERED(ratio=4.0), late])
    assert [(f.code, f.follows) for f in listed] == [(late.code, ""), ("verdict.scatter", late.code)]
    slightly = replace(late, severity="note")
    assert [f.code for f in arrange([SCATTERED(ratio=4.0), slightly])] == ["verdict.scatter", late.code]


@pytest.mark.parametrize(("severity", "plate"), [("error", "warning"), ("note", "note")])
def test_arrange_plate_size_follows_wrong_ranges(severity, plate):
    ranges = RANGE_OFFSET("lidar", severity=severity, offset_m=0.06, sigma_m=0.004, enter_m=0.06)
    size = PLATE_SIZE(
        severity="warning", side="width", measured_m=0.94, sigma_m=0.01, profile_m=0.9, n_captures=9
    )
    listed = arrange([size, ranges])
    assert [(f.code, f.severity) for f in listed if f.code == size.code] == [(size.code, plate)]
    assert {f.follows for f in listed if f.code == size.code} == {ranges.code}


def test_arrange_rough_lens_is_named_before_its_equals():
    moved = MOVED(severity="error", captures=("000001",), n_captures=1, place="last")
    for severity, first in (("error", "verdict.intrinsics"), ("warning", "verdict.moved")):
        listed = arrange([moved, INTRINSICS(severity=severity)])
        assert listed[0].code == first


@pytest.mark.parametrize("place", ["", "last"])
def test_arrange_any_reasons_have_one_cause(place):
    verdicts = [code for code in KINDS if code.startswith("verdict.")]
    for codes in (*itertools.combinations(verdicts, 2), *itertools.combinations(verdicts, 3)):
        assert causes_of(arrange([Finding(code, figures={"place": place}) for code in codes])), codes


@pytest.mark.parametrize(
    ("is_explained", "cause"), [(True, "verdict.scale"), (False, "verdict.planes_apart")]
)
def test_judge_symptom_alone_takes_the_cause_that_explains(estimate, is_explained, cause):
    changed = replace(estimate, diagnostics=replace(estimate.diagnostics, fit_plane_rms_m=0.025))
    examination = replace(examined(estimate), causes=[squares_off("note")], is_explained=is_explained)
    verdict, findings = judge(changed, examination, RIG, "cam", "lidar", 20)
    assert (verdict, findings[0].code) == ("marginal", cause)
    assert PLANES_APART.code in {f.code for f in findings}


@pytest.mark.parametrize(("n_misfits", "first"), [(0, "verdict.moved"), (12, "verdict.intrinsics")])
def test_judge_intrinsics_that_fit_few_images_come_first(estimate, n_misfits, first):
    moved = MOVED(
        severity="error",
        captures=("000018", "000019"),
        n_captures=2,
        place="last",
        neighbour="000017",
        rotation_deg=3.0,
        translation_m=0.0,
        chance=0.0,
    )
    other = replace(CAMERA, fx_px=1.04 * CAMERA.fx_px, fy_px=1.04 * CAMERA.fy_px)
    known = replace(KNOWN, lens=LensPrior(other, 0.004, 3.6, 2.2))
    settings = EstimateSettings("ml", laser_bias_sigma_m=0.008, range_offset_sigma_m=0.005, tolerances=known)
    rough = fit_extrinsic(simulate(20, 1, REAL), BOARD, settings)
    examination = replace(examined(rough, other), causes=[moved])
    verdict, findings = judge(rough, examination, RIG, "cam", "lidar", 20, n_misfits=n_misfits)
    assert (verdict, findings[0].code) == ("fail", first)


def test_wrong_square_size_is_measured():
    """The camera believes in 70 mm squares where they measure 73.5 mm: it sees the boards 5 % too near."""
    captures = []
    for item in simulate(20, seed=2):
        T = item.image.T_cam_board.copy()
        T[:3, 3] /= 1.05
        image = replace(item.image, T_cam_board=T, T_cam_board_alternative=None)
        captures.append(replace(item, pose=image))
    wrong = fit_extrinsic(captures, BOARD, EstimateSettings())
    verdict, reasons = examined_verdict_of(wrong)
    assert verdict != "pass" and reasons[0].code == "verdict.scale"
    (scale,) = (reason for reason in reasons if reason.code == "verdict.scale")
    assert scale.figure("square_m") == pytest.approx(0.0735, abs=5e-4)


@pytest.mark.long
def test_wrong_squares_come_before_the_lens():
    other = replace(CAMERA, fx_px=1.04 * CAMERA.fx_px, fy_px=1.04 * CAMERA.fy_px)
    profile = RIG.board.model_copy(update={"square_m": 0.93 * BOARD.square_m})
    known = replace(KNOWN, lens=LensPrior(other, 0.004, 3.6, 2.2))
    settings = EstimateSettings("ml", laser_bias_sigma_m=0.008, range_offset_sigma_m=0.005, tolerances=known)
    wrong = fit_extrinsic(simulate(20, 1, REAL), profile.to_board(), settings)
    rig = RIG.model_copy(update={"board": profile})
    examination = validate(wrong, rig, "cam", "lidar", other)
    verdict, reasons = judge(wrong, examination, rig, "cam", "lidar", 20)
    assert verdict != "pass"
    (scale,) = (reason for reason in reasons if reason.code == "verdict.scale")
    assert scale.figure("square_m") == pytest.approx(BOARD.square_m, rel=0.02)


@pytest.mark.parametrize(("focal", "severity"), [(1.01, "note"), (1.04, "warning")])
def test_wrong_lens_is_corrected_and_named(focal, severity):
    other = replace(CAMERA, fx_px=focal * CAMERA.fx_px, fy_px=focal * CAMERA.fy_px)
    known = replace(KNOWN, lens=LensPrior(other, 0.004, 3.6, 2.2))
    settings = EstimateSettings("ml", laser_bias_sigma_m=0.008, range_offset_sigma_m=0.005, tolerances=known)
    corrected = fit_extrinsic(simulate(20, 1, REAL), BOARD, settings)
    verdict, reasons = examined_verdict_of(corrected, lens=other)
    assert verdict == ("pass" if severity == "note" else "marginal")
    (named,) = (reason for reason in reasons if reason.code == "verdict.intrinsics")
    assert named.severity == severity
    off_px = corrected.lens.intrinsics.fx_px - CAMERA.fx_px
    assert abs(off_px) < 3 * corrected.lens.estimate.sigma[0]
    error = difference(corrected.T_cam_lidar, T_FORWARD)
    assert error @ np.linalg.solve(examined(corrected, other).cov, error) < 25


def test_each_axis_is_named_where_the_target_is_missed(estimate, verdict_of):
    cov = np.diag([1e-8] * 3 + [1e-9, np.radians(0.3) ** 2, 1e-9])
    _, reasons = verdict_of(replace(estimate, cov=cov))
    assert reasons[0].figures["by_axis_deg"] == pytest.approx((0.0018, 0.3, 0.0018), abs=5e-5)
