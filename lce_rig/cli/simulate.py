"""`lce-rig simulate`: a session of a simulated rig, with exact truth beside it."""

import json
from pathlib import Path
from typing import Any

import click

from lce_rig.cli import show
from lce_rig.cli.options import FiniteRange

TRUTH = "truth.json"


@click.command()
@click.option(
    "--rig", "rig_name", required=True, metavar="NAME|FILE", help="Rig profile: a shipped name or a file."
)
@click.argument("session", type=click.Path(path_type=Path), default="session")
@click.option(
    "--captures", default=30, show_default=True, type=click.IntRange(1, 10_000), help="Board placements."
)
@click.option(
    "--seed", default=0, show_default=True, type=click.IntRange(0), help="The same seed, the same bytes."
)
@click.option(
    "--carrier",
    type=click.Choice(["stand", "person", "none"]),
    help="What holds the board [default: a person for rigs called rles..., nobody for sss..., else a stand].",
)
@click.option(
    "--noise-level",
    type=click.IntRange(1, 10),
    help="Range noise of the paper's simulated sets: levels 1 (none) to 10 (10 cm).",
)
@click.option("--range-sigma", type=FiniteRange(0, 1), metavar="M", help="Range noise of the LiDAR.")
@click.option("--range-offset", type=FiniteRange(-1, 1), metavar="M", help="Constant offset of all ranges.")
@click.option("--decoy", is_flag=True, help="Stand a blank plate of the board's size in the room.")
def simulate(
    rig_name: str,
    session: Path,
    captures: int,
    seed: int,
    carrier: Any,
    noise_level: int | None,
    range_sigma: float | None,
    range_offset: float | None,
    decoy: bool,
) -> None:
    """Make SESSION (default: session/) with a simulated rig: pictures, scans and exact truth.

    The truth stands in SESSION/truth.json and goes to `lce-rig calibrate --reference`.
    """
    from dataclasses import replace

    from lce_rig.core.errors import SessionError
    from lce_rig.rig import load_rig
    from lce_rig.session import Session
    from lce_rig.simulate import SimulationOptions, simulate_captures, truth_extrinsics

    rig = load_rig(rig_name)
    if session.exists():
        raise SessionError(
            f"{session} exists already", "Name another folder: a simulation is never continued."
        )
    options = SimulationOptions.for_rig(rig.name)
    lidar_noise = options.lidar
    if range_sigma is not None:
        lidar_noise = replace(lidar_noise, range_sigma_m=range_sigma)
    if range_offset is not None:
        lidar_noise = replace(lidar_noise, range_offset_m=range_offset)
    options = replace(
        options,
        lidar=lidar_noise,
        noise_level=noise_level,
        has_decoy_plate=decoy,
        carrier=carrier or options.carrier,
    )
    with Session.create(session, rig) as writer, show.progress_bar("simulating") as progress:
        truth = truth_extrinsics(rig, seed, options)
        _write_truth(session / TRUTH, truth, seed)
        for done, capture in enumerate(
            simulate_captures(rig, n_captures=captures, seed=seed, options=options), 1
        ):
            writer.add_capture(capture.images, capture.scans, {"source": f"simulated, seed {seed}"})
            progress(done, captures)
    show.note(f"{session}: {captures} simulated captures of rig {rig.name}; truth in {session / TRUTH}")


def _write_truth(path: Path, truth: dict[tuple[str, str], Any], seed: int) -> None:
    pairs = [
        {"camera": camera, "lidar": lidar, "T_cam_lidar": T.tolist()}
        for (camera, lidar), T in sorted(truth.items())
    ]
    document = {"seed": seed, "T_cam_lidar": pairs[0]["T_cam_lidar"], "pairs": pairs}
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
