"""The network file: what is accepted, and what is said about the others."""

from importlib import resources

import numpy as np
import pytest

from lce_rig.core.errors import ProfileError
from lce_rig.detect.events.reconstructor import ReconstructionModel

from .onnx_file import write_network


def test_the_shipped_model_is_at_most_1_mb():
    model = resources.files("lce_rig") / "models" / "reconstruction.onnx"
    assert 10_000 < len(model.read_bytes()) <= 1_000_000


@pytest.mark.parametrize(("width", "height"), [(346, 260), (173, 131), (64, 64)])
def test_pictures_have_the_sensors_size_whatever_it_is(width, height):
    model = ReconstructionModel()
    states = model.initial_states(height, width)
    picture, following = model.step(np.zeros((model.n_bins, height, width), np.float32), states)
    assert picture.shape == (height, width)
    assert [state.shape for state in following] == [state.shape for state in states]
    assert np.isfinite(picture).all()


@pytest.mark.parametrize("content", [None, b"", b"not a network", "half of the shipped one"])
def test_a_file_that_is_missing_torn_or_no_network_is_named(tmp_path, content):
    path = tmp_path / "other.onnx"
    if isinstance(content, str):
        whole = (resources.files("lce_rig") / "models" / "reconstruction.onnx").read_bytes()
        content = whole[: len(whole) // 2]
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ProfileError, match=r"other\.onnx"):
        ReconstructionModel(path)


VOXELS = ("v", [1, 5, "height", "width"])
STATE = ("s", [1, 3, "height_2", "width_2"])


def test_another_network_with_the_same_kind_of_inputs_is_accepted(tmp_path):
    outputs = [[1, 1, "height", "width"], STATE[1]]
    model = ReconstructionModel(write_network(tmp_path / "m.onnx", [VOXELS, STATE], outputs))
    assert (model.n_bins, model.states[0].n_channels, model.states[0].divisor) == (5, 3, 2)
    picture, _ = model.step(np.ones((5, 7, 9), np.float32), model.initial_states(7, 9))
    np.testing.assert_array_equal(picture, 1)


@pytest.mark.parametrize(
    ("inputs", "outputs"),
    [
        ([("image", ["n", 3])], [["n", 1]]),
        ([("v", [1, 5, 64, 64])], [[1, 1, 64, 64]]),
        ([VOXELS, STATE], [[1, 1, "height", "width"]]),
        ([VOXELS, ("s", [1, 3, "a", "b"])], [[1, 1, "height", "width"], [1, 3, "a", "b"]]),
        ([VOXELS, STATE], [[1, 1, "height", "width"], [1, 3, 1, "width_2"]]),
    ],
)
def test_other_inputs_and_outputs_are_refused_at_the_first_step_at_the_latest(tmp_path, inputs, outputs):
    with pytest.raises(ProfileError):
        model = ReconstructionModel(write_network(tmp_path / "m.onnx", inputs, outputs, drops_rows=True))
        model.step(np.ones((5, 7, 9), np.float32), model.initial_states(7, 9))


@pytest.mark.parametrize(("channels", "scale"), [(10**9, "2"), (3, "9" * 30)])
def test_states_beyond_all_networks_are_refused(tmp_path, channels, scale):
    dims = [1, channels, f"height_{scale}", f"width_{scale}"]
    with pytest.raises(ProfileError):
        path = write_network(tmp_path / "m.onnx", [VOXELS, ("s", dims)], [[1, 1, "height", "width"], dims])
        model = ReconstructionModel(path)
        model.step(np.ones((5, 7, 9), np.float32), model.initial_states(7, 9))
