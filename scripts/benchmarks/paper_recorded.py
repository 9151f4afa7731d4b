"""Recorded sets of the paper: collected once, calibrated whole or in part, held against their references."""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.baselines import settings_of
from benchmarks.paper_runs import paper_mge_m
from benchmarks.recordings import SETS, RecordedSet, detect
from benchmarks.tables import compare
from lce_rig import pipeline
from lce_rig.calibrate import CalibrateOptions, CaptureCandidates, EstimateSettings, fit_extrinsic
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import Array
from lce_rig.core.results import Calibration, ImageBoard
from lce_rig.pipeline import Detections
from lce_rig.rig import Rig

N_SUBSETS = 20


class Recording:
    """A recorded set with its detections, collected once into a folder."""

    def __init__(self, recorded: RecordedSet, folder: Path) -> None:
        session = folder / "sessions" / recorded.name
        if not session.exists():
            session.parent.mkdir(parents=True, exist_ok=True)
            recorded.collect(session)
        self.name = recorded.name
        self.channels = tuple(channel for _, channel in recorded.folders)
        self.reference: Array = recorded.reference()
        self.rig: Rig
        self.detections: Detections
        self.rig, self.detections = detect(session)

    def count_found(self, channel: str) -> str:
        """Say in how many captures of a channel both sensors found a board."""
        (pair,) = (pair for pair in self.detections.pairs if pair.channel == channel)
        names = self.detections.captures(pair)
        seen = [self.detections.of(pair, name) for name in names]
        n_found = sum(isinstance(image, ImageBoard) and isinstance(scan, list) for image, scan in seen)
        return f"{n_found} of {len(names)}"

    @property
    def options(self) -> EstimateSettings:
        """What the profile says of the LiDAR's errors."""
        (lidar,) = self.rig.lidars.values()
        return EstimateSettings.of(CalibrateOptions(), lidar)

    def candidates(self) -> list[CaptureCandidates]:
        """Gather the captures of the only channel in which both sensors found a board."""
        (pair,) = self.detections.pairs
        both = [(name, *self.detections.of(pair, name)) for name in self.detections.captures(pair)]
        return [
            CaptureCandidates(name, image, scan)
            for name, image, scan in both
            if isinstance(image, ImageBoard) and isinstance(scan, list)
        ]

    def estimate(self, channels: Sequence[str], options: CalibrateOptions) -> Calibration:
        """Calibrate as `lce-rig calibrate` does.

        Raises:
            NotEnoughDataError: the captures are too few or leave a direction undetermined.
        """
        pairs, _ = pipeline.calibrate_detections(self.rig, self.detections, options, channels=channels)
        return pairs[0]

    def errors(self, estimate: Calibration) -> tuple[float, float, float, float]:
        """Give EGT in deg and mm, and MGE in mm, ours and as the paper counts it."""
        deg, mm = compare(estimate.T_cam_lidar, self.reference)
        board = self.rig.board.to_board()
        paper_mm = 1000 * paper_mge_m(estimate.T_cam_lidar, estimate.observations.values(), board)
        return deg, mm, 1000 * estimate.metrics.mge_m, paper_mm


def open_recordings(folder: Path, only: str) -> list[Recording]:
    """Open the recorded sets of the paper that are there."""
    wanted = [recorded for recorded in SETS if recorded.name.startswith(("rlfs", "rles"))]
    return [Recording(recorded, folder) for recorded in wanted if recorded.is_there and only in recorded.name]


def errors_by_frames(recording: Recording, counts: Sequence[int], methods: Sequence[str]) -> dict[str, Array]:
    """Calibrate random subsets of a recording of still boards.

    Returns:
        Method -> (len(counts), 2) median EGT in deg and mm over the subsets that a method did not refuse;
        NaN where it refused half or more.
    """
    rng = np.random.default_rng(0)
    every, board = recording.candidates(), recording.rig.board.to_board()
    errors = {method: np.full((len(counts), N_SUBSETS, 2), np.inf) for method in methods}
    for k, n in enumerate(counts):
        for j in range(N_SUBSETS if n < len(every) else 1):
            subset = [every[i] for i in np.sort(rng.choice(len(every), n, replace=False))]
            for method in methods:
                options = settings_of(method, replace(recording.options, n_draws=0))
                try:
                    T = fit_extrinsic(subset, board, options).T_cam_lidar
                except NotEnoughDataError:
                    continue
                errors[method][k, j] = compare(T, recording.reference)
        print(f"{recording.name}: subsets of {n} done", file=sys.stderr, flush=True)
    return {method: _medians(each, counts, len(every)) for method, each in errors.items()}


def _medians(errors: Array, counts: Sequence[int], n_all: int) -> Array:
    rows = [each if n < n_all else each[:1] for n, each in zip(counts, errors, strict=True)]
    medians = np.array([np.median(row, axis=0) for row in rows])
    return np.where(np.isfinite(medians), medians, np.nan)
