"""Procedural textures: boards with patterns, and backgrounds."""

import math

import torch
from torch import Tensor
from torch.nn import functional as F

TEXTURE_PX = 192


def _uniform(generator: torch.Generator, low: float, high: float) -> float:
    return low + (high - low) * float(torch.rand((), generator=generator))


def _grid() -> tuple[Tensor, Tensor]:
    line = torch.arange(TEXTURE_PX, dtype=torch.float32) - (TEXTURE_PX - 1) / 2
    y, x = torch.meshgrid(line, line, indexing="ij")
    return x, y


X_TEXEL, Y_TEXEL = _grid()


def smooth_noise(generator: torch.Generator) -> Tensor:
    """Make 1/f noise in [0, 1], (T, T): the appearance of most rooms out of focus."""
    steepness = _uniform(generator, 0.5, 1.3)
    noise = torch.zeros(1, 1, TEXTURE_PX, TEXTURE_PX)
    for size in (3, 6, 12, 24, 48, 96):
        octave = torch.randn(1, 1, size, size, generator=generator)
        noise += F.interpolate(octave, (TEXTURE_PX, TEXTURE_PX), mode="bilinear") / size**steepness
    noise = noise - noise.amin()
    return (noise / noise.amax())[0, 0]


def _turned(angle_rad: float, x: float, y: float) -> tuple[Tensor, Tensor]:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    dx, dy = X_TEXEL - x, Y_TEXEL - y
    return c * dx + s * dy, c * dy - s * dx


def clutter(generator: torch.Generator, n_shapes: int) -> Tensor:
    """Make noise with rectangles, bars and discs drawn over it, (T, T)."""
    texture = smooth_noise(generator) * _uniform(generator, 0.2, 0.9) + 0.05
    half = TEXTURE_PX / 2
    for _ in range(n_shapes):
        u, v = _turned(
            _uniform(generator, 0, math.pi),
            _uniform(generator, -half, half),
            _uniform(generator, -half, half),
        )
        a = 2 + 40 * _uniform(generator, 0, 1) ** 2
        b = 2 + 40 * _uniform(generator, 0, 1) ** 2
        is_disc = _uniform(generator, 0, 1) < 0.25
        inside = (u / a) ** 2 + (v / a) ** 2 < 1 if is_disc else (u.abs() < a) & (v.abs() < b)
        texture = torch.where(inside, torch.tensor(_uniform(generator, 0.02, 1.0)), texture)
    return texture


def checkerboard(generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Make a checkerboard with a margin: reflectance and cover, (T, T) each."""
    cols = int(_uniform(generator, 4, 10))
    rows = int(_uniform(generator, 3, 8))
    square = min(_uniform(generator, 12, 34), 0.92 * TEXTURE_PX / (max(cols, rows) + 0.5))
    return draw_checkerboard(generator, cols, rows, square)


def draw_checkerboard(
    generator: torch.Generator, cols: int, rows: int, square_texels: float
) -> tuple[Tensor, Tensor]:
    """Draw cols x rows squares in the middle of the texture: reflectance and cover, (T, T) each."""
    u, v = X_TEXEL / square_texels + cols / 2, Y_TEXEL / square_texels + rows / 2
    dark, light = _uniform(generator, 0.03, 0.2), _uniform(generator, 0.55, 1.0)
    is_light = (torch.floor(u) + torch.floor(v)) % 2 == 0
    is_pattern = (u >= 0) & (u < cols) & (v >= 0) & (v < rows)
    margin = _uniform(generator, 0.0, 1.2)
    # Boards are mostly white around the pattern; some are mounted on dark or grey plates.
    ground = light if _uniform(generator, 0, 1) < 0.75 else _uniform(generator, 0.05, 0.7)
    texture = torch.where(is_pattern & ~is_light, torch.tensor(dark), torch.tensor(light))
    texture = torch.where(is_pattern, texture, torch.tensor(ground))
    is_board = (u > -margin) & (u < cols + margin) & (v > -margin) & (v < rows + margin)
    return texture, is_board.float()


def tag_grid(generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Make a grid of tags with random bits (no dictionary's): reflectance and cover, (T, T) each."""
    modules, gap = int(_uniform(generator, 6, 9)), _uniform(generator, 0.15, 0.5)
    module = _uniform(generator, 4.0, 9.0)
    pitch = module * modules * (1 + gap)
    n = max(1, int(0.95 * TEXTURE_PX / pitch))
    u, v = X_TEXEL / pitch + n / 2, Y_TEXEL / pitch + n / 2
    a, b = (u % 1) * (1 + gap) * modules, (v % 1) * (1 + gap) * modules
    is_tag = (a < modules) & (b < modules)
    is_border = (a < 1) | (b < 1) | (a > modules - 1) | (b > modules - 1)
    bits = torch.rand(n, n, modules + 8, modules + 8, generator=generator) < 0.5
    column, row = u.floor().clamp(0, n - 1).long(), v.floor().clamp(0, n - 1).long()
    bit = bits[row, column, b.clamp(0, modules).long(), a.clamp(0, modules).long()]
    is_corner = (a > modules) & (b > modules) if _uniform(generator, 0, 1) < 0.7 else torch.zeros_like(is_tag)
    is_dark = (is_tag & (is_border | bit)) | is_corner
    dark, light = _uniform(generator, 0.03, 0.2), _uniform(generator, 0.55, 1.0)
    texture = torch.where(is_dark, torch.tensor(dark), torch.tensor(light))
    is_board = (u > -0.1) & (u < n + 0.1) & (v > -0.1) & (v < n + 0.1)
    return texture, is_board.float()


def card(generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Make a cluttered rectangle: reflectance and cover, (T, T) each."""
    a, b = _uniform(generator, 25, 90), _uniform(generator, 25, 90)
    return clutter(generator, 12), ((X_TEXEL.abs() < a) & (Y_TEXEL.abs() < b)).float()


def foreground(generator: torch.Generator) -> Tensor:
    """Draw the object held in front of the camera: reflectance and cover, (2, T, T)."""
    kind = _uniform(generator, 0, 1)
    if kind < 0.45:
        texture, cover = checkerboard(generator)
    elif kind < 0.75:
        texture, cover = tag_grid(generator)
    elif kind < 0.92:
        texture, cover = card(generator)
    else:
        texture, cover = X_TEXEL * 0, X_TEXEL * 0
    # Uneven light over the board, so that no two of its squares are equally bright.
    return torch.stack([texture * (0.75 + 0.25 * smooth_noise(generator)), cover])


def soften(textures: Tensor) -> Tensor:
    """Blur by about one texel, so that sampling at up to two texels per pixel does not alias."""
    kernel = torch.tensor([0.25, 0.5, 0.25], device=textures.device)
    n = textures.shape[1]
    padded = F.pad(textures, (1, 1, 1, 1), mode="replicate")
    padded = F.conv2d(padded, kernel.view(1, 1, 1, 3).expand(n, 1, 1, 3), groups=n)
    return F.conv2d(padded, kernel.view(1, 1, 3, 1).expand(n, 1, 3, 1), groups=n)
