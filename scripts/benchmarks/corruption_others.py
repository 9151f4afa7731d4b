"""Corruptions of simulated sessions with several cameras, and with events."""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import lce_rig as lce
from benchmarks.corruption_causes import CAMERAS_EXCHANGED, NOTHING, TIME_OFFSET
from benchmarks.corruption_kinds import SOUND
from benchmarks.corruption_outcomes import Outcome, judged, refused
from benchmarks.corruption_sessions import N_CAPTURES, SEED
from benchmarks.recordings import RIGS
from lce_rig.calibrate import CalibrateOptions
from lce_rig.core.calibration import Method
from lce_rig.core.errors import LceRigError
from lce_rig.detect.detection import Detections, ImageDetection
from lce_rig.detect.finder import BoardFinder
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import load_rig
from lce_rig.session import Session
from lce_rig.simulate import HandMotion, SimulationOptions, simulate_captures, truth_extrinsics

_CAMERAS, _EVENTS = "two_cameras", "rles_events"
_LATE_S = 0.3
# Slower boards give too few events.
_SPEED_MPS = (0.08, 0.3)


def exchanged_cameras(methods: Sequence[Method]) -> Iterator[Outcome]:
    """Calibrate two alike cameras as they are, and with their images exchanged."""
    rig = load_rig(RIGS / f"{_CAMERAS}.yaml")
    options, (lidar,), names = SimulationOptions.for_rig(rig.name), rig.lidars, sorted(rig.cameras)
    truths = truth_extrinsics(rig, SEED, options)
    finder, scans = BoardFinder(rig), {}
    images: dict[str, dict[str, ImageDetection]] = {name: {} for name in names}
    for number, capture in enumerate(
        simulate_captures(rig, n_captures=N_CAPTURES, seed=SEED, options=options)
    ):
        scans[f"{number:06d}"] = finder.scan(capture.scans[0])
        for image in capture.images:
            images[image.sensor][f"{number:06d}"] = finder.image(image)
    for corruption, sources in ((SOUND, names), ("images of the cameras exchanged", names[::-1])):
        of_names = {(n, "frames"): images[source] for n, source in zip(names, sources, strict=True)}
        for method in methods:
            found = Detections(of_names, {lidar: scans})
            for calibration in calibrate_detections(rig, found, CalibrateOptions(method=method))[0]:
                truth, camera = truths[calibration.camera, lidar], f"{_CAMERAS} {calibration.camera}"
                expected = NOTHING if corruption == SOUND else CAMERAS_EXCHANGED
                blank = Outcome(camera, corruption, method, "", "refused", "", expected=expected)
                yield judged(rig, blank, calibration, truth)


def late_events(methods: Sequence[Method]) -> Iterator[Outcome]:
    """Calibrate an event camera before a moving board, with events in time and late."""
    rig = load_rig("rles")
    usual = replace(SimulationOptions.for_rig(rig.name, "moving"), hand=HandMotion(speed_mps=_SPEED_MPS))
    for label, late_s in ((SOUND, 0.0), (f"events {1000 * _LATE_S:.0f} ms late", _LATE_S)):
        options = replace(usual, event_offset_s=late_s)
        truth = truth_extrinsics(rig, SEED, options)[next(iter(rig.cameras)), next(iter(rig.lidars))]
        with (
            tempfile.TemporaryDirectory() as scratch,
            Session.create(Path(scratch) / "session", rig) as session,
        ):
            for capture in simulate_captures(rig, n_captures=N_CAPTURES, seed=SEED, options=options):
                session.add_capture(capture.images, capture.scans, {}, events=capture.events)
            found = lce.detect_boards(session, n_threads=1)
        for channels in (("events",), ("events", "frames")):
            name, expected = f"rles {' + '.join(channels)}", TIME_OFFSET if late_s else NOTHING
            for method in methods:
                blank = Outcome(name, label, method, "", "refused", "", expected=expected)
                settings = CalibrateOptions(method=method)
                try:
                    (calibration, *_), _ = calibrate_detections(rig, found, settings, channels=channels)
                except LceRigError as error:
                    yield refused(blank, error)
                else:
                    yield judged(rig, blank, calibration, truth)


OTHERS: dict[str, Callable[[Sequence[Method]], Iterator[Outcome]]] = {
    _CAMERAS: exchanged_cameras,
    _EVENTS: late_events,
}
"""Sessions by name."""
