from types import MappingProxyType

import numpy as np
import pytest
from benchmarks.corruption_causes import (
    CAUSES,
    PROFILE,
    cause_of_error,
    first_cause,
    independent_causes,
)
from benchmarks.corruption_detections import (
    with_bow,
    with_contrast,
    with_focus_drift,
    with_rolling_shutter,
    with_second_board,
)
from benchmarks.corruption_draws import draw_halves, print_draws
from benchmarks.corruption_kinds import SOUND, corruptions
from benchmarks.corruption_outcomes import Outcome, measure_causes, print_causes
from benchmarks.corruption_sessions import Samples, some_of
from benchmarks.measured import MEASURED

from lce_rig.calibrate.findings import FEW_AGREE, OUTLIER
from lce_rig.core.errors import NotEnoughDataError, ProfileError
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import invert, transform
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.findings import FEW_DETECTED
from tests.calibrate.boards import CAMERA, T_FORWARD, simulate
from tests.saved_results import made_calibration
from tests.shared import changed

BY_NAME = MappingProxyType({kind.name: kind for kind in corruptions()})


@pytest.fixture(scope="module")
def profile(rlfs):
    """The lens that boards are simulated with."""
    lens = {key: getattr(CAMERA, key) for key in ("fx_px", "fy_px", "cx_px", "cy_px", "distortion")}
    return changed(rlfs, **{f"cameras__cam__intrinsics__{key}": value for key, value in lens.items()})


@pytest.fixture(scope="module")
def found():
    items = simulate(8, seed=3)
    images = {item.capture: item.image for item in items}
    return Detections({("cam", "frames"): images}, {"lidar": {item.capture: [item.lidar] for item in items}})


def boards_of(found):
    (images,), (scans,) = found.images.values(), found.lidars.values()
    return [(images[name], scans[name][0]) for name in sorted(images)]


def judged(*findings, **fields):
    return made_calibration(T_FORWARD, np.eye(6), findings=findings, **fields)


def outcome(corruption, cause, *others, verdict="fail", **fields):
    causes = tuple(filter(None, (cause, *others)))
    return Outcome("rlfs", corruption, "ml", "", verdict, "", cause, causes, **fields)


def test_corruptions_names_are_unique():
    assert len(BY_NAME) == len(corruptions())


def test_corruptions_but_none_have_causes():
    assert [kind.name for kind in corruptions() if not kind.causes] == [SOUND]


def test_is_beyond_within_three_sigmas_is_false(rlfs):
    assert not BY_NAME["focal length of the profile +0.5 %"].is_beyond(rlfs)
    assert BY_NAME["focal length of the profile -1 %"].is_beyond(rlfs)


def test_is_beyond_exact_profile_is_true(rlfs):
    exact = changed(rlfs, board__square_sigma_m=0.0)
    assert BY_NAME["squares of the profile +0.5 %"].is_beyond(exact)


def test_is_beyond_without_entry_is_true(rlfs):
    assert BY_NAME["LiDAR drifts by 1 deg"].is_beyond(rlfs)


def test_first_cause_takes_the_first_reason():
    notes = Finding("verdict.scale", "note"), Finding("verdict.may_be_off", "note")
    assert first_cause(judged(*notes, Finding("verdict.plane_residual"))) == "verdict.plane_residual"


def test_first_cause_without_reasons_is_a_note():
    notes = Finding("verdict.may_be_off", "note"), Finding("verdict.scale", "note")
    assert first_cause(judged(*notes)) == "verdict.scale"


def test_first_cause_of_a_pass_is_a_refusal():
    refused = {"000003": OUTLIER.refusal(plane_m=0.1)}
    assert first_cause(judged(captures_refused=refused)) == "calibrate.outlier"
    assert first_cause(judged()) == ""


def test_independent_causes_leave_out_symptoms_and_notes():
    findings = (
        Finding("verdict.scale"),
        Finding("verdict.planes_apart"),
        Finding("verdict.moved", "note"),
        Finding("verdict.plate_size", "warning"),
    )
    assert independent_causes(judged(*findings)) == ("verdict.scale", "verdict.plate_size")


def test_causes_are_no_symptoms():
    symptoms = (
        "plane_residual edge_residual planes_apart sensors_disagree shares_differ rotation_uncertain "
        "translation_uncertain few_used few_placements scene channels_differ cameras_differ"
    )
    assert not CAUSES & {f"verdict.{name}" for name in symptoms.split()}


def test_cause_of_error_reads_its_finding():
    error = NotEnoughDataError.of(FEW_AGREE("cam", n_agreeing=2, n_captures=9))
    assert cause_of_error(error) == "shortage.few_agree"
    assert cause_of_error(ProfileError("the board does not fit")) == PROFILE


@pytest.mark.parametrize(("n_detected", "code"), [(2, "lidar.no_plate"), (5, "shortage.few_detected")])
def test_cause_of_error_few_detected_is_the_refusal(n_detected, code):
    causes = ((7, "lidar.no_plate", "lidar: no plate"),)
    shortage = FEW_DETECTED("cam", n_detected=n_detected, n_captures=9, n_needed=6, causes=causes)
    assert cause_of_error(NotEnoughDataError.of(shortage)) == code


