"""Events of moving scenes, summed straight into voxel grids: no event list is ever made."""

import math

import torch
from torch import Tensor

from .network import N_BINS
from .scenes import Scenes

N_INTERVALS = N_BINS - 1  # one rendered picture per bin boundary


def normalised(voxels: Tensor) -> Tensor:
    """Bring the non-zero voxels of each grid (N, B, H, W) to mean 0 and standard deviation 1."""
    is_hit = voxels != 0
    n_hit = is_hit.sum((1, 2, 3), keepdim=True).clamp(min=1)
    mean = voxels.sum((1, 2, 3), keepdim=True) / n_hit
    variance = ((voxels - mean).square() * is_hit).sum((1, 2, 3), keepdim=True) / n_hit
    return torch.where(is_hit, (voxels - mean) / variance.sqrt().clamp(min=1e-3), voxels)


class Pixels:
    """The pixels of a batch of event cameras, each camera with its own habits.

    A pixel holds the log intensity of its last event and fires each time the (low-passed) log intensity
    departs from it by the threshold, as in the models of [1, 2].

    References:
        [1] Hu, Liu, Delbruck, v2e: From video frames to realistic DVS events, CVPRW 2021.
        [2] Rebecq, Gehrig, Scaramuzza, ESIM: an open event camera simulator, CoRL 2018.
    """

    def __init__(self, n: int, size_px: int, generator: torch.Generator, device: torch.device) -> None:
        def uniform(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator)

        one, pixels = (n, 1, 1, 1), (n, 1, size_px, size_px)
        threshold = 0.1 * 5 ** uniform(*one)
        mismatch = (1 + (0.02 + 0.1 * uniform(*one)) * normal(*pixels)).clamp(min=0.5)
        self.off = (threshold * mismatch).to(device)
        self.on = (threshold * mismatch * torch.exp(0.15 * normal(*one))).to(device)
        self.floor = (0.01 * 8 ** uniform(*one)).to(device)  # dark current, as light
        self.response = torch.where(uniform(*one) < 0.5, torch.ones(one), 0.35 + 0.65 * uniform(*one)).to(
            device
        )
        self.leak = (0.02 * uniform(*one) ** 2 * threshold).to(device)
        most = torch.where(uniform(*one) < 0.3, 1 + 4 * uniform(*one), torch.full(one, 50.0))
        self.most = most.floor().to(device)  # what the refractory period lets through per interval
        self.noise_rate = (10 ** (-4.5 + 2.5 * uniform(*one)) / N_INTERVALS).to(device)
        is_hot = uniform(*pixels) < 0.002 * uniform(*one)
        self.hot_rate = (is_hot * 4 * uniform(*pixels) / N_INTERVALS).to(device)
        self.hot_sign = torch.where(uniform(*pixels) < 0.8, 1.0, -1.0).to(device)
        self.level: Tensor | None = None
        self.memory: Tensor | None = None

    def start(self, light: Tensor) -> None:
        """Settle on the first picture."""
        self.level = torch.log(light + self.floor)
        self.memory = self.level.clone()

    def expose(self, light: Tensor, noise: torch.Generator) -> tuple[Tensor, Tensor]:
        """Advance to the next picture (N, 1, S, S); log intensity is linear in time between pictures.

        Returns:
            sums over the interval's events of polarity times (1 - f) and times f, with f the fraction of the
            interval passed: what bilinear accumulation adds to the bin at the interval's start and end.
        """
        assert self.level is not None and self.memory is not None
        before = self.level
        after = before + self.response * (torch.log(light + self.floor) - before)
        self.level, self.memory = after, self.memory - self.leak
        departure = after - self.memory
        threshold = torch.where(departure > 0, self.on, self.off)
        count = (departure.abs() / threshold).floor()
        fired = count.minimum(self.most)
        sign = departure.sign()
        # Event j of `fired` happens at f_j = (memory + sign j threshold - before) / (after - before).
        change = after - before
        change = torch.where(change.abs() < 1e-4, torch.where(departure < 0, -1e-4, 1e-4), change)
        first = (self.memory - before) / change
        slope = sign * threshold / change
        at_end = (fired * first + slope * fired * (fired + 1) / 2).clamp(min=0).minimum(fired)
        # After events lost to the refractory period the pixel starts again from where it is.
        self.memory = torch.where(count > fired, after, self.memory + sign * count * threshold)
        drawn = torch.rand(light.shape, generator=noise, device=light.device)
        random = (drawn < self.noise_rate / 2).float() - (drawn > 1 - self.noise_rate / 2).float()
        hot = torch.rand(light.shape, generator=noise, device=light.device)
        random = random + self.hot_sign * ((self.hot_rate + hot).floor())
        early = sign * (fired - at_end) + random / 2
        return early, sign * at_end + random / 2


