"""`lce-rig reconstruct`: reconstruct images from an event recording."""

from itertools import takewhile
from pathlib import Path
from typing import Any

import click

from lce_rig.cli import show
from lce_rig.cli.options import FiniteRange, path_option
from lce_rig.core.data import join_events
from lce_rig.core.errors import SourceError, UsageError
from lce_rig.core.findings import Refusal
from lce_rig.core.phrasing import significant
from lce_rig.detect.events.reconstructor import Reconstructor
from lce_rig.detect.events.windows import is_flickering
from lce_rig.detect.findings import IMAGE_FLICKER
from lce_rig.io.events import open_events
from lce_rig.io.events.event_recording import EventRecording
from lce_rig.show.overlays.canvas import write_picture

STAMPS = "stamps.csv"
# Maximum number of images: 14 hours at the default period; a wrong timestamp can make a recording centuries
# long.
_MAX_IMAGES = 1_000_000
# Time for the network to settle before the first requested image, ns.
_WARM_UP_NS = 1_500_000_000
# Length of the recording's start in which flicker is measured, ns.
_FIRST_NS = 1_000_000_000


@click.command()
@click.argument("recording", type=click.Path(path_type=Path))
@path_option("-o", "--output", "FOLDER", "Write the images into this folder.", required=True)
@click.option(
    "--every",
    default=0.05,
    show_default=True,
    type=FiniteRange(0.001),
    metavar="S",
    help="Set the period of the images.",
)
@click.option(
    "--start", default=0.0, type=FiniteRange(0), metavar="S", help="Begin S seconds after the first event."
)
@click.option("--duration", type=FiniteRange(0.001), metavar="S", help="End S seconds after the beginning.")
@click.option("--topic", metavar="/TOPIC", help="Choose the topic if a bag has several with events.")
def reconstruct(
    recording: Path,
    output: Path,
    every: float,
    start: float,
    duration: float | None,
    topic: str | None,
) -> None:
    """Reconstruct grey images from the events of RECORDING into FOLDER, with timestamps in stamps.csv.

    Reads AEDAT4, Prophesee RAW (EVT3), ROS 1, ROS 2 and mcap bags, and HDF5 (DSEC, Metavision). Skips the
    first images, until the network has settled, and prints how many.
    """
    reconstructor = Reconstructor()
    events = open_events(recording, topic=topic)
    start_ns = events.start_ns
    first = list(takewhile(lambda part: part.t_ns[0] < start_ns + _FIRST_NS, events))
    if is_flickering(join_events(first).between(start_ns, start_ns + _FIRST_NS)):
        show.warn(f"{recording.name}: {IMAGE_FLICKER.refusal().sentence}")
    stamps_ns = _stamps(recording, events, start, duration, every)
    files, refused = _write(output, reconstructor, events, stamps_ns)
    for text in events.notes:
        show.note(text)
    if refused:
        show.note(f"{len(refused)} images skipped, the first because: {refused[0]}")
    if not files:
        raise SourceError(
            f"{recording}: no image reconstructed", "Record longer: the network needs time to settle."
        )
    show.note(f"{len(files)} images in {output}, timestamps in {output / STAMPS}")


def _stamps(
    recording: Path, events: EventRecording, start_s: float, duration_s: float | None, every_s: float
) -> range:
    """List the timestamps of the requested images.

    Raises:
        UsageError: all are after the recording's end, or there are more than a million.
    """
    first_ns, last_ns = events.span_ns
    begin_ns, every_ns = first_ns + round(1e9 * start_s), round(1e9 * every_s)
    end_ns = last_ns if duration_s is None else min(last_ns, begin_ns + round(1e9 * duration_s))
    if begin_ns >= last_ns:
        raise UsageError(
            f"--start {start_s:g}: {recording} ends {1e-9 * (last_ns - first_ns):.3f} s after its first event"
        )
    wanted = range(begin_ns + every_ns, max(end_ns, begin_ns + every_ns) + 1, every_ns)
    n_wanted = (wanted.stop - wanted.start - 1) // every_ns + 1
    if n_wanted > _MAX_IMAGES:
        raise UsageError(
            f"{recording} lasts {significant(1e-9 * (last_ns - first_ns), 3)} s: "
            f"{significant(n_wanted, 3)} images, maximum {_MAX_IMAGES}. Set --duration or a longer --every."
        )
    return wanted


def _write(
    output: Path, reconstructor: Any, events: EventRecording, stamps_ns: range
) -> tuple[list[Path], list[str]]:
    """Write the images and their timestamps; return the files, and the causes of skipped images."""
    lines = ["picture,stamp_ns"]
    files: list[Path] = []
    refused: list[str] = []
    # Part of the recording needed for the images.
    from_ns, until_ns = stamps_ns[0] - stamps_ns.step - _WARM_UP_NS, stamps_ns[-1] + 1
    needed = takewhile(lambda stretch: stretch.t_ns[0] <= until_ns, events)
    stretches = (stretch.between(from_ns, until_ns) for stretch in needed)
    pictures = reconstructor.reconstruct(stretches, stamps_ns)
    with show.progress_bar("reconstructing") as progress:
        for done, picture in enumerate(pictures, start=1):
            if isinstance(picture, Refusal):
                refused.append(picture.text)
            else:
                files.append(write_picture(output / f"{len(files):06d}.png", picture.pixels))
                lines.append(f"{files[-1].name},{picture.stamp_ns}")
            progress(done, len(stamps_ns))
    if files:
        (output / STAMPS).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return files, refused
