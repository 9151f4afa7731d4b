"""Recordings of real cameras by others, against the makers' own library or kept figures."""

import numpy as np
import pytest

from lce_rig.io.events import open_events


@pytest.fixture
def folder(recordings):
    if not (recordings / "events").is_dir():
        pytest.skip("no recordings of events")
    return recordings / "events"


def columns(path):
    stretches = list(open_events(path))
    return tuple(
        np.concatenate([getattr(stretch, name) for stretch in stretches])
        for name in ("t_ns", "x", "y", "polarity")
    )


@pytest.mark.parametrize("name", ["davis346_short.aedat4", "dvs_320x240.aedat4"])
def test_aedat4_equals_vendor_reader(folder, name):
    dv = pytest.importorskip("dv_processing")
    recording = dv.io.MonoCameraRecording(str(folder / name))
    batches = []
    while (batch := recording.getNextEventBatch()) is not None:
        batches.append(batch.numpy().copy())
    truth = np.concatenate(batches)
    t_ns, *others = columns(folder / name)
    assert np.array_equal(t_ns, truth["timestamp"] * 1000)
    for field, column in zip(("x", "y", "polarity"), others, strict=True):
        assert np.array_equal(column, truth[field])


@pytest.mark.parametrize(
    ("name", "n", "duration_ns", "sums"),
    [
        ("davis346_apriltag_libcaer_cmp.mcap", 571_266, 999_996_000, [118_469_679, 78_763_572, 211_043]),
        ("event_packet_ros1.bag", 343_474, 2_078_178_000, [116_731_888, 80_879_209, 125_183]),
        ("evt3_pedestrians.raw", 5000, 45_210_000, [3_415_152, 1_425_333, 2_894]),
    ],
)
def test_decode_recorded_events_matches_known_sums(folder, name, n, duration_ns, sums):
    t_ns, *others = columns(folder / name)
    assert (len(t_ns), np.ptp(t_ns)) == (n, duration_ns)
    assert [int(column.sum(dtype=np.int64)) for column in others] == sums
