"""Recordings by others: differences from their references, between halves, and between channels."""

import tempfile
from collections.abc import Iterator, Mapping
from itertools import combinations
from pathlib import Path

import numpy as np

from benchmarks.measured import DEG_MM, measure
from benchmarks.recordings import SETS, RecordedSet, detect
from benchmarks.tables import compare, print_head, print_row
from lce_rig.calibrate import EstimateSettings
from lce_rig.core.calibration import Calibration, Method
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.core.results import ImageBoard
from lce_rig.detect.detection import Detections
from lce_rig.judge.reach import equivalent_extrinsics
from lce_rig.judge.repeatability import compare_calibrations
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.pipeline.camera_intrinsics import measure_intrinsics, save_profile
from lce_rig.rig import Rig, load_rig
from lce_rig.session import Session

# 95 % of the chi-squared distribution with six degrees of freedom.
_CHI2_95 = 12.59
# Two cameras of one rig, each calibrated with the LiDAR alone.
_CAMERAS = ("vlp32c_left", "vlp32c_right")
_SIZE = "{:.2f} deg, {:.1f} mm"
# Sessions of one rig: rlfs03 is of another day.
_ONE_RIG = ("rlfs01", "rlfs02", "rlfs03")


def bench_real(n_splits: int, only: str, method: Method) -> None:
    """Tabulate every recorded set that is there, each channel alone and all together."""
    head = "set, captures, image, LiDAR, used, EGT deg / mm, halves deg / mm, chi2 / 6, in 95 %, MGE mm"
    print_head(*head.split(", "), "reported deg / mm", "verdict")
    clocks: list[tuple[object, ...]] = []
    of_one_rig: dict[str, Calibration] = {}
    sessions: dict[str, tuple[Path, Detections]] = {}
    centres: dict[str, Array] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for recorded in (each for each in SETS if each.is_there and only in each.name):
            session = Path(scratch) / recorded.name
            recorded.collect(session)
            rig, detections = detect(session)
            for channels in _choices(recorded):
                print_row(*_row(recorded, rig, detections, channels, n_splits, method))
            if len(recorded.folders) > 1:
                clocks += _clock_rows(recorded, rig, detections)
            if recorded.name in (*_ONE_RIG, *_CAMERAS):
                (calibration, *_), _ = calibrate_detections(rig, detections, EstimateSettings(method))
                if recorded.name in _ONE_RIG:
                    of_one_rig[recorded.name] = calibration
                    sessions[recorded.name] = session, detections
                else:
                    centres[recorded.name] = invert(calibration.T_cam_lidar)[:3, 3]
        _print_sessions(of_one_rig, str(method), "each with its own lens")
        if len(sessions) == len(_ONE_RIG):
            _print_sessions(_with_one_lens(sessions, method), f"{method}.one_lens", "with the lens of all")
    if len(centres) == len(_CAMERAS):
        baseline_mm = 1000 * float(np.linalg.norm(np.subtract(*centres.values())))
        print(f"\n{' and '.join(_CAMERAS)}: {baseline_mm:.1f} mm apart")
        measure(f"real.stereo.{method}.baseline", "{:.1f} mm", baseline_mm)
    if clocks:
        print()
        print_head("set", "channel", "captures", "corner noise px", "time offset ms")
        for row in clocks:
            print_row(*row)


def _print_sessions(of_one_rig: Mapping[str, Calibration], key: str, lens: str) -> None:
    if len(of_one_rig) < 2:
        return
    print()
    print_head(f"sessions of one rig, {lens}", "apart deg / mm", "boards apart mm, rms")
    for (name, first), (other, second) in combinations(of_one_rig.items(), 2):
        apart, boards_mm = _apart(first, second)
        print_row(f"{name}, {other}", "{:.3f} / {:.1f}".format(*apart), f"{boards_mm:.1f}")
        measure(f"real.{name}-{other}.{key}.apart", DEG_MM, *apart)
        measure(f"real.{name}-{other}.{key}.boards", "{:.1f} mm", boards_mm)


def _with_one_lens(sessions: Mapping[str, tuple[Path, Detections]], method: Method) -> dict[str, Calibration]:
    """Calibrate sessions with the profile that `intrinsics` of all of them writes."""
    opened = [Session.open(path) for path, _ in sessions.values()]
    profile = opened[0].path / "one_lens.yaml"
    measured = [measure_intrinsics(opened, camera) for camera in opened[0].rig.cameras]
    save_profile(opened[0], measured, profile, is_forced=True)
    rig, found = load_rig(profile), {}
    for name, (_, detections) in sessions.items():
        (found[name], *_), _ = calibrate_detections(rig, detections, EstimateSettings(method))
    return found


def _choices(recorded: RecordedSet) -> list[tuple[str, ...]]:
    channels = tuple(channel for _, channel in recorded.folders)
    return [channels] if len(channels) == 1 else [*((channel,) for channel in channels), channels]


