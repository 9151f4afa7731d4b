"""Corruptions are what they say, touch nothing else, and wrong results are counted as such."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.corruption_kinds import corruptions
from benchmarks.corruption_sessions import LATE_S, ONE_PLACE, PARALLEL, Samples, late
from benchmarks.corruptions import METHODS, Outcome, judge_session, print_summary

from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import transform
from lce_rig.rig import load_rig
from lce_rig.simulate import simulate_captures, truth_extrinsics

N = 10
N_RINGS = 16
KINDS = {kind.name: kind for kind in corruptions()}
# The profile's principal point lies outside its halved images.
REFUSED = "images and resolution halved, other intrinsics unchanged"
NAMES = [name for name in KINDS if name not in ("none", REFUSED)]


def session() -> Samples:
    """Ten captures of small random images and rings; nothing in them is a board."""
    rng = np.random.default_rng(0)
    ring = np.repeat(np.arange(N_RINGS, dtype=np.int16), 20)
    elevation = np.radians(2.0 * ring - 15)
    azimuth = np.tile(np.linspace(-3, 3, 20), N_RINGS)
    level = np.cos(elevation)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    images, scans = {}, {}
    for k in range(N):
        name = f"{k:06d}"
        pixels = rng.integers(0, 256, (12, 20), dtype=np.uint8)
        images[name] = Image("cam", "frames", 1000 * k, pixels)
        points = (rng.uniform(1, 5, (len(ring), 1)) * rays).astype(np.float32)
        scans[name] = Scan("lidar", 1000 * k, points, np.zeros(len(ring), np.float32), ring)
    plain = Samples("rlfs", load_rig("rlfs"), images, scans, np.eye(4))
    others = {name: replace(plain, name=name) for name in (PARALLEL, ONE_PLACE, *map(late, LATE_S))}
    return replace(plain, variants=others)


SESSION = session()


def corrupted(name: str) -> Samples:
    found = KINDS[name].corrupt(SESSION)
    assert found is not None
    return found


def foreign(samples: Samples) -> list[str]:
    """Captures whose image is another's."""
    return [
        n for n, image in samples.images.items() if not np.array_equal(image.pixels, SESSION.images[n].pixels)
    ]


def test_every_corruption_has_a_name_of_its_own_and_none_comes_first() -> None:
    assert len(corruptions()) == len(KINDS)
    assert next(iter(KINDS)) == "none"
    assert KINDS["none"].corrupt(SESSION) is SESSION


@pytest.mark.parametrize("name", NAMES)
def test_a_corrupted_session_is_another_one_whose_captures_hold_both_samples(name: str) -> None:
    found = corrupted(name)
    assert found.images.keys() == found.scans.keys()
    is_same = found.rig == SESSION.rig and found.name == SESSION.name
    is_same &= all(found.images.get(n) is image for n, image in SESSION.images.items())
    is_same &= all(found.scans.get(n) is scan for n, scan in SESSION.scans.items())
    assert not is_same or found.images.keys() != SESSION.images.keys()


@pytest.mark.parametrize("name", NAMES)
def test_a_corruption_is_the_same_each_time(name: str) -> None:
    first, second = corrupted(name), corrupted(name)
    assert first.rig == second.rig
    for n in first.images:
        assert np.array_equal(first.images[n].pixels, second.images[n].pixels)
        assert np.array_equal(first.scans[n].points, second.scans[n].points)


@pytest.mark.parametrize(
    ("name", "n"),
    [
        ("images of 2 captures swapped", 2),
        ("images of 5 captures mixed up", 5),
        ("images of half the captures mixed up", N // 2),
        ("images in reversed order", N),
        ("images one capture late", N),
    ],
)
def test_as_many_captures_hold_the_image_of_another_as_it_says(name: str, n: int) -> None:
    found = corrupted(name)
    assert len(foreign(found)) == n
    given = {image.pixels.tobytes() for image in found.images.values()}
    assert given == {image.pixels.tobytes() for image in SESSION.images.values()}
    assert [image.stamp_ns for image in found.images.values()] == [1000 * k for k in range(N)]


@pytest.mark.parametrize("error_deg", [0.2, 0.5, 1.0])
def test_wrong_elevations_move_the_outermost_rings_by_as_much_and_keep_ranges(error_deg: float) -> None:
    before, after = (
        s.scans["000003"].points.astype(float)
        for s in (SESSION, corrupted(f"elevations wrong by -{error_deg:g} to +{error_deg:g} deg"))
    )
    assert np.allclose(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1), rtol=1e-6)
    rise_deg = np.degrees([np.arcsin(p[:, 2] / np.linalg.norm(p, axis=1)) for p in (before, after)])
    change = (rise_deg[1] - rise_deg[0]).reshape(N_RINGS, -1)
    assert np.allclose(change[[0, -1]], [[-error_deg], [error_deg]], atol=1e-3)


def test_elevations_in_reversed_order_still_count_rings_from_the_lowest() -> None:
    scan = corrupted("elevations in reversed order").scans["000000"]
    rise = scan.points[:, 2] / np.linalg.norm(scan.points, axis=1)
    means = [rise[scan.ring == ring].mean() for ring in range(N_RINGS)]
    assert np.all(np.diff(means) > 0)


def test_a_nudged_lidar_sees_the_same_world_from_where_it_went() -> None:
    found = corrupted("LiDAR nudged by 1 deg half-way")
    for k, name in enumerate(SESSION.captures):
        seen, before = found.scans[name].points.astype(float), SESSION.scans[name].points
        T = found.T_lidar_moved if k >= N // 2 else np.eye(4)
        assert np.allclose(transform(T, seen), before, atol=1e-5)
    angle = np.degrees(np.arccos((np.trace(found.T_lidar_moved[:3, :3]) - 1) / 2))
    assert angle == pytest.approx(1.0)


