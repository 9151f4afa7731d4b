"""`lce-rig reconstruct`: pictures from an event recording."""

from pathlib import Path
from typing import Any

import click

from lce_rig.cli import show
from lce_rig.cli.options import FiniteRange

STAMPS = "stamps.csv"


@click.command()
@click.argument("recording", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="For the pictures.",
)
@click.option(
    "--every",
    default=0.05,
    show_default=True,
    type=FiniteRange(0.001),
    metavar="S",
    help="One picture every so many seconds.",
)
@click.option("--topic", metavar="/TOPIC", help="Events topic of a bag with several.")
@click.option(
    "--window-s",
    type=FiniteRange(0.001, 10),
    metavar="S",
    help="Windows of this duration (the paper: 0.05).",
)
@click.option("--window-events", type=click.IntRange(1), metavar="N", help="Windows of so many events.")
@click.option(
    "--event-image",
    type=click.Choice(["network", "map"]),
    default="network",
    show_default=True,
    help="Recurrent network, or sums of polarities, the alternative that the paper rejects.",
)
@click.option(
    "--model",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="ONNX file in place of the shipped network.",
)
@click.option("--no-filter", is_flag=True, help="Keep hot pixels and background activity.")
def reconstruct(
    recording: Path,
    output: Path,
    every: float,
    topic: str | None,
    window_s: float | None,
    window_events: int | None,
    event_image: Any,
    model: Path | None,
    no_filter: bool,
) -> None:
    """Turn the events of RECORDING into grey pictures in FOLDER, with their stamps in stamps.csv.

    Reads AEDAT4, Prophesee RAW (EVT2, EVT3), ROS 1, ROS 2 and mcap bags, HDF5 as DSEC lays it out, npz and
    the text of E2VID.
    The first pictures, from before the network has seen enough, are left out, and their number is told.
    """
    from lce_rig.core.errors import SourceError, UsageError
    from lce_rig.core.results import Refusal
    from lce_rig.detect.flicker import measure_flicker
    from lce_rig.detect.reconstruct import ReconstructionOptions, Reconstructor, WindowOptions
    from lce_rig.sources.events import open_events
    from lce_rig.verify.writing import write_picture

    if window_s is not None and window_events is not None:
        raise UsageError("--window-s and --window-events exclude each other")
    windows = WindowOptions()
    if window_s is not None:
        windows = WindowOptions("time", duration_s=window_s)
    elif window_events is not None:
        windows = WindowOptions("count", n_events=window_events)
    options = ReconstructionOptions(method=event_image, windows=windows, is_filtered=not no_filter)
    events = open_events(recording, topic=topic)
    flicker = measure_flicker(events.read(events.start_ns, events.start_ns + 1_000_000_000))
    if flicker.is_storm:
        show.warn(
            f"{recording.name}: most events come from light that flickers at {flicker.frequency_hz:.0f} Hz: "
            "record by daylight or under lamps that do not flicker"
        )
    every_ns = round(every * 1e9)
    n_expected = max(1, int(events.duration_s * 1e9) // every_ns)
    lines = ["picture,stamp_ns"]
    refused: list[Refusal] = []
    pictures = Reconstructor(model, options).reconstruct(events, every_ns=every_ns)
    with show.progress_bar("reconstructing") as progress:
        for done, picture in enumerate(pictures, start=1):
            if isinstance(picture, Refusal):
                refused.append(picture)
            else:
                name = f"{len(lines) - 1:06d}.png"
                write_picture(output / name, picture.pixels)
                lines.append(f"{name},{picture.stamp_ns}")
            progress(done, n_expected)
    for text in events.notes:
        show.note(text)
    if refused:
        show.note(f"{len(refused)} pictures left out: {refused[0].cause}")
    if len(lines) == 1:
        raise SourceError(
            f"{recording}: no picture could be made", "It is too short for the network to warm up."
        )
    (output / STAMPS).write_text("\n".join(lines) + "\n", encoding="utf-8")
    show.note(f"{len(lines) - 1} pictures in {output}, stamps in {output / STAMPS}")
