"""The network that ships with the package."""

import numpy as np
import pytest

from lce_rig.detect.events.reconstructor import SHIPPED_NETWORK, ReconstructionModel


def test_the_shipped_model_is_at_most_1_mb():
    assert 10_000 < SHIPPED_NETWORK.stat().st_size <= 1_000_000


@pytest.mark.parametrize(("width", "height"), [(346, 260), (173, 131), (64, 64)])
def test_reconstructed_images_have_sensor_size(width, height):
    model = ReconstructionModel()
    states = model.initial_states(height, width)
    picture, following = model.step(np.zeros((model.n_bins, height, width), np.float32), states)
    assert picture.shape == (height, width)
    assert [state.shape for state in following] == [state.shape for state in states]
    assert np.isfinite(picture).all()
