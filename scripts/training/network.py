"""The reconstruction network: a recurrent encoder-decoder that never convolves at full resolution."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

N_BINS = 5
SIZE_MULTIPLE = 4  # two halvings


def convolution(n_in: int, n_out: int, size: int = 3, stride: int = 1) -> nn.Conv2d:
    """Make a convolution that keeps the picture's size (divided by the stride)."""
    return nn.Conv2d(n_in, n_out, size, stride, size // 2)


class GatedCell(nn.Module):
    """Convolutional recurrent cell with one gate: h <- h + z (tanh(o) - h).

    A GRU without the reset gate [1], a third cheaper.

    References:
        [1] Zhou et al., Minimal gated unit for recurrent neural networks, IJAC 2016.
    """

    def __init__(self, n_channels: int) -> None:
        super().__init__()
        self.gate = convolution(2 * n_channels, n_channels)
        self.candidate = convolution(2 * n_channels, n_channels)

    def forward(self, features: Tensor, state: Tensor) -> Tensor:
        """Advance the state by one window."""
        both = torch.cat([features, state], 1)
        update = torch.sigmoid(self.gate(both))
        return state + update * (torch.tanh(self.candidate(both)) - state)


class ReconstructionNetwork(nn.Module):
    """Voxel grid to grey picture, with memory at half and at quarter resolution.

    Space-to-depth at the entry and depth-to-space at the exit keep every convolution at half resolution or
    below; 16 and 48 channels are multiples of the 16-wide blocks onnxruntime's CPU kernels work in (20 and 32
    channels took 30 ms a step where 16 and 32 took 18).

    Args:
        n_half: channels at half resolution.
        n_quarter: channels at quarter resolution.
    """

    def __init__(self, n_half: int = 16, n_quarter: int = 48) -> None:
        super().__init__()
        self.n_half, self.n_quarter = n_half, n_quarter
        self.head = convolution(4 * N_BINS, n_half)
        self.cell_half = GatedCell(n_half)
        self.down = convolution(n_half, n_quarter, stride=2)
        self.cell_quarter = GatedCell(n_quarter)
        self.residual_a = convolution(n_quarter, n_quarter)
        self.residual_b = convolution(n_quarter, n_quarter)
        self.up = convolution(n_quarter, 4 * n_half, size=1)
        self.fuse_a = convolution(n_half, n_half)
        self.fuse_b = convolution(n_half, n_half)
        self.out = convolution(n_half, 4)

    def forward(self, voxels: Tensor, half: Tensor, quarter: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Reconstruct one window.

        Args:
            voxels: (N, 5, H, W) normalised voxel grid, H and W multiples of 4.
            half: (N, n_half, H/2, W/2) state.
            quarter: (N, n_quarter, H/4, W/4) state.

        Returns:
            picture (N, 1, H, W) around 0.5 with standard deviation about 0.2, and both states.
        """
        features = F.relu(self.head(F.pixel_unshuffle(voxels, 2)))
        half = self.cell_half(features, half)
        quarter = self.cell_quarter(F.relu(self.down(half)), quarter)
        deep = F.relu(quarter + self.residual_b(F.relu(self.residual_a(quarter))))
        fused = F.relu(half + F.pixel_shuffle(self.up(deep), 2))
        fused = F.relu(fused + self.fuse_b(F.relu(self.fuse_a(fused))))
        return F.pixel_shuffle(self.out(fused), 2) + 0.5, half, quarter

    def initial_states(self, n: int, height_px: int, width_px: int) -> tuple[Tensor, Tensor]:
        """Make the states before the first window: zeros."""
        parameter = self.head.weight
        return (
            parameter.new_zeros(n, self.n_half, height_px // 2, width_px // 2),
            parameter.new_zeros(n, self.n_quarter, height_px // 4, width_px // 4),
        )
