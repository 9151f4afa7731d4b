"""Round trip of detections through arrays."""

import numpy as np
import pytest

from lce_rig.core.findings import Refusal
from lce_rig.detect.detection import Detections, Pair, from_arrays, to_arrays
from tests.calibrate.boards import simulate


def assert_same(a, b):
    assert vars(a).keys() == vars(b).keys()
    for name, value in vars(a).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, getattr(b, name))
            assert value.dtype == getattr(b, name).dtype
        else:
            assert value == getattr(b, name)


def test_detections_round_trip():
    item = simulate(1, seed=0)[0]
    assert_same(item.image, from_arrays(to_arrays(item.image)))
    boards = from_arrays(to_arrays([item.lidar]))
    assert len(boards) == 1
    assert_same(item.lidar, boards[0])


def test_refusal_round_trips():
    refusal = Refusal("image.low_contrast", figures={"contrast": 28.5, "min_contrast": 50.0}, action="events")
    assert from_arrays(to_arrays(refusal)) == refusal


def test_invalid_detection_arrays_are_refused():
    with pytest.raises(ValueError):
        from_arrays({"head": np.frombuffer(b'{"items": 3}', dtype=np.uint8)})
    with pytest.raises(ValueError):
        from_arrays({})


def test_detections_pair_shares_captures():
    refusal = Refusal("image.low_contrast")
    images = {
        ("cam", "frames"): {"000000": refusal, "000001": refusal},
        ("cam", "events"): {"000002": refusal},
    }
    detections = Detections(images, {"lidar": {"000001": [], "000003": []}})
    assert detections.pairs == [Pair("cam", "frames", "lidar")]
    assert detections.captures(detections.pairs[0]) == ["000001"]
    assert detections.of(detections.pairs[0], "000001") == (refusal, [])
