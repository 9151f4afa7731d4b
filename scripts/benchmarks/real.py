"""Recordings by others: differences from their references, between halves, and between channels."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.recordings import SETS, RecordedSet, detect
from benchmarks.tables import compare, print_head, print_row
from lce_rig.calibrate import EstimateSettings
from lce_rig.core.calibration import Method
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.results import ImageBoard
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import Rig


def bench_real(n_splits: int, only: str, method: Method) -> None:
    """Tabulate every recorded set that is there, each channel alone and all together."""
    head = (
        "set, captures, image, LiDAR, used, EGT deg, EGT mm, split deg, split mm, MGE mm, reported deg / mm"
    )
    print_head(*head.split(", "), "verdict")
    clocks: list[tuple[object, ...]] = []
    for recorded in SETS:
        if recorded.is_there and only in recorded.name:
            with tempfile.TemporaryDirectory() as scratch:
                session = Path(scratch) / "session"
                recorded.collect(session)
                rig, detections = detect(session)
            for channels in _choices(recorded):
                print_row(*_row(recorded, rig, detections, channels, n_splits, method))
            if len(recorded.folders) > 1:
                clocks += _clock_rows(recorded, rig, detections)
    if clocks:
        print()
        head = "set, channel, captures, corner noise px, time offset ms, depth scatter mm"
        print_head(*head.split(", "), "without compensation mm", "channels differ by deg / mm")
        for row in clocks:
            print_row(*row)


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
    deg, mm = compare(calibration.T_cam_lidar, recorded.reference())
    split_deg, split_mm = _split_halves(rig, detections, channels, n_splits, method)
    return (
        recorded.name if len(recorded.folders) == 1 else f"{recorded.name} {' + '.join(channels)}",
        len(seen),
        sum(isinstance(image, ImageBoard) for image, _ in seen),
        sum(isinstance(lidar, list) for _, lidar in seen),
        len(calibration.captures_used),
        f"{deg:.3f}",
        f"{mm:.1f}",
        f"{split_deg:.3f}",
        f"{split_mm:.1f}",
        f"{1000 * calibration.metrics.mge_m:.1f}",
        f"{calibration.sigma_rotation_deg:.3f} / {1000 * calibration.sigma_translation_m:.1f}",
        calibration.verdict,
    )


def _split_halves(
    rig: Rig, detections: Detections, channels: tuple[str, ...], n_splits: int, method: Method
) -> tuple[float, float]:
    """Calibrate random halves of the scans apart and give the rms of their differences, deg and mm."""
    rng = np.random.default_rng(0)
    ((_lidar, scans),) = detections.lidars.items()
    # Captures may hold copies of one scan: they go into the same half.
    prints = {n: found[0].points.tobytes() if isinstance(found, list) else n for n, found in scans.items()}
    keys = sorted(set(prints.values()), key=lambda key: min(n for n, own in prints.items() if own == key))
    # Half of a small set has fewer captures than a result would be given for.
    fewest = max(3, min(rig.quality.min_captures, len(keys) // 2))
    rig = rig.model_copy(update={"quality": rig.quality.model_copy(update={"min_captures": fewest})})
    differences = []
    for _ in range(n_splits):
        order = rng.permutation(len(keys))
        halves = [{keys[i] for i in part} for part in np.array_split(order, 2)]
        try:
            T = [
                calibrate_detections(
                    rig,
                    _only(detections, {n for n, key in prints.items() if key in half}),
                    EstimateSettings(method),
                    channels=channels,
                )[0][0].T_cam_lidar
                for half in halves
            ]
        except NotEnoughDataError:
            continue
        differences.append(compare(T[0], T[1]))
    deg, mm = np.sqrt(np.mean(np.square(differences), axis=0))
    return float(deg), float(mm)


def _only(detections: Detections, names: set[str]) -> Detections:
    return Detections(
        {key: {n: d for n, d in own.items() if n in names} for key, own in detections.images.items()},
        {key: {n: d for n, d in own.items() if n in names} for key, own in detections.lidars.items()},
    )


def _clock_rows(recorded: RecordedSet, rig: Rig, detections: Detections) -> Iterator[tuple[object, ...]]:
    (calibration, *_), _ = calibrate_detections(rig, detections)
    figures = calibration.diagnostics
    apart = f"{figures.channels_rotation_deg:.2f} / {1000 * figures.channels_translation_m:.1f}"
    for result in calibration.channel_results:
        clock = "-"
        if result.time_offset_s is not None and result.time_offset_sigma_s is not None:
            # Their clouds carry the stamp of the last packet, a sweep after the first firing.
            since_last_s = result.time_offset_s - 0.1
            clock = f"{1000 * since_last_s:+.0f} +- {1000 * result.time_offset_sigma_s:.0f}"
        yield (
            recorded.name,
            result.channel,
            result.n_captures,
            f"{result.noise_px:.2f}",
            clock,
            f"{1000 * result.depth_scatter_m:.1f}",
            f"{1000 * result.depth_scatter_still_m:.1f}",
            apart,
        )