def test_of_a_mixed_session_the_place_of_most_captures_counts() -> None:
    found = corrupted("a quarter of the captures from a rig nudged by 5 cm")
    shifts = [np.linalg.norm(found.scans[n].points - SESSION.scans[n].points, axis=1) for n in found.captures]
    assert np.allclose(found.T_lidar_moved, np.eye(4))
    assert sum(shift.mean() > 0.04 for shift in shifts) == 3
    assert np.allclose(shifts[1], 0.05, atol=1e-5)


def test_one_capture_copied_shows_one_image_and_one_scan() -> None:
    found = corrupted("one capture 10 times")
    assert len(found.images) == 10
    assert len(set(found.images.values())) == len(set(found.scans.values())) == 1


def test_the_profile_alone_says_another_lens_or_print() -> None:
    lens, board = SESSION.rig.cameras["cam"].intrinsics, SESSION.rig.board
    longer = corrupted("focal length of the profile +2 %").rig.cameras["cam"].intrinsics
    assert longer.fx_px == pytest.approx(1.02 * lens.fx_px)
    larger = corrupted("plate of the profile 20 mm larger").rig.board
    assert larger.width_m - board.width_m == pytest.approx(0.02)
    assert larger.square_m == board.square_m
    smaller = corrupted("squares of the profile -5 %")
    assert smaller.rig.board.square_m == pytest.approx(0.95 * board.square_m)
    assert foreign(smaller) == []


def test_half_the_rings_are_lost() -> None:
    scan = corrupted("every other ring lost").scans["000000"]
    assert sorted(set(scan.ring.tolist())) == list(range(0, N_RINGS, 2))


def test_a_session_that_lacks_what_a_corruption_needs_is_skipped() -> None:
    images = {name: replace(image, stamp_ns=None) for name, image in SESSION.images.items()}
    recorded = replace(SESSION, images=images, variants={})
    skipped = [name for name in NAMES if KINDS[name].corrupt(recorded) is None]
    moving = [f"board moving, timestamps of images {late(offset_s)}" for offset_s in LATE_S]
    still = ["boards nearly parallel", "board always in one place"]
    mixed = "timestamps of images mixed up"
    assert skipped == [mixed, *moving, *still]


def outcome(verdict: str, in_sigmas: float, in_targets: float, unobservable: str = "") -> Outcome:
    figures = (0.1, 1.0), (0.1, 1.0)
    return Outcome("rlfs", "x", "paper", unobservable, verdict, "", *figures, in_sigmas, in_targets)


def test_wrong_results_that_pass_are_named_and_counted_by_whether_the_data_show_them(
    capsys: pytest.CaptureFixture[str],
) -> None:
    print_summary(
        [
            outcome("pass", 1.0, 9.0),
            outcome("pass", 3.5, 0.5),
            outcome("pass", 20.0, 30.0, "another mounting"),
            outcome("fail", 7.0, 8.0),
        ]
    )
    lines = capsys.readouterr().out.splitlines()
    assert "| paper | pass | 3 | 1 | 0 | 3.5 | 1 |" in lines
    assert "| paper | fail | 1 | 1 | 1 | 7.0 | 0 |" in lines
    (overconfident,) = (line.split("|") for line in lines if "overconfident" in line)
    assert [cell.strip() for cell in overconfident[1:-2]] == [
        "rlfs",
        "x",
        "paper",
        "0.10 / 1.0",
        "3.5",
        "0.5",
    ]
    assert sum("another mounting" in line for line in lines) == 1


@pytest.mark.long
def test_a_sound_session_passes_and_a_corrupted_one_is_told_with_its_error() -> None:
    rig = load_rig("rles")
    # The simulated rig is built as its profile says: the nominal extrinsic is as good as a drawing.
    drawn = tuple(nominal.model_copy(update={"source": "cad"}) for nominal in rig.nominal_extrinsics)
    rig = rig.model_copy(update={"nominal_extrinsics": drawn})
    captures = list(simulate_captures(rig, n_captures=8, seed=3))
    samples = Samples(
        "rles",
        rig,
        {f"{c.index:06d}": c.images[0] for c in captures},
        {f"{c.index:06d}": c.scans[0] for c in captures},
        truth_extrinsics(rig, 3)["davis", "lidar"],
    )
    kinds = [
        KINDS[name]
        for name in (
            "none",
            "scans rotated by 30 deg about z",
            "images one capture late",
            "one more row of corners in the profile",
        )
    ]
    sound, turned, late_images, other = judge_session(samples, kinds)
    assert [o.method for o in sound] == list(METHODS)
    for o in sound:
        assert o.verdict != "fail"
        assert o.error is not None
        assert o.error[0] < 0.5
        assert not o.is_far_off
    for o in turned:
        assert o.verdict == "fail"
        assert o.error is not None
        assert o.error[0] == pytest.approx(30, abs=1)
        assert o.is_far_off
        assert "nominal" in o.reason
    assert {o.verdict for o in late_images} <= {"fail", "refused"}
    assert {o.verdict for o in other} == {"refused"}
    assert all("corners" in o.reason or "was found" in o.reason for o in other)


def test_a_corruption_of_the_profile_that_cannot_be_loaded_is_refused_with_its_reason() -> None:
    small = replace(SESSION, images={}, scans={})
    (outcomes,) = judge_session(small, [KINDS[REFUSED]])
    assert {o.verdict for o in outcomes} == {"refused"}
    assert all("outside" in o.reason for o in outcomes)
