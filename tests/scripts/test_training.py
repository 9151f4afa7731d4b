"""Training of the reconstruction network: simulated events, resuming, export."""

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the extra `train` is not installed")
pytest.importorskip("onnx", reason="the extra `train` is not installed")

import evaluate_reconstruction  # noqa: E402
import train_reconstruction  # noqa: E402
from training.event_simulation import Pixels, normalised  # noqa: E402
from training.network import ReconstructionNetwork  # noqa: E402
from training.onnx_export import export_onnx, export_recurrent  # noqa: E402

from lce_rig.core.data import Events  # noqa: E402
from lce_rig.detect.events.reconstructor import ReconstructionModel  # noqa: E402
from lce_rig.detect.events.windows import normalise_voxels, voxel_grid  # noqa: E402

CPU = torch.device("cpu")
SIZE = 16


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def quiet_pixels(n, seed=0):
    """Make pixels without noise, leak, lag or refractory period: the law of crossings holds exactly."""
    pixels = Pixels(n, SIZE, torch.Generator().manual_seed(seed), CPU)
    pixels.noise_rate *= 0
    pixels.hot_rate *= 0
    pixels.leak *= 0
    pixels.response = torch.ones_like(pixels.response)
    pixels.most = torch.full_like(pixels.most, 1e6)
    return pixels


def random_light(generator, n=2):
    return 0.05 + 0.9 * torch.rand(n, 1, SIZE, SIZE, generator=generator)


def test_sums_over_an_interval_equal_those_of_its_events_one_by_one():
    generator = torch.Generator().manual_seed(2)
    pixels = quiet_pixels(1)
    pixels.start(random_light(generator, 1))
    pixels.expose(random_light(generator, 1), generator)
    before, memory = pixels.level[0, 0].double().numpy(), pixels.memory[0, 0].double().numpy()
    early, late = (a[0, 0].numpy() for a in pixels.expose(random_light(generator, 1), generator))
    after = pixels.level[0, 0].double().numpy()
    expected = np.zeros((2, SIZE, SIZE))
    for y, x in np.ndindex(SIZE, SIZE):
        sign = np.sign(after[y, x] - memory[y, x])
        threshold = float((pixels.on if sign > 0 else pixels.off)[0, 0, y, x])
        for j in range(1, int(abs(after[y, x] - memory[y, x]) / threshold) + 1):
            fraction = (memory[y, x] + sign * j * threshold - before[y, x]) / (after[y, x] - before[y, x])
            expected[:, y, x] += sign * (1 - fraction), sign * fraction
    np.testing.assert_allclose(np.stack([early, late]), expected, atol=2e-3)


def test_the_simulators_grids_are_those_the_package_makes_of_events():
    rng = np.random.default_rng(3)
    n = 400
    events = Events(
        "cam",
        np.sort(rng.integers(0, 1000, n)),
        rng.integers(0, SIZE, n).astype(np.uint16),
        rng.integers(0, SIZE, n).astype(np.uint16),
        rng.random(n) < 0.5,
        SIZE,
        SIZE,
    )
    grid = voxel_grid(events, 5, 0, 1000)
    of_training = normalised(torch.from_numpy(grid)[None])[0].numpy()
    np.testing.assert_allclose(of_training, normalise_voxels(grid.copy()), atol=1e-4)


def test_the_exported_file_computes_what_the_network_computes(tmp_path):
    torch.manual_seed(9)
    network = ReconstructionNetwork().eval()
    export_onnx(network, tmp_path / "net.onnx")
    model = ReconstructionModel(tmp_path / "net.onnx")
    rng = np.random.default_rng(9)
    states = model.initial_states(44, 52)
    expected_states = network.initial_states(1, 44, 52)
    for _ in range(3):
        voxels = rng.standard_normal((5, 44, 52)).astype(np.float32)
        picture, states = model.step(voxels, states)
        with torch.no_grad():
            expected, *expected_states = network(torch.from_numpy(voxels)[None], *expected_states)
        np.testing.assert_allclose(picture, expected[0, 0].numpy(), atol=1e-4)