def _row(
    recorded: RecordedSet,
    rig: Rig,
    detections: Detections,
    channels: tuple[str, ...],
    n_splits: int,
    method: Method,
) -> tuple[object, ...]:
    pairs = [pair for pair in detections.pairs if pair.channel in channels]
    seen = [detections.of(pair, name) for pair in pairs for name in detections.captures(pair)]
    options = EstimateSettings(method)
    (calibration, *_), _ = calibrate_detections(rig, detections, options, channels=channels)
    reference = recorded.reference()
    halves = np.array(list(_halves(rig, detections, channels, n_splits, method)))
    apart_deg, apart_m = np.sqrt(np.mean(halves[:, :2] ** 2, axis=0))
    name = recorded.name if len(recorded.folders) == 1 else f"{recorded.name} {' + '.join(channels)}"
    n_within, n_used = np.count_nonzero(halves[:, 2] < _CHI2_95), len(calibration.captures_used)
    sigma = calibration.sigma_rotation_deg, 1000 * calibration.sigma_translation_m
    key = f"real.{name}.{method}"
    measure(f"{key}.used", "{} of {}", n_used, len(seen))
    measure(f"{key}.halves", _SIZE, apart_deg, 1000 * apart_m)
    measure(f"{key}.chi2", "{:.2f}, {} of {}", np.mean(halves[:, 2]) / 6, int(n_within), len(halves))
    measure(f"{key}.claim", _SIZE, *sigma)
    measure(f"{key}.verdict", "{}", calibration.verdict)
    if reference is not None:
        measure(f"{key}.reference", _SIZE, *compare(calibration.T_cam_lidar, reference))
    return (
        name,
        len(seen),
        sum(isinstance(image, ImageBoard) for image, _ in seen),
        sum(isinstance(lidar, list) for _, lidar in seen),
        n_used,
        "-" if reference is None else "{:.3f} / {:.1f}".format(*compare(calibration.T_cam_lidar, reference)),
        f"{apart_deg:.3f} / {1000 * apart_m:.1f}",
        f"{np.mean(halves[:, 2]) / 6:.2f}",
        f"{n_within} of {len(halves)}",
        f"{1000 * calibration.metrics.mge_m:.1f}",
        "{:.3f} / {:.1f}".format(*sigma),
        calibration.verdict,
    )


def _halves(
    rig: Rig, detections: Detections, channels: tuple[str, ...], n_splits: int, method: Method
) -> Iterator[tuple[float, float, float]]:
    """Calibrate halves of the scans apart: first and second, odd and even, then random ones.

    Yields:
        The difference of each two as they draw points, deg and m, and its chi-squared of six freedoms for the
        part of the covariances that they do not share.
    """
    rng = np.random.default_rng(0)
    detections = Detections(
        {key: own for key, own in detections.images.items() if key[1] in channels}, detections.lidars
    )
    ((_lidar, scans),) = detections.lidars.items()
    seen = {name for own in detections.images.values() for name in own}
    # Captures may hold copies of one scan: they go into the same half.
    prints = {
        n: found[0].points.tobytes() if isinstance(found, list) else n
        for n, found in scans.items()
        if n in seen
    }
    keys = sorted(set(prints.values()), key=lambda key: min(n for n, own in prints.items() if own == key))
    # Half of a small set has fewer captures than a result would be given for.
    fewest = max(3, min(rig.quality.min_captures, len(keys) // 2))
    rig = rig.model_copy(update={"quality": rig.quality.model_copy(update={"min_captures": fewest})})
    in_time = np.arange(len(keys))
    orders = [in_time, np.argsort(in_time % 2, kind="stable")]
    orders += [rng.permutation(len(keys)) for _ in range(n_splits - 2)]
    for order in orders[:n_splits]:
        halves = [{keys[i] for i in part} for part in np.array_split(order, 2)]
        try:
            results = [
                calibrate_detections(
                    rig,
                    _only(detections, {n for n, key in prints.items() if key in half}),
                    EstimateSettings(method),
                )[0][0]
                for half in halves
            ]
        except NotEnoughDataError:
            continue
        compared = compare_calibrations(dict(zip(("first", "second"), results, strict=True)))
        yield compared.max_rotation_deg, compared.max_translation_m, compared.chi2


def _apart(first: Calibration, second: Calibration) -> tuple[tuple[float, float], float]:
    """Compare two results by projected points: their difference, and the distance between boards, mm."""
    lens = first.intrinsics
    T = [c.T_cam_lidar if lens is None else equivalent_extrinsics(c, lens) for c in (first, second)]
    boards = [o.lidar.T_lidar_board[:3, 3] for c in (first, second) for o in c.observations.values()]
    moved = transform(T[0], np.array(boards)) - transform(T[1], np.array(boards))
    rms_m = np.sqrt(np.mean(np.sum(moved**2, axis=1)))
    return compare(T[0], T[1]), 1000 * float(rms_m)


def _only(detections: Detections, names: set[str]) -> Detections:
    return Detections(
        {key: {n: d for n, d in own.items() if n in names} for key, own in detections.images.items()},
        {key: {n: d for n, d in own.items() if n in names} for key, own in detections.lidars.items()},
    )


def _clock_rows(recorded: RecordedSet, rig: Rig, detections: Detections) -> Iterator[tuple[object, ...]]:
    (calibration, *_), _ = calibrate_detections(rig, detections)
    for result in calibration.channel_results:
        clock = "-"
        if result.time_offset_s is not None and result.time_offset_sigma_s is not None:
            # Their clouds carry the stamp of the last packet, a sweep after the first firing.
            since_last_s = result.time_offset_s - 0.1
            clock = f"{1000 * since_last_s:+.0f} +- {1000 * result.time_offset_sigma_s:.0f}"
        yield recorded.name, result.channel, result.n_captures, f"{result.noise_px:.2f}", clock
