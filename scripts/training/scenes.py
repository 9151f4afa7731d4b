"""Moving scenes: a board before a background, both seen through homographies that change smoothly."""

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from .textures import TEXTURE_PX, clutter, foreground, soften


def _log_uniform(low: float, high: float, uniform: Tensor) -> Tensor:
    return low * (high / low) ** uniform


class MovingPlanes:
    """One textured plane per scene, moving as a sum of sinusoids of the scene's path parameter.

    Args:
        textures: (N, C, T, T).
        generator: source of the motion.
        reach_px: (N,) how far the plane travels to each side, pixels of the crop.
        size_px: side of the crop.
    """

    def __init__(self, textures: Tensor, generator: torch.Generator, reach_px: Tensor, size_px: int) -> None:
        n, device = len(textures), textures.device

        def uniform(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator).to(device)

        self.textures, self.size_px = textures, size_px
        self.reach_px = reach_px[:, None].to(device)
        self.phase_rad = uniform(n, 2, 8) * 2 * math.pi
        self.frequency = _log_uniform(0.4, 2.5, uniform(n, 2, 8))
        self.texels_per_px = _log_uniform(0.9, 2.2, uniform(n))
        self.angle_rad = (uniform(n) - 0.5) * 1.4
        self.tilt = (uniform(n, 2) - 0.5) * 0.5 / size_px
        self.offset_px = (uniform(n, 2) - 0.5) * 0.5 * size_px
        line = torch.arange(size_px, device=device, dtype=torch.float32) - (size_px - 1) / 2
        y, x = torch.meshgrid(line, line, indexing="ij")
        self.pixels = torch.stack([x.flatten(), y.flatten(), torch.ones_like(x.flatten())])

    def homography(self, path: Tensor) -> Tensor:
        """Map crop pixels (centred) to texture coordinates in [-1, 1], (N, 3, 3), at the path parameter."""
        wave = torch.sin(self.frequency * path[:, None, None] + self.phase_rad).mean(1)
        shift = self.offset_px + self.reach_px * wave[:, 0:2]
        angle = self.angle_rad + wave[:, 2] * self.reach_px[:, 0] / self.size_px
        scale = self.texels_per_px * (
            1 + 0.4 * wave[:, 3] * (self.reach_px[:, 0] / self.size_px).clamp(max=1)
        )
        tilt = self.tilt * (1 + wave[:, 4:6])
        unit = scale * 2 / TEXTURE_PX
        c, s = unit * angle.cos(), unit * angle.sin()
        matrix = torch.zeros(len(path), 3, 3, device=path.device)
        matrix[:, 0, 0], matrix[:, 0, 1] = c, -s
        matrix[:, 1, 0], matrix[:, 1, 1] = s, c
        matrix[:, 0, 2] = -(c * shift[:, 0] - s * shift[:, 1])
        matrix[:, 1, 2] = -(s * shift[:, 0] + c * shift[:, 1])
        matrix[:, 2, :2] = tilt
        matrix[:, 2, 2] = 1
        return matrix

    def render(self, path: Tensor, padding: str) -> Tensor:
        """Look at the planes, (N, C, S, S)."""
        points = self.homography(path) @ self.pixels
        grid = (points[:, :2] / points[:, 2:].clamp(min=0.2)).transpose(1, 2)
        grid = grid.reshape(len(path), self.size_px, self.size_px, 2)
        return F.grid_sample(self.textures, grid, "bilinear", padding, align_corners=False)


class Scenes:
    """A batch of scenes and where each is on its path.

    Args:
        n: scenes in the batch.
        size_px: side of the square crop.
        generator: source of every random number (on the CPU, so that devices agree).
        device: where pictures are rendered.
        fronts: (N, 2, T, T) reflectance and cover of what is held in front; None draws them.
    """

    def __init__(
        self,
        n: int,
        size_px: int,
        generator: torch.Generator,
        device: torch.device,
        fronts: Tensor | None = None,
    ) -> None:
        def uniform(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator)

        if fronts is None:
            fronts = torch.stack([foreground(generator) for _ in range(n)])
        backs = torch.stack([clutter(generator, int(uniform(1) * 25)) for _ in range(n)])[:, None]
        front_reach = size_px * (0.15 + 0.6 * uniform(n))
        # In 40 % of the scenes the camera stands and only the board moves.
        back_reach = size_px * (0.1 + 0.5 * uniform(n)) * (uniform(n) > 0.4)
        self.front = MovingPlanes(soften(fronts.to(device)), generator, front_reach, size_px)
        self.back = MovingPlanes(soften(backs.to(device)), generator, back_reach, size_px)
        self.light = (0.4 + 0.6 * uniform(n, 1, 1, 1)).to(device)
        self.flicker = (0.06 * uniform(n, 1, 1, 1) * (uniform(n, 1, 1, 1) < 0.08)).to(device)
        self.flicker_phase = torch.zeros(n, 1, 1, 1, device=device)

    def picture(self, path: Tensor) -> Tensor:
        """Render the scenes at path parameters (N,): reflected light in (0, 1], (N, 1, S, S)."""
        back = self.back.render(path, "reflection")
        front = self.front.render(path, "zeros")
        cover = front[:, 1:2]
        light = back + cover * (front[:, :1] - back)
        self.flicker_phase += 2.4
        return (light * self.light * (1 + self.flicker * self.flicker_phase.sin())).clamp(min=0.005)
