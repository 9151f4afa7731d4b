"""Intrinsics from boards: the truth within the standard deviations, for any start and with bad images."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.results import ImageBoard
from lce_rig.detect.image.search import find_image_board
from lce_rig.judge.intrinsics_check import check_intrinsics, judge_lens, lens_findings
from lce_rig.lens.calibrate_lens import estimate_intrinsics
from lce_rig.lens.difference import certainty_of, compare_lenses
from lce_rig.lens.lens_estimate import BoardView, find_weaknesses, reach
from lce_rig.lens.models import MODELS, convert, model_of
from lce_rig.rig import load_rig
from tests.lens.lens_views import BOARD, FISHEYE, WIDE, Scene, photograph, with_corners

RATIONAL = replace(WIDE, distortion=(0.3, -0.05, 0.001, 0.0002, 0.01, 0.6, -0.02, 0.03))
LENSES = (replace(WIDE, distortion=WIDE.distortion[:4]), WIDE, RATIONAL, FISHEYE)
RADTAN5 = MODELS["radtan5"]
NEAR = Scene(distance_m=(0.7, 2.0), spread=(0.05, 0.95))


def deviations(estimate, truth):
    """How many standard deviations each parameter is off."""
    return (estimate.model.vector(estimate.intrinsics) - estimate.model.vector(truth)) / estimate.sigma


@pytest.fixture(scope="module")
def views():
    return photograph(16, 1, replace(NEAR, bow_m=(0.0012, -0.0006), aspect=0.001, print_sigma_m=7e-5))


@pytest.fixture(scope="module")
def estimate(views):
    return estimate_intrinsics(views, BOARD, WIDE, RADTAN5)


@pytest.mark.parametrize("lens", LENSES, ids=[model_of(lens).name for lens in LENSES])
def test_model_derivatives_match_differences(lens):
    """The model projects as the camera does."""
    model, rng = model_of(lens), np.random.default_rng(0)
    vector = model.vector(lens)
    assert model.intrinsics(vector, lens.width_px, lens.height_px) == lens
    points = rng.uniform([-0.6, -0.4, 0.9], [0.6, 0.4, 3], (50, 3))
    pixels, by_point, by_parameter = model.project(vector, points)
    assert np.allclose(pixels, lens.project(points)[0], atol=1e-10)
    h = 1e-6
    for columns, project, size in (
        (by_point, lambda step: model.project(vector, points + step)[0], 3),
        (by_parameter, lambda step: model.project(vector + step, points)[0], model.size),
    ):
        numeric = [(project(h * e) - project(-h * e)) / (2 * h) for e in np.eye(size)]
        assert np.allclose(columns, np.stack(numeric, axis=-1), atol=1e-5)


def test_convert_larger_lens_model_is_equal():
    """Another family: within 0.6 px."""
    points = np.random.default_rng(0).uniform([-0.3, -0.3, 1], [0.3, 0.3, 2], (50, 3))
    pixels, _ = WIDE.project(points)
    for name, limit_px in (("radtan5", 1e-9), ("rational", 1e-9), ("equidistant", 0.6)):
        moved, _, _ = MODELS[name].project(convert(WIDE, MODELS[name]), points)
        assert np.abs(moved - pixels).max() < limit_px
    with pytest.raises(ValueError):
        RADTAN5.vector(FISHEYE)


def test_lens_and_board_are_estimated_within_their_deviations(estimate):
    assert np.abs(deviations(estimate, WIDE)).max() < 4
    shape, sigma = estimate.pattern_shape
    assert np.all(np.abs(shape - [0.0012, -0.0006, 0.001]) < 4 * sigma)
    assert estimate.sigma[0] < 0.005 * WIDE.fx_px
    assert estimate.refused == {}
    assert 0.06 < estimate.rms_px < estimate.held_out_rms_px < 0.1


@pytest.mark.parametrize("hidden", [0.0, 0.3], ids=["whole", "hidden"])
def test_lens_standard_deviations_match_errors(hidden):
    scene = Scene(bow_m=(0.001, 0.0), aspect=-0.001, print_sigma_m=1e-4)
    rng, found = np.random.default_rng(0), []
    for seed in range(10):
        views = photograph(11, seed, scene)
        views = [
            with_corners(view, np.where(rng.random((24, 1)) < hidden, np.nan, view.board.corners_px))
            for view in views
        ]
        found.append(estimate_intrinsics(views, BOARD, WIDE, RADTAN5, n_folds=2))
        n_seen = sum(int(np.isfinite(view.board.corners_px[:, 0]).sum()) for view in found[-1].views)
        assert found[-1].corners_px.shape == found[-1].residuals_px.shape == (n_seen, 2)
    nees = []
    for one in found:
        error = RADTAN5.vector(one.intrinsics) - RADTAN5.vector(WIDE)
        nees.append(error @ np.linalg.solve(one.cov, error) / len(error))
    # 10 means of chi2 / 9 scatter by sqrt(2 / (9 * 10)) = 0.15 about 1.
    assert 0.6 < np.mean(nees) < 1.5
    shapes = np.array(
        [(shape - [0.001, 0, -0.001]) / sigma for shape, sigma in (one.pattern_shape for one in found)]
    )
    assert 0.6 < np.mean(shapes**2) < 1.5


def test_bending_board_inflates_deviations():
    nees = {}
    for flutter_m in (0.0, 0.003):
        scene = Scene(sigma_px=0.02, flutter_m=flutter_m)
        found = [
            estimate_intrinsics(photograph(12, seed, scene), BOARD, WIDE, RADTAN5, n_folds=2)
            for seed in range(3)
        ]
        inflation = np.mean([one.inflation for one in found])
        assert inflation < 1.2 if flutter_m == 0 else inflation > 1.4
        nees[flutter_m] = np.mean([deviations(one, WIDE) ** 2 for one in found])
    assert nees[0.003] < 3


@pytest.mark.parametrize(
    "start",
    [
        replace(WIDE, fx_px=290.0, fy_px=290.0, distortion=()),
        replace(WIDE, fx_px=900.0, fy_px=900.0),
        replace(WIDE, cx_px=240.0, cy_px=320.0, distortion=(0.3, 0.1, 0.0, 0.0)),
        Intrinsics(450.0, 450.0, 319.5, 239.5, 640, 480, "equidistant", (0.0,) * 4),
    ],
    ids=["a third too short, no distortion", "twice too long", "off centre", "another model"],
)
def test_a_rough_guess_leads_to_the_same_lens(views, estimate, start):
    other = estimate_intrinsics(views, BOARD, start, RADTAN5, n_folds=2)
    assert np.abs(deviations(other, estimate.intrinsics)).max() < 0.1
    assert other.refused == {}


def test_bad_images_are_named_and_excluded(views):
    rng = np.random.default_rng(2)
    spoilt = list(views)
    shaken = views[2].board.corners_px + 2 * rng.standard_normal((24, 2))
    slipped = views[9].board.corners_px.copy()
    slipped[:6] += [15, 4]
    spoilt[2], spoilt[9] = with_corners(views[2], shaken), with_corners(views[9], slipped)
    found = estimate_intrinsics(spoilt, BOARD, WIDE, RADTAN5, n_folds=2)
    assert sorted(found.refused) == ["000002.frames", "000009.frames"]
    refusal = found.refused["000009.frames"]
    assert refusal.code == "calibrate.other_lens"
    assert refusal.figure("median_px") < 0.1 < 1.0 < refusal.figure("rms_px")
    assert np.abs(deviations(found, WIDE)).max() < 4


def test_a_noisier_channel_counts_less_and_is_not_refused(views):
    rng = np.random.default_rng(0)
    noisy = [
        replace(
            with_corners(view, view.board.corners_px + 0.6 * rng.standard_normal((24, 2))), channel="events"
        )
        for view in views
    ]
    both = estimate_intrinsics([*views, *noisy], BOARD, WIDE, RADTAN5, n_folds=2)
    frames = estimate_intrinsics(views, BOARD, WIDE, RADTAN5, n_folds=2)
    assert both.refused == {}
    assert np.all(both.sigma < 1.15 * frames.sigma)
    assert np.abs(deviations(both, WIDE)).max() < 4


def test_views_of_one_capture_are_held_out_together(views):
    twins = [replace(view, channel=channel) for view in views for channel in ("a", "b")]
    doubled = estimate_intrinsics(twins, BOARD, WIDE, RADTAN5, n_folds=4)
    single = estimate_intrinsics(views, BOARD, WIDE, RADTAN5, n_folds=4)
    assert doubled.held_out_rms_px == pytest.approx(single.held_out_rms_px, rel=0.05)
    # Duplicate corners add no information.
    assert np.all(doubled.sigma > 0.8 * single.sigma)


def test_too_few_captures_error_states_number(views):
    with pytest.raises(NotEnoughDataError):
        estimate_intrinsics(views[:3], BOARD, WIDE, RADTAN5)


def test_parallel_boards_leave_the_focal_length_open():
    # All boards central and parallel to the image: depth and focal length are not separable.
    scene = Scene(tilt_deg=(0.0, 0.5), spread=(0.49, 0.51), sigma_px=0.3)
    with pytest.raises(NotEnoughDataError):
        estimate_intrinsics(photograph(8, 0, scene), BOARD, WIDE, RADTAN5)


def test_held_out_captures_select_lens_model():
    seen = photograph(9, 4, replace(NEAR, lens=FISHEYE, sigma_px=0.02))
    start = Intrinsics(400.0, 400.0, 319.5, 239.5, 640, 480, "radtan", ())
    fits = [
        estimate_intrinsics(seen, BOARD, start, MODELS[name], n_folds=3)
        for name in ("equidistant", "radtan4")
    ]
    right, wrong = (fit.held_out_rms_px for fit in fits)
    assert right < 0.1 < wrong


def test_compare_lenses_centre_is_a_turn(estimate):
    """A lens does not differ from itself."""
    corners, cov = estimate.corners_px, estimate.cov
    same = compare_lenses(WIDE, WIDE, corners, cov, RADTAN5)
    assert same.rms_px < 1e-6
    assert np.linalg.norm(same.turn_rad) < 1e-9
    moved = compare_lenses(WIDE, replace(WIDE, cx_px=WIDE.cx_px + 5), corners, cov, RADTAN5)
    assert np.linalg.norm(moved.turn_rad) == pytest.approx(5 / 450, rel=0.15)
    assert moved.rms_px < 1.2
    longer = compare_lenses(WIDE, replace(WIDE, fx_px=459.0, fy_px=461.0), corners, cov, RADTAN5)
    assert np.linalg.norm(longer.turn_rad) < 0.004
    assert longer.rms_px > 1.5


def test_certainty_ends_where_boards_end():
    """The weak corners are named."""
    middle = estimate_intrinsics(
        photograph(12, 5, Scene(spread=(0.42, 0.58), distance_m=(2.0, 3.0))), BOARD, WIDE, RADTAN5
    )
    certainty = certainty_of(middle.intrinsics, middle.corners_px, middle.cov, middle.model)
    inside = certainty.sigma_px[certainty.is_covered].max()
    assert inside < 1 < np.nanmax(certainty.sigma_px)
    texts = find_weaknesses(middle, certainty)
    assert any("four corners" in text for text in texts)
    assert reach(middle) < 0.6


def test_frontal_boards_advise_tilt():
    scene = Scene(tilt_deg=(0.0, 4.0), spread=(0.35, 0.65), distance_m=(1.5, 2.5))
    facing = estimate_intrinsics(photograph(14, 6, scene), BOARD, WIDE, MODELS["radtan4"], n_folds=2)
    certainty = certainty_of(facing.intrinsics, facing.corners_px, facing.cov, facing.model)
    texts = find_weaknesses(facing, certainty)
    assert any("focal length" in text and "tilt the" in text for text in texts)


def test_a_bent_board_and_a_stretched_print_are_named():
    scene = Scene(bow_m=(0.004, 0.0), aspect=0.006, sigma_px=0.03)
    bad = estimate_intrinsics(photograph(12, 7, scene), BOARD, WIDE, RADTAN5, n_folds=2)
    certainty = certainty_of(bad.intrinsics, bad.corners_px, bad.cov, bad.model)
    texts = " ".join(find_weaknesses(bad, certainty))
    assert ("4.0 mm" in texts or "3.9 mm" in texts) and "towards" in texts
    assert "too long" in texts and "plate's width" in texts
    assert np.abs(deviations(bad, WIDE)).max() < 4


STALE = {
    "two per cent longer": replace(WIDE, fx_px=1.02 * WIDE.fx_px, fy_px=1.02 * WIDE.fy_px),
    "centre ten pixels off": replace(WIDE, cx_px=WIDE.cx_px + 8, cy_px=WIDE.cy_px - 6),
    "no distortion": replace(WIDE, distortion=()),
    "half the distortion": replace(WIDE, distortion=tuple(0.5 * k for k in WIDE.distortion)),
}


@pytest.mark.parametrize("kind", STALE)
def test_stale_intrinsics_fail_with_their_figures(views, kind):
    check = check_intrinsics(views, STALE[kind], BOARD)
    assert not check.fits()
    assert check.rms_px > check.possible_px
    (found,) = lens_findings(check)
    assert (found.code, found.severity) == ("verdict.intrinsics", "warning")
    assert found.figures["displacement_px"] == check.displacement_px
    if kind == "centre ten pixels off":
        assert check.turn_deg == pytest.approx(np.degrees(10 / 450), rel=0.25)
        assert found.figures["is_turned"] and found.figures["turn_deg"] == check.turn_deg


def test_lens_that_projects_nothing_fails(views):
    folded = replace(WIDE, distortion=(-60.0, 0.0, 0.0, 0.0))
    check = check_intrinsics(views, folded, BOARD)
    assert not check.fits()
    assert not np.isfinite(lens_findings(check)[0].figure("displacement_px"))


def test_judge_lens_central_boards_keep_it(views):
    stale = STALE["two per cent longer"]
    thorough = check_intrinsics(views, stale, BOARD)
    judgement = judge_lens(thorough.covered, thorough.image_sigma_px, thorough)
    assert judgement.code == "intrinsics.better"
    assert judgement.figures["image_sigma_px"] < judgement.figures["limit_px"]
    scene = Scene(spread=(0.4, 0.6), distance_m=(1.5, 2.5))
    middle = check_intrinsics(photograph(14, 5, scene), stale, BOARD)
    judgement = judge_lens(middle.covered, middle.image_sigma_px, middle)
    assert not middle.fits()
    assert judgement.code == "intrinsics.undetermined"
    assert judgement.figures["covered"] < 0.3
    assert judgement.figures["image_sigma_px"] > judgement.figures["limit_px"] >= 1.0
    assert lens_findings(middle)[0].action == "collect"


def test_lens_slight_difference_is_a_warning(views):
    slight = replace(WIDE, fx_px=1.007 * WIDE.fx_px, fy_px=1.007 * WIDE.fy_px)
    check = check_intrinsics(views, slight, BOARD)
    assert not check.fits()
    assert lens_findings(check)[0].severity == "warning"
    assert check.fits(target_deg=1.0)


def test_displacement_in_noise_is_omitted(views):
    check = check_intrinsics(views, replace(WIDE, fx_px=1.007 * WIDE.fx_px, fy_px=1.007 * WIDE.fy_px), BOARD)
    assert lens_findings(check)[0].figures["is_displaced"]
    within = replace(check, displacement_px=0.3, displacement_sigma_px=0.5, turn_deg=0.0)
    within = replace(within, rms_px=0.1, possible_px=0.1, surprise=40.0, is_contradicted=True)
    (found,) = lens_findings(within)
    assert not found.figures["is_displaced"]
    assert found.severity == "warning" and "+-" not in found.text


@pytest.mark.dataset
@pytest.mark.parametrize(
    ("recording", "profile"), [("rlfs01", "rlfs"), ("sss_noise15mm", "sss"), ("rles01_lf", "rles")]
)
def test_published_lenses_pass_stale_fail(recordings, recording, profile):
    rig = load_rig(profile)
    (camera,) = rig.cameras.values()
    lens, board = camera.to_intrinsics(), rig.board.to_board()
    seen = []
    for path in sorted((recordings / recording / "img").iterdir()):
        image = Image("cam", "frames", None, cv2.imread(str(path)))
        found = find_image_board(image, board, lens)
        if isinstance(found, ImageBoard):
            seen.append(BoardView(path.stem, "frames", found))
    check = check_intrinsics(seen, lens, board)
    assert check.fits()
    assert check.possible_px < 0.06
    longer = check_intrinsics(seen, replace(lens, fx_px=1.02 * lens.fx_px, fy_px=1.02 * lens.fy_px), board)
    assert not longer.fits()
