"""`lce-rig simulate`: simulate a session or a recording of a rig, with exact truth."""

import json
import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import click

from lce_rig.cli import show
from lce_rig.cli.options import FiniteRange, path_option, rig_option
from lce_rig.core.errors import SessionError, SourceError, UsageError
from lce_rig.core.files import read_json
from lce_rig.io.ros.bag_recorder import BagRecorder
from lce_rig.rig import Rig, find_profile, load_rig, read_profile
from lce_rig.session import Session
from lce_rig.simulate import (
    SimulationOptions,
    capture_truth,
    recording_truth,
    rig_truth,
    simulate_captures,
    simulate_recording,
)
from lce_rig.simulate.sampling import stamp_of

TRUTH = "truth.json"
# Default size of a session, placements, and of a recording, s; either simulates in a few minutes.
_CAPTURES, _DURATION_S = 30, 20.0
# Time to simulate 1 s of a recording, s.
_WALL_PER_S = 10


@click.command()
@rig_option
@click.argument("session", type=click.Path(path_type=Path), required=False)
@click.option(
    "--captures",
    type=click.IntRange(1, 10_000),
    help=f"Set the number of board placements [default: {_CAPTURES}].",
)
@path_option(
    "--recording",
    "FOLDER",
    "Write a recording instead of a session: recording.bag with images, scans and events.",
)
@click.option(
    "--duration",
    type=FiniteRange(0.1, 3600),
    metavar="S",
    help=f"Set the recording's duration [default: {_DURATION_S:g}]; simulating 1 s takes about 10 s.",
)
@click.option(
    "--seed",
    default=0,
    show_default=True,
    type=click.IntRange(0),
    help="Set the seed; the same seed gives the same bytes.",
)
@click.option(
    "--mounting",
    type=click.IntRange(0),
    metavar="SEED",
    help="Mount the sensors as the session with this seed does; placements and noise follow from --seed "
    "[default: the same seed].",
)
@click.option(
    "--motion",
    type=click.Choice(["still", "moving"]),
    help="Hold the board still, or move it by hand. Only a moving board gives events "
    "[default: still; moving for rigs without frames].",
)
def simulate(
    rig_name: str,
    session: Path | None,
    captures: int | None,
    recording: Path | None,
    duration: float | None,
    seed: int,
    mounting: int | None,
    motion: Literal["still", "moving"] | None,
) -> None:
    """Simulate SESSION (default: session/) of a rig: images, scans and exact truth.

    With `--motion moving`, captures also hold the raw events around them. With `--recording FOLDER`, write
    files for `lce-rig collect`, `lce-rig reconstruct` and other programs instead.

    The truth is written to truth.json; pass SESSION/truth.json to `lce-rig calibrate --reference`.
    """
    rig = load_rig(rig_name)
    drawn = {entry.camera for entry in rig.nominal_extrinsics}
    for name in rig.cameras:
        if len(rig.cameras) > 1 and name not in drawn:
            show.warn(
                f"the profile has no nominal extrinsics of {name}: simulated at the first LiDAR's origin, "
                "looking along its x axis; it may see few of the boards"
            )
    if recording is None:
        if duration is not None:
            raise UsageError("--duration applies to recordings only", "Add --recording FOLDER.")
        kinds = {channel.kind for camera in rig.cameras.values() for channel in camera.channels.values()}
        usual: Literal["still", "moving"] = "moving" if kinds == {"events"} else "still"
        options = replace(SimulationOptions.for_rig(rig.name, motion or usual), mounting_seed=mounting)
        path = session or Path("session")
        _simulate_session(path, rig, captures or _CAPTURES, seed, options)
        Session.open(path).keep_text(read_profile(find_profile(rig_name)))
        return
    if session is not None or captures is not None:
        other = f"the session {session}" if session is not None else "--captures"
        raise UsageError(f"--recording and {other} exclude each other", "Run it twice, with the same --seed.")
    if motion == "still":
        raise UsageError("--motion still: the board moves in a recording", "Omit --motion, or --recording.")
    options = replace(SimulationOptions.for_rig(rig.name, "moving"), mounting_seed=mounting)
    _simulate_recording(recording, rig, rig_name, duration or _DURATION_S, seed, options)


