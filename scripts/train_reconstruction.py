#!/usr/bin/env python
"""Train the event-to-image network of lce-rig on simulated events and write it as ONNX.

    pip install -e '.[train]'
    python scripts/train_reconstruction.py --minutes 120 --out build/training            # a CPU, hours
    python scripts/train_reconstruction.py --minutes 10 --batch 128 --out build/training # a GPU, minutes
    python scripts/train_reconstruction.py --resume --minutes 240 --out build/training   # go on

The learning rate follows the share of --minutes (or of --updates) that is spent; training time is counted
over all runs of one folder. Runs limited by --updates repeat exactly on the same machine; runs limited by
--minutes repeat up to the number of updates that fit.
"""

import argparse
import math
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from training.event_simulation import EventStream
from training.loss import reconstruction_loss
from training.network import ReconstructionNetwork
from training.onnx_export import export_onnx

UPDATES_PER_SCENE = 6
PEAK_LEARNING_RATE = 2e-3
WARM_UP_UPDATES = 100
AVERAGE_DECAY = 0.998
SAVE_EVERY_S = 60.0


@dataclass
class Progress:
    """State of a run in a checkpoint: progress and cost."""

    scene: int = 0
    updates: int = 0
    elapsed_s: float = 0.0
    windows: int = 0


class Trainer:
    """Truncated back-propagation through time over simulated windows; weights are averaged too."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.device = torch.device(options.device)
        torch.manual_seed(options.seed)
        self.network = ReconstructionNetwork().to(self.device, memory_format=torch.channels_last)
        self.average = ReconstructionNetwork().to(self.device)
        self.average.load_state_dict(self.network.state_dict())
        self.optimiser = torch.optim.AdamW(self.network.parameters(), PEAK_LEARNING_RATE, weight_decay=1e-4)
        self.progress = Progress()

    def spent(self) -> float:
        """Share of the budget that is used up, by time or by updates."""
        if self.options.updates:
            return self.progress.updates / self.options.updates
        return self.progress.elapsed_s / (60 * self.options.minutes)

    def learn_scenes(self) -> float:
        """Train on one batch of scenes from rest; return the mean loss."""
        options = self.options
        begun = time.monotonic()
        seed = options.seed * 1_000_003 + self.progress.scene
        stream = EventStream(options.batch, options.crop_px, seed, self.device)
        states = self.network.initial_states(options.batch, options.crop_px, options.crop_px)
        total = 0.0
        for part in range(UPDATES_PER_SCENE):
            states = tuple(state.detach() for state in states)
            loss, states = self._unroll(stream, states, skip=4 if part == 0 else 0)
            self._descend(loss)
            total += float(loss.detach())
        self.progress.scene += 1
        self.progress.elapsed_s += time.monotonic() - begun
        return total / UPDATES_PER_SCENE

    def _unroll(
        self, stream: EventStream, states: tuple[torch.Tensor, ...], skip: int
    ) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
        """Run one truncation length; the first `skip` windows after rest are not judged."""
        loss = torch.zeros((), device=self.device)
        for k in range(self.options.unroll):
            voxels, target, weight = stream.window()
            with torch.autocast(self.device.type, dtype=torch.bfloat16):
                voxels = voxels.contiguous(memory_format=torch.channels_last)
                picture, *states = self.network(voxels, *states)
            if k >= skip:
                loss = loss + reconstruction_loss(picture.float(), target, weight)
        return loss / (self.options.unroll - skip), tuple(states)

    def _descend(self, loss: torch.Tensor) -> None:
        warm = min(1.0, (self.progress.updates + 1) / WARM_UP_UPDATES)
        cosine = 0.5 + 0.5 * math.cos(math.pi * min(1.0, self.spent()))
        for group in self.optimiser.param_groups:
            group["lr"] = warm * PEAK_LEARNING_RATE * (0.01 + 0.99 * cosine)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 0.5)
        self.optimiser.step()
        self.progress.updates += 1
        self.progress.windows += self.options.batch * self.options.unroll
        # Early on the average must not remember the random start.
        decay = min(AVERAGE_DECAY, self.progress.updates / (self.progress.updates + 10))
        with torch.no_grad():
            for mean, value in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(value, 1 - decay)

    def save(self, folder: Path) -> None:
        """Write checkpoint.pt and reconstruction.onnx; each is complete at any time."""
        state = {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "progress": vars(self.progress),
        }
        torch.save(state, folder / "checkpoint.new")
        (folder / "checkpoint.new").replace(folder / "checkpoint.pt")
        export_onnx(self.average, folder / "reconstruction.new")
        (folder / "reconstruction.new").replace(folder / "reconstruction.onnx")

    def restore(self, folder: Path) -> None:
        """Go on from checkpoint.pt."""
        state = torch.load(folder / "checkpoint.pt", map_location=self.device, weights_only=True)
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.progress = Progress(**state["progress"])


def parse_options(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of checkpoint.pt and reconstruction.onnx"
    )
    parser.add_argument("--minutes", type=float, default=120.0, help="training time, counted over all runs")
    parser.add_argument("--updates", type=int, default=0, help="number of updates, in place of --minutes")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint in --out")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--batch", type=int, default=6, help="scenes at a time; 128 fills a GPU")
    parser.add_argument(
        "--crop-px", type=int, default=80, help="side of the simulated pictures, multiple of 4"
    )
    parser.add_argument("--unroll", type=int, default=8, help="windows gradients run back through")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> None:
    """Train until the budget is spent, saving once a minute."""
    options = parse_options(arguments)
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(options)
    if options.resume:
        trainer.restore(options.out)
    saved, smooth = time.monotonic(), None
    while trainer.spent() < 1:
        loss = trainer.learn_scenes()
        smooth = loss if smooth is None else 0.98 * smooth + 0.02 * loss
        if time.monotonic() - saved > SAVE_EVERY_S:
            saved = time.monotonic()
            trainer.save(options.out)
            progress = trainer.progress
            print(
                f"{progress.elapsed_s / 60:6.1f} min  {progress.updates:6d} updates"
                f"  {progress.windows:8d} windows  loss {smooth:.4f}",
                flush=True,
            )
    trainer.save(options.out)


if __name__ == "__main__":
    main()