class PairedStatesNetwork(torch.nn.Module):
    """The shape of E2VID: ConvLSTM pairs at a half, a quarter and an eighth, flattened as in the recipe."""

    def __init__(self):
        super().__init__()
        self.down = torch.nn.ModuleList(torch.nn.Conv2d(n, 4, 3, 2, 1) for n in (5, 4, 4))
        self.gates = torch.nn.ModuleList(torch.nn.Conv2d(8, 16, 3, padding=1) for _ in range(3))
        self.up = torch.nn.Conv2d(4, 64, 1)

    def forward(self, voxels, *states):
        features, following = voxels, []
        for down, gates, hidden, cell in zip(self.down, self.gates, states[0::2], states[1::2], strict=True):
            features = torch.relu(down(features))
            drop, write, value, show = gates(torch.cat([features, hidden], 1)).chunk(4, 1)
            cell = torch.sigmoid(drop) * cell + torch.sigmoid(write) * torch.tanh(value)
            features = torch.sigmoid(show) * torch.tanh(cell)
            following += [features, cell]
        return (torch.nn.functional.pixel_shuffle(self.up(features), 8), *following)


def test_paired_states_at_an_eighth_are_padded_for_and_carried_on(tmp_path):
    export_recurrent(
        PairedStatesNetwork(), [(4, 2), (4, 2), (4, 4), (4, 4), (4, 8), (4, 8)], tmp_path / "lstm.onnx"
    )
    model = ReconstructionModel(tmp_path / "lstm.onnx")
    states = model.initial_states(43, 61)
    assert states[-1].shape == (1, 4, 6, 8)
    voxels = np.ones((5, 43, 61), np.float32)
    first, states = model.step(voxels, states)
    second, _ = model.step(voxels, states)
    assert first.shape == (43, 61) and np.abs(second - first).max() > 1e-4


TINY = ["--batch", "2", "--crop-px", "16", "--unroll", "6", "--device", "cpu"]


def weights_of(folder):
    return torch.load(folder / "checkpoint.pt", weights_only=True)["average"]


def test_a_resumed_run_ends_where_an_unbroken_one_does(tmp_path, monkeypatch):
    unbroken, broken = tmp_path / "a", tmp_path / "b"
    train_reconstruction.main([*TINY, "--out", str(unbroken), "--updates", "12"])
    options = train_reconstruction.parse_options([*TINY, "--out", str(broken), "--updates", "12"])
    broken.mkdir()
    trainer = train_reconstruction.Trainer(options)
    trainer.learn_scenes()
    trainer.save(broken)
    train_reconstruction.main([*TINY, "--out", str(broken), "--updates", "12", "--resume"])
    for name, value in weights_of(unbroken).items():
        assert torch.equal(value, weights_of(broken)[name]), name
    assert (broken / "reconstruction.onnx").read_bytes() == (unbroken / "reconstruction.onnx").read_bytes()


def test_truth_of_held_out_boards_is_where_a_perfect_picture_shows_them():
    scene = evaluate_reconstruction.BoardScene(11)
    errors = []
    for _ in range(12):
        _, target, _ = scene.stream.window()
        grey = (target[0, 0].numpy().clip(0, 1) * 255).astype(np.uint8)
        error = evaluate_reconstruction.corner_error_px(grey, scene.corners_px())
        if error is not None:
            errors.append(error)
    assert errors and max(errors) < 0.25


@pytest.mark.slow
def test_the_shipped_network_finds_held_out_boards(capsys):
    evaluate_reconstruction.main(["--scenes", "12"])
    figures = json.loads(capsys.readouterr().out)
    assert figures["found_share"] > 0.85 and figures["corner_rms_px"] < 0.5
