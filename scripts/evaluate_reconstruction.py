#!/usr/bin/env python
"""Judge a reconstruction network on held-out simulated checkerboards: found, and corners against truth.

    python scripts/evaluate_reconstruction.py [--model build/training/reconstruction.onnx] [--scenes 40]

The scenes' seeds lie outside those of training. A board is judged where all its inner corners lie in the
picture; events pass through the same ONNX file and the same 8-bit scaling as in the package.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
import torch
from training.event_simulation import EventStream
from training.textures import TEXTURE_PX, draw_checkerboard

from lce_rig.detect.events.reconstructor import SHIPPED_NETWORK, IntensityScale, ReconstructionModel

HELD_OUT_SEED = 2_000_000_000
SIZE_PX = 192
N_WARM_UP = 12
COLS, ROWS = 7, 6  # squares
MARGIN_PX = 6.0
WRONG_GRID_PX = 5.0  # beyond, the finder detected corners that are not the board's


class BoardScene:
    """One moving checkerboard and the true positions of its inner corners."""

    def __init__(self, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        # Even squares put every edge on a border between texels: the truth is exact.
        self.square = 14 + 2 * int(torch.randint(0, 5, (), generator=generator))
        texture, cover = draw_checkerboard(generator, COLS, ROWS, self.square)
        fronts = torch.stack([texture, cover])[None]
        self.stream = EventStream(1, SIZE_PX, seed, torch.device("cpu"), fronts)

    def corners_px(self) -> np.ndarray:
        """Project the inner corners into the last window's image, ((COLS - 1) (ROWS - 1), 2)."""
        x = (np.arange(1, COLS) - COLS / 2) * self.square
        y = (np.arange(1, ROWS) - ROWS / 2) * self.square
        texels = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2) * 2 / TEXTURE_PX
        texture_of_pixel = self.stream.scenes.front.homography(self.stream.path)[0].double().numpy()
        pixel_of_texture = np.linalg.inv(texture_of_pixel)
        points = np.column_stack([texels, np.ones(len(texels))]) @ pixel_of_texture.T
        return points[:, :2] / points[:, 2:] + (SIZE_PX - 1) / 2


def corner_error_px(grey: np.ndarray, truth_px: np.ndarray) -> float | None:
    """Detect the board and return the rms error of its corners; None if it is not detected."""
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(grey, (COLS - 1, ROWS - 1), flags=flags)
    if not found:
        return None
    corners = corners.reshape(-1, 2)
    orders = (truth_px, truth_px[::-1])
    return float(min(np.sqrt(np.square(corners - order).sum(1).mean()) for order in orders))


def judge_scene(model: ReconstructionModel, seed: int, n_windows: int, every: int) -> list[dict[str, float]]:
    """Run one scene and judge every few windows after the warm-up."""
    scene, scale = BoardScene(seed), IntensityScale()
    states = model.initial_states(SIZE_PX, SIZE_PX)
    results = []
    for index in range(n_windows):
        voxels, target, _ = scene.stream.window()
        picture, states = model.step(voxels[0].numpy(), states)
        scale.follow(picture)
        if index < N_WARM_UP or index % every:
            continue
        truth = scene.corners_px()
        if truth.min() < MARGIN_PX or truth.max() > SIZE_PX - 1 - MARGIN_PX:
            continue
        ideal = (target[0, 0].numpy().clip(0, 1) * 255).astype(np.uint8)
        ideal_error = corner_error_px(ideal, truth)
        if ideal_error is None:
            continue  # too oblique or too small even for a perfect image
        error = corner_error_px(scale.to_grey(picture), truth)
        rate = float((voxels != 0).float().amax(1).mean())
        results.append(
            {"error_px": np.nan if error is None else error, "ideal_px": ideal_error, "rate": rate}
        )
    return results


def main(arguments: list[str] | None = None) -> None:
    """Print the figures as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--model", type=Path, default=SHIPPED_NETWORK, help="ONNX file; left out: the shipped one"
    )
    parser.add_argument("--scenes", type=int, default=40)
    parser.add_argument("--windows", type=int, default=60)
    parser.add_argument("--every", type=int, default=8, help="judge every so many windows")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    model = ReconstructionModel(options.model)
    judged = [
        result
        for scene in range(options.scenes)
        for result in judge_scene(model, HELD_OUT_SEED + scene, options.windows, options.every)
    ]
    errors = np.array([result["error_px"] for result in judged])
    ideal = np.array([result["ideal_px"] for result in judged])
    found = errors < WRONG_GRID_PX
    figures = {
        "pictures": len(judged),
        "found_share": float(found.mean()),
        "wrong_grid_share": float(np.mean(errors >= WRONG_GRID_PX)),
        "corner_rms_px": float(np.sqrt(np.mean(errors[found] ** 2))),
        "corner_median_px": float(np.median(errors[found])),
        "share_below_0.5_px": float(np.mean(errors[found] < 0.5)),
        "ideal_picture_rms_px": float(np.sqrt(np.mean(ideal**2))),
    }
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
