"""A recording yields samples in order, of one board, and survives the file formats of event cameras."""

import numpy as np
import pytest

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.geometry import invert, transform
from lce_rig.simulate import HandMotion, SimulationOptions, simulate_recording
from lce_rig.simulate.sampling import stamp_of

from .test_moving_captures import found_corners, moving_rig

pytestmark = pytest.mark.long
OPTIONS = SimulationOptions(carrier="person", hand=HandMotion(rest_s=0.1, carry_mps=2.0), exposure_s=0.002)


@pytest.fixture(scope="module")
def rig():
    return moving_rig()


@pytest.fixture(scope="module")
def recording(rig):
    return simulate_recording(rig, duration_s=0.6, seed=3, options=OPTIONS)


@pytest.fixture(scope="module")
def samples(recording):
    return list(recording)


def test_samples_come_in_order_at_each_sensors_own_rate(recording, samples):
    assert np.all(np.diff([stamp_of(sample) for sample in samples]) >= 0)
    counts = {kind: sum(isinstance(sample, kind) for sample in samples) for kind in (Image, Scan, Events)}
    assert counts == {Image: 12, Scan: 6, Events: 30}
    assert stamp_of(samples[0]) >= recording.start_ns
    assert max(stamp_of(sample) for sample in samples) < recording.end_ns == recording.start_ns + 600_000_000


def test_recording_shows_the_true_board(rig, recording, samples):
    lens, n_seen = rig.cameras["cam"].to_intrinsics(), 0
    for sample in samples:
        if isinstance(sample, Image):
            T_cam_board = recording.T_sensor_board("cam", stamp_of(sample))
            truth, _ = lens.project(transform(T_cam_board, rig.board.to_board().corners()))
            if lens.is_inside(truth, 8.0).all():
                found, truth = found_corners(rig, sample, T_cam_board)
                assert np.median(np.abs(found - truth)) < 0.1
                n_seen += 1
        elif isinstance(sample, Scan):
            assert sample.stamp_ns is not None and sample.offset_ns is not None
            T_board_lidar = invert(recording.T_sensor_board("lidar", sample.stamp_ns + sample.offset_ns))
            xyz = np.einsum("nij,nj->ni", T_board_lidar[:, :3, :3], sample.points) + T_board_lidar[:, :3, 3]
            on_board = np.all(np.abs(xyz) < [0.35, 0.25, 0.045], axis=1)
            assert on_board.sum() > 50
            assert np.abs(np.median(xyz[on_board, 2])) < 0.01
    assert n_seen >= 4
