"""The network file: what is accepted, and what is said about the others."""

from importlib import resources

import numpy as np
import pytest

from lce_rig.core.errors import ProfileError
from lce_rig.detect.events.reconstruct import ReconstructionModel

from .onnx_file import (
    network_with_weights_in,
    recurrent_network,
)


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


def test_the_state_remembers_what_the_window_before_showed():
    model = ReconstructionModel()
    rng = np.random.default_rng(0)
    states = model.initial_states(64, 64)
    _, seen = model.step(rng.standard_normal((5, 64, 64)).astype(np.float32), states)
    empty = np.zeros((5, 64, 64), np.float32)
    assert np.abs(model.step(empty, seen)[0] - model.step(empty, states)[0]).max() > 0.05


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ProfileError, match=r"other\.onnx"):
        ReconstructionModel(tmp_path / "other.onnx")


@pytest.mark.parametrize("content", [b"", b"not a network", bytes(range(256)) * 8])
def test_a_file_that_is_no_network_is_refused_with_what_was_expected(tmp_path, content):
    path = tmp_path / "other.onnx"
    path.write_bytes(content)
    with pytest.raises(ProfileError, match=r"other\.onnx"):
        ReconstructionModel(path)


def test_a_shipped_model_cut_short_is_refused(tmp_path):
    whole = (resources.files("lce_rig") / "models" / "reconstruction.onnx").read_bytes()
    path = tmp_path / "torn.onnx"
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ProfileError, match=r"torn\.onnx"):
        ReconstructionModel(path)


VOXELS = ("v", [1, 5, "height", "width"])
STATE = ("s", [1, 3, "height_2", "width_2"])


def write_model(path, inputs, output_shapes, drop_half=False):
    """Write a graph that copies its inputs to its outputs as far as there are any."""
    onnx = pytest.importorskip("onnx")
    make = onnx.helper
    float32 = onnx.TensorProto.FLOAT
    nodes = []
    for index in range(len(output_shapes)):
        source = inputs[min(index, len(inputs) - 1)][0]
        operation = "ReduceMean" if index == 0 else "Identity"
        attributes = {"axes": [1], "keepdims": 1} if index == 0 else {}
        if drop_half and index == 1:
            operation, attributes = "ReduceMean", {"axes": [2], "keepdims": 1}
        nodes.append(make.make_node(operation, [source], [f"o{index}"], **attributes))
    graph = make.make_graph(
        nodes,
        "g",
        [make.make_tensor_value_info(name, float32, shape) for name, shape in inputs],
        [
            make.make_tensor_value_info(f"o{index}", float32, shape)
            for index, shape in enumerate(output_shapes)
        ],
    )
    model = make.make_model(graph, opset_imports=[make.make_opsetid("", 17)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return path


def test_another_network_with_the_same_kind_of_inputs_is_accepted(tmp_path):
    outputs = [[1, 1, "height", "width"], STATE[1]]
    model = ReconstructionModel(write_model(tmp_path / "m.onnx", [VOXELS, STATE], outputs))
    assert (model.n_bins, model.states[0].n_channels, model.states[0].divisor) == (5, 3, 2)
    picture, _ = model.step(np.ones((5, 7, 9), np.float32), model.initial_states(7, 9))
    np.testing.assert_array_equal(picture, 1)


@pytest.mark.parametrize(
    ("inputs", "outputs", "said"),
    [
        ([("image", ["n", 3])], [["n", 1]], "image has the shape"),
        ([("v", [1, 5, 64, 64])], [[1, 1, 64, 64]], "v has the shape"),
        ([VOXELS, STATE], [[1, 1, "height", "width"]], "2 inputs and 1 outputs"),
        (
            [VOXELS, ("s", [1, 3, "a", "b"])],
            [[1, 1, "height", "width"], [1, 3, "a", "b"]],
            "input s has the shape",
        ),
    ],
)
def test_other_inputs_are_refused_naming_them_and_what_was_expected(tmp_path, inputs, outputs, said):
    path = write_model(tmp_path / "m.onnx", inputs, outputs)
    with pytest.raises(ProfileError):
        ReconstructionModel(path)


def test_a_network_whose_states_change_their_size_is_refused_at_its_first_step(tmp_path):
    outputs = [[1, 1, "height", "width"], [1, 3, 1, "width_2"]]
    model = ReconstructionModel(write_model(tmp_path / "m.onnx", [VOXELS, STATE], outputs, drop_half=True))
    with pytest.raises(ProfileError):
        model.step(np.ones((5, 7, 9), np.float32), model.initial_states(7, 9))


@pytest.mark.parametrize("location", ["w.bin", "{folder}/w.bin", "../../../../../../../..{folder}/w.bin"])
def test_weights_in_other_files_are_not_read(tmp_path, monkeypatch, location):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "w.bin").write_bytes(np.float32(3).tobytes())
    path = network_with_weights_in(tmp_path / "m.onnx", location.format(folder=tmp_path))
    with pytest.raises(ProfileError):
        ReconstructionModel(path)


@pytest.mark.parametrize(
    ("channels", "scale", "said"),
    [
        (10**9, "2", "do not fit into memory"),
        (3, "997", "multiples of 1994 px"),
        (3, "9" * 30, "has the shape"),
    ],
)
def test_states_beyond_all_networks_are_refused(tmp_path, channels, scale, said):
    dims = [1, channels, f"height_{scale}", f"width_{scale}"]
    with pytest.raises(ProfileError, match=said):
        ReconstructionModel(recurrent_network(tmp_path / "m.onnx", dims)).initial_states(260, 346)
