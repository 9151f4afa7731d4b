"""`lce-rig drift`: compare deployed extrinsics with the edges of a scene; the exit code is the outcome."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from lce_rig.cli import show
from lce_rig.cli.options import FiniteRange, explain_option, json_option, path_option
from lce_rig.core.calibration import ResultFile, State, read_result
from lce_rig.core.errors import LceRigError, NotEnoughDataError, ResultRefusedError, UsageError
from lce_rig.core.interrupts import patience
from lce_rig.core.phrasing import as_line
from lce_rig.devices import open_live
from lce_rig.pipeline.pair_drift import DriftReport, PairDrift
from lce_rig.pipeline.verification import profile_behind
from lce_rig.pipeline.watch_drift import drift as watch_drift
from lce_rig.pipeline.watch_drift import drift_live
from lce_rig.rig import Rig, load_rig
from lce_rig.scene.findings import STATES
from lce_rig.show.screen.keys import controls


@click.command()
@click.argument("recordings", nargs=-1, type=click.Path(path_type=Path), metavar="[RECORDING]...")
@path_option("--result", "FILE", "Check this result.json [default: that of the session].")
@click.option(
    "--rig",
    "rig_name",
    metavar="NAME|FILE",
    help="Set the rig profile of recordings or of attached sensors; a session has its own.",
)
@click.option(
    "--seconds",
    type=FiniteRange(1, 86400),
    metavar="S",
    help="Watch attached sensors for S seconds [default: until Ctrl-C].",
)
@path_option("-o", "--output", "FOLDER", "Write images into this folder.")
@explain_option
@json_option
def drift(
    recordings: tuple[Path, ...],
    result: Path | None,
    rig_name: str | None,
    seconds: float | None,
    output: Path | None,
    explain: bool,
    as_json: bool,
) -> None:
    """Check on RECORDING (default: session/), without a board, whether extrinsics still hold.

    RECORDING is a session or, with --rig, a folder of images and point clouds, a bag, an mcap, or several
    simultaneous recordings. With --rig and no RECORDING, the attached sensors are watched until Ctrl-C. Edges
    of the scans are compared with edges of the images, and with the board if it is in view. Exits with 0 if
    the extrinsics hold, with 7 if they changed, and with 6 if scene and board are inconclusive.
    """
    is_live = rig_name is not None and not recordings
    if seconds is not None and not is_live:
        raise UsageError("--seconds applies to attached sensors only", "Omit it, or give --rig alone.")
    if is_live and result is None:
        raise UsageError("attached sensors have no result", "Name one with --result FILE.")
    saved = None if result is None else read_result(result)
    rig = None if rig_name is None else load_rig(rig_name)
    if is_live:
        assert rig is not None and saved is not None
        report = _watch_live(rig, saved, seconds)
    else:
        sources = recordings or (Path("session"),)
        with show.progress_bar("reading") as progress:
            profile = None if result is None or saved is None else profile_behind(result, saved)
            report = watch_drift(sources, saved, rig=rig, profile=profile, progress=progress)
    for text in report.notes:
        show.note(text)
    files = [] if output is None else report.write(output)
    pairs = [pair.document() for pair in report.pairs]
    document = {"format_version": 1, "rig": report.rig.name, "pairs": pairs}
    if as_json:
        show.print_json(document)
    else:
        for pair in report.pairs:
            show.print_parts(_parts(pair))
        if explain:
            show.print_figures(document)
        for file in files:
            show.say(f"image: {file}")
    outcomes: dict[State, type[LceRigError]] = {"changed": ResultRefusedError, "unknown": NotEnoughDataError}
    for state, error in outcomes.items():
        concerned = [pair for pair in report.pairs if pair.state == state]
        if concerned:
            names = ", ".join(map(_sensors, concerned))
            raise error(f"{STATES[state]}: {names}", as_line(concerned[0].advice) if as_json else "")


# Time limit of the judgement after Ctrl-C, s; a second Ctrl-C ends it.
_JUDGING_S = 120.0


def _watch_live(rig: Rig, saved: ResultFile, seconds: float | None) -> DriftReport:
    """Watch attached sensors until the time is over, or a signal or q asks to stop."""
    with show.progress_bar("watching, seconds") as progress, controls() as asked, patience(_JUDGING_S):
        began_s: list[float] = []

        def is_over(n_scans: int) -> bool:
            if not began_s:
                began_s.append(time.monotonic())
                if seconds is None:
                    show.note("watching; Ctrl-C ends and judges what was seen")
            elapsed_s = time.monotonic() - began_s[0]
            progress(int(elapsed_s), int(seconds or elapsed_s))
            return asked() == "stop" or (seconds is not None and elapsed_s >= seconds)

        return drift_live(rig, saved, open_live(rig), is_over=is_over)


_COLOURS: dict[State, str] = {"unchanged": "green", "changed": "red", "unknown": "yellow"}


def _sensors(pair: PairDrift) -> str:
    return f"{pair.calibration.camera}, {pair.calibration.lidar}"


def _parts(pair: PairDrift) -> Iterator[Any]:
    """State the verdict, the answers from the scene and from the boards, and one action."""
    data = f"{show.counted(pair.drift.n_captures, 'capture')}, {pair.drift.estimate.n_edges} edges"
    yield f"[bold]{_sensors(pair)}[/]: [{_COLOURS[pair.state]}]{STATES[pair.state]}[/] ({data})"
    for finding in (*pair.contradictions, *pair.drift.findings):
        yield f"  {show.escape(as_line(finding.text))}"
    if pair.board is not None:
        opinion = f"{show.counted(pair.board.n_boards, 'board')}: {STATES[pair.board.state]}"
        # The first finding; unobservable directions come last.
        yield f"  {show.escape(as_line(f'{opinion}; {pair.board.findings[0].text}'))}"
    if pair.advice:
        yield f"  -> {show.escape(as_line(pair.advice))}"
