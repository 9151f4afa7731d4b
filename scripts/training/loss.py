"""Error of an image: L1, structural similarity and gradients, each weighted per pixel."""

import torch
from torch import Tensor
from torch.nn import functional as F

SSIM_WEIGHT = 0.4
GRADIENT_WEIGHT = 1.0


def _local_mean(picture: Tensor) -> Tensor:
    return F.avg_pool2d(picture, 7, 1, 3, count_include_pad=False)


def structural_similarity(a: Tensor, b: Tensor) -> Tensor:
    """Compare local mean, contrast and structure over 7 x 7 windows, map in [-1, 1] of the pictures' shape.

    References:
        Wang et al., Image quality assessment: from error visibility to structural similarity, TIP 2004.
    """
    mean_a, mean_b = _local_mean(a), _local_mean(b)
    var_a, var_b = _local_mean(a * a) - mean_a**2, _local_mean(b * b) - mean_b**2
    cov = _local_mean(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + 1e-4) / (mean_a**2 + mean_b**2 + 1e-4)
    return luminance * (2 * cov + 9e-4) / (var_a + var_b + 9e-4)


def reconstruction_loss(pictures: Tensor, targets: Tensor, weights: Tensor) -> Tensor:
    """Average |p - t| + 0.4 (1 - SSIM) + |grad(p - t)| over the weighted pixels; all (N, 1, S, S)."""
    difference = pictures - targets
    total = difference.abs() + SSIM_WEIGHT * (1 - structural_similarity(pictures, targets))
    along_x = F.pad((difference[..., 1:] - difference[..., :-1]).abs(), (0, 1))
    along_y = F.pad((difference[..., 1:, :] - difference[..., :-1, :]).abs(), (0, 0, 0, 1))
    total = total + GRADIENT_WEIGHT * (along_x + along_y)
    return torch.sum(total * weights) / torch.sum(weights)