def test_bow_raises_the_middle_along_rays(profile, found):
    for (_, flat), (_, bent) in zip(
        boards_of(found), boards_of(with_bow(profile, found, 0.008)), strict=True
    ):
        raised = transform(invert(flat.T_lidar_board), bent.points)[:, [0, 2]]
        level = transform(invert(flat.T_lidar_board), flat.points)[:, 2]
        is_middle = abs(raised[:, 0]) < 0.05
        assert np.median(raised[is_middle, 1] - level[is_middle]) == pytest.approx(0.008, abs=0.0015)
        rays = [p / np.linalg.norm(p, axis=1, keepdims=True) for p in (flat.points, bent.points)]
        np.testing.assert_allclose(*rays, atol=1e-9)


def test_bow_moves_corners(profile, found):
    pairs = zip(boards_of(found), boards_of(with_bow(profile, found, 0.008)), strict=True)
    for (flat, _), (bent, _) in pairs:
        assert 0.1 < np.linalg.norm(bent.corners_px - flat.corners_px, axis=1).max() < 10


def test_contrast_lengthens_dark_squares_only(profile, found):
    pairs = zip(boards_of(found), boards_of(with_contrast(profile, found, T_FORWARD, 0.015)), strict=True)
    for (_, plain), (_, printed) in pairs:
        longer_m = np.linalg.norm(printed.points, axis=1) - np.linalg.norm(plain.points, axis=1)
        is_dark = longer_m > 0.007
        np.testing.assert_allclose(longer_m, 0.015 * is_dark, atol=1e-6)
        assert 0.2 < is_dark.mean() < 0.6


def test_focus_drift_grows_to_the_last_image(profile, found):
    before, after = boards_of(found), boards_of(with_focus_drift(profile, found, 0.01))
    ratios = [new.distance_m / old.distance_m for (old, _), (new, _) in zip(before, after, strict=True)]
    np.testing.assert_allclose(ratios[0], 1, atol=1e-4)
    np.testing.assert_allclose(ratios[-1], 1 / 1.01, atol=1e-3)


def test_second_board_is_searched_farther_in_the_second_half(profile, found):
    before, after = boards_of(found), boards_of(with_second_board(profile, found, 0.9))
    ratios = [new.distance_m / old.distance_m for (old, _), (new, _) in zip(before, after, strict=True)]
    np.testing.assert_allclose(ratios[:4], 1, atol=1e-4)
    np.testing.assert_allclose(ratios[4:], 1 / 0.9, rtol=0.01)


def test_rolling_shutter_moves_rows_about_the_middle(profile, found):
    pairs = zip(boards_of(found), boards_of(with_rolling_shutter(profile, found, 0.02, 0.15)), strict=True)
    for (still, _), (moving, _) in pairs:
        shift_px = np.linalg.norm(moving.corners_px - still.corners_px, axis=1)
        row_share = abs(still.corners_px[:, 1] / 720 - 0.5)
        # 3 mm over the whole image.
        limit_px = 1.5 * 900 * 0.003 * row_share / still.distance_m + 1e-6
        assert (shift_px < 1.5 * limit_px).all()
        assert shift_px.max() > 0


def test_causes_table_counts_right_and_second_ones(capsys):
    expected = frozenset({"verdict.scale"})
    print_causes(
        [
            outcome(SOUND, "", verdict="pass"),
            outcome("squares", "verdict.scale", "verdict.moved", expected=expected),
            outcome("squares", "verdict.moved", expected=expected),
            outcome("plate", "", expected=expected, verdict="pass"),
            outcome("focal length", "verdict.moved", expected=expected, is_beyond=False),
        ]
    )
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("| ml | 3"))
    assert row == "| ml | 3 | 1 | 2 | 1 (50 %) | 1 (50 %) | 0 (0 %) | 0 | 1 | 1 (100 %) | 1 | 0 (0 %) |"


def test_measured_causes_count_mistakes_beyond_tolerance():
    expected = frozenset({"verdict.scale"})
    measure_causes(
        [
            outcome(SOUND, "", verdict="pass"),
            outcome("squares", "verdict.scale", expected=expected),
            outcome("squares", "verdict.moved", expected=expected),
            outcome("focal length", "verdict.moved", expected=expected, is_beyond=False),
        ]
    )
    (session,) = {key.split(".")[1] for key in MEASURED if key.startswith("corruptions.")}
    figures = {
        name: MEASURED[f"corruptions.{session}.ml.{name}"][0] for name in ("mistakes", "right", "passes")
    }
    assert figures == {"mistakes": [2], "right": [1, 50.0], "passes": [0]}


def test_outcome_faults_of_a_recording_are_not_false():
    known = outcome(SOUND, "verdict.range_offset", faults=frozenset({"verdict.range_offset"}))
    assert known.false_causes == ()
    assert outcome(SOUND, "verdict.range_offset").false_causes == ("verdict.range_offset",)


def test_some_of_keeps_the_captures_named(found):
    part = some_of(found, {"000001", "000004"})
    assert [sorted(held) for held in (*part.images.values(), *part.lidars.values())] == [
        ["000001", "000004"]
    ] * 2


def test_draws_count_verdicts_of_halves(rlfs, found, capsys):
    (images,) = found.images.values()
    draws = draw_halves(Samples("drawn", rlfs, images, {}), "paper", 1, found)
    assert (draws.n_captures, draws.n_drawn, draws.verdicts.total()) == (8, 6, 1)
    print_draws([[draws]])
    assert "paper: " in capsys.readouterr().out