class EventStream:
    """Windows of simulated events with the picture at each window's end.

    Half of the scenes are cut into windows of constant time, half into windows of roughly constant event
    count (0.05 to 1 event per pixel), as the runtime does; movement pauses and turns.

    Args:
        n: scenes.
        size_px: side of the pictures.
        seed: of everything random.
        device: where it is computed.
        fronts: (N, 2, T, T) what is held in front of the background; None draws it.
    """

    def __init__(
        self, n: int, size_px: int, seed: int, device: torch.device, fronts: Tensor | None = None
    ) -> None:
        self._generator = torch.Generator().manual_seed(seed)
        self._noise = torch.Generator(device).manual_seed(seed)
        self.scenes = Scenes(n, size_px, self._generator, device, fronts)
        self._pixels = Pixels(n, size_px, self._generator, device)
        self._device, self._n = device, n
        uniform = torch.rand(3, n, generator=self._generator)
        self._pace = (0.006 * 40 ** uniform[0]).to(device)  # path per window; about 30 px per unit
        self._target_rate = (0.05 * 20 ** uniform[1]).to(device)  # events per pixel and window
        self._is_counted = (uniform[2] < 0.5).to(device)
        self.path = (torch.rand(n, generator=self._generator) * 100).to(device)
        self._pause_left = torch.zeros(n, device=device)
        picture = self.scenes.picture(self.path)
        self._mean = picture.mean((1, 2, 3), keepdim=True)
        self._std = picture.std((1, 2, 3), keepdim=True)
        self._pixels.start(picture)
        self._seen = torch.zeros_like(picture)

    @torch.no_grad()
    def window(self) -> tuple[Tensor, Tensor, Tensor]:
        """Simulate one window.

        Returns:
            voxels (N, 5, S, S), normalised; target picture (N, 1, S, S); weight (N, 1, S, S), low where no
            event ever told of the pixel's brightness.
        """
        step = self._next_step()
        voxels = torch.zeros(self._n, N_BINS, *self._seen.shape[2:], device=self._device)
        for interval in range(N_INTERVALS):
            self.path = self.path + step / N_INTERVALS
            picture = self.scenes.picture(self.path)
            early, late = self._pixels.expose(picture, self._noise)
            voxels[:, interval] += early[:, 0]
            voxels[:, interval + 1] += late[:, 0]
        activity = voxels.abs().sum(1, keepdim=True)
        self._follow_rate(activity.mean((1, 2, 3)))
        near = torch.nn.functional.max_pool2d((activity > 0).float(), 7, 1, 3)
        self._seen = torch.maximum(0.97 * self._seen, near)
        self._mean += 0.2 * (picture.mean((1, 2, 3), keepdim=True) - self._mean)
        self._std += 0.2 * (picture.std((1, 2, 3), keepdim=True) - self._std)
        target = (picture - self._mean) / self._std.clamp(min=0.05) * 0.2 + 0.5
        return normalised(voxels), target, 0.15 + 0.85 * self._seen

    def _next_step(self) -> Tensor:
        drawn = torch.rand(2, self._n, generator=self._generator).to(self._device)
        self._pause_left = torch.where(drawn[0] < 0.03, (2 + 10 * drawn[1]).floor(), self._pause_left - 1)
        is_paused = (self._pause_left > 0) & ~self._is_counted
        jitter = torch.exp(0.3 * torch.sin(2 * math.pi * drawn[1]))
        return torch.where(is_paused, torch.zeros_like(self._pace), self._pace * jitter)

    def _follow_rate(self, rate: Tensor) -> None:
        """Stretch the counted windows' time until their event count fits."""
        factor = (self._target_rate / rate.clamp(min=1e-3)).clamp(0.5, 2.0) ** 0.6
        self._pace = torch.where(self._is_counted, (self._pace * factor).clamp(0.002, 0.6), self._pace)