def _simulate_session(path: Path, rig: Rig, n_captures: int, seed: int, options: SimulationOptions) -> None:
    if path.exists():
        raise SessionError(
            f"{path} exists already", "Choose another folder; a simulation is never continued."
        )
    with Session.create(path, rig) as writer, show.progress_bar("simulating") as progress:
        truth = rig_truth(rig, seed, options) | {"captures": {}}
        try:
            for done, capture in enumerate(
                simulate_captures(rig, n_captures=n_captures, seed=seed, options=options), 1
            ):
                source = {"source": f"simulated, seed {seed}"}
                name = writer.add_capture(capture.images, capture.scans, source, capture.events)
                truth["captures"][name] = capture_truth(rig, capture, options)
                progress(done, n_captures)
        finally:  # an interrupted session has the truth of its captures, too
            write_truth(path / TRUTH, truth)
    following = show.command("check", path)
    show.note(f"{path}: {n_captures} simulated captures of rig {rig.name}; next: {following}")


def _simulate_recording(
    folder: Path, rig: Rig, profile: str, duration_s: float, seed: int, options: SimulationOptions
) -> None:
    if folder.exists():
        hint = "Name another folder: recordings are never overwritten."
        raise SourceError(f"{folder} exists already", hint)
    show.note(f"simulating {duration_s:g} s of rig {rig.name}, about {_WALL_PER_S * duration_s:.0f} s ...")
    recording = simulate_recording(rig, duration_s=duration_s, seed=seed, options=options)
    # Only a complete recording gets the folder's name.
    with _beside(folder) as draft, show.progress_bar("simulating, ms") as progress:
        with BagRecorder.in_folder(draft, rig) as recorder:
            write_truth(draft / TRUTH, rig_truth(rig, seed, options) | recording_truth(recording))
            for sample in recording:
                recorder.write(sample)
                progress(max(0, stamp_of(sample) - recording.start_ns) // 10**6, round(1000 * duration_s))
        draft.rename(folder)
    names = ", ".join(sorted(path.name for path in folder.iterdir()))
    show.note(f"{folder}: {duration_s:g} s of rig {rig.name}: {names}")
    bag = shlex.quote(str(folder / recorder.path.name))
    show.note(f"next: lce-rig collect --rig {shlex.quote(profile)} --from {bag}")


@contextmanager
def _beside(folder: Path) -> Iterator[Path]:
    """Yield a temporary path on the folder's disk, removed at the end unless renamed.

    Raises:
        SourceError: nothing can be written there.
    """
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        hidden = TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent)
    except OSError as error:
        hint = "Choose another folder."
        raise SourceError(f"{folder} cannot be written: {error.strerror}", hint) from error
    with hidden as place:
        yield Path(place) / folder.name


def require_kind(session: Path, seed: int | None) -> None:
    """Refuse to mix simulated captures with real ones or with another simulation's.

    Args:
        session: the session that gets captures; may not exist yet.
        seed: the simulation's; None for real captures.

    Raises:
        SessionError: the session holds captures of another kind.
    """
    truth = session / TRUTH
    hint = "Collect into another folder."
    if not truth.exists():
        if seed is not None and any((session / "captures").glob("[0-9]*")):
            raise SessionError(f"{session} holds captures of real sensors", hint)
        return
    if seed is None:
        raise SessionError(f"{session} is a simulated session ({TRUTH} is in it)", hint)
    try:
        held = read_json(truth).get("seed")
    except (OSError, ValueError, AttributeError) as error:
        raise SessionError(f"{truth} is damaged", hint) from error
    if held != seed:
        raise SessionError(f"{session} was simulated with seed {held}, not {seed}", f"Add --seed {held}.")


def write_truth(path: Path, document: dict[str, Any]) -> None:
    """Write indented JSON with each innermost list, such as a matrix row, on one line."""
    text = json.dumps(document, indent=1)
    text = re.sub(r"\[([^\[\]{}\"]+)\]", lambda match: f"[{' '.join(match[1].split())}]", text)
    path.write_text(text + "\n", encoding="utf-8")
