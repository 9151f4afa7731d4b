"""`lce-rig collect` without --from: attached sensors, or the simulated rig."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lce_rig.cli import show
from lce_rig.cli.simulate import TRUTH, require_kind, write_truth
from lce_rig.collect.live.collection import collect_live
from lce_rig.collect.live.simulated import SimulatedRig
from lce_rig.collect.live.state import HOLD_S, Key, LiveOptions, LiveReport, LiveState, TakeBack
from lce_rig.core.errors import LceRigError, NotEnoughDataError, UsageError
from lce_rig.core.findings import Finding
from lce_rig.devices import open_live
from lce_rig.rig import Rig
from lce_rig.session import Session, discard_if_empty
from lce_rig.show.screen.keys import Controls, controls
from lce_rig.show.screen.live_view import open_view, qr_lines
from lce_rig.simulate import SimulationOptions, rig_truth

if TYPE_CHECKING:
    from lce_rig.show.phone.preview import Preview

#: An unattended run ends after this time without a capture. The simulated person never rests; a person at a
#: rig without a terminal may be away for a while.
SIMULATED_IDLE_S, UNATTENDED_IDLE_S = 600.0, 1800.0
_ENDINGS = {
    "enough": "the target is predicted to be met",
    "frames": "the number of captures is reached",
    "timeout": "the time limit is reached",
    "exhausted": "no new placement",
    "stopped": "stopped",
    "lost": "a sensor was lost",
}


def run_live(
    rig: Rig,
    path: Path,
    n_wanted: int | None,
    *,
    timeout: float | None,
    keep_going: bool,
    hold: float | None,
    plain: bool,
    preview: str | None,
    record: Path | None,
    simulated: bool,
    seed: int | None,
) -> None:
    """Collect live into a session and report the outcome; the options are those of --help."""
    if seed is not None and not simulated:
        raise UsageError("--seed applies to --simulated only", "Add --simulated, or omit --seed.")
    require_kind(path, (seed or 0) if simulated else None)
    with ExitStack() as stack:
        # Open the page first: an invalid address fails before anything is created or started.
        page = None if preview is None else _open_page(stack, preview)
        session = stack.enter_context(_session(path, rig))
        n_before = len(session.captures)
        person = None
        if simulated:
            show.note("starting the simulated rig ...")
            if any(camera.first_channel("events") for camera in rig.cameras.values()):
                recorded = f"`lce-rig simulate --rig {rig.name} --recording FOLDER` writes them"
                show.note(f"events are not simulated live: {recorded}")
            person = stack.enter_context(SimulatedRig(rig, seed or 0))
            write_truth(path / TRUTH, rig_truth(rig, seed or 0, SimulationOptions.for_rig(rig.name)))
        sources = open_live(rig) if person is None else person.sources
        asked = stack.enter_context(controls())
        idle_s = SIMULATED_IDLE_S if simulated else None if asked.is_interactive else UNATTENDED_IDLE_S
        hold_s = HOLD_S if hold is None else hold
        options = LiveOptions(n_wanted, timeout, hold_s, goes_on=keep_going, idle_s=idle_s)
        with open_view(
            is_plain=plain,
            has_keys=asked.is_interactive,
            links=() if page is None else page.urls,
            wants_code=lambda: asked.wants_code,
        ) as view:
            listeners = [_until_gone(view.show)]
            listeners += [] if page is None else [page.publish]
            listeners += [] if person is None else [person.watch]
            is_begun = threading.Event()

            def tell(state: LiveState) -> None:
                is_begun.set()
                for listener in listeners:
                    listener(state)

            def ask() -> Key | TakeBack | None:
                return asked() or (None if page is None else page.asked())

            try:
                report = collect_live(session, sources, options, tell, ask, record)
            finally:
                n_captures = len(session.captures)
                if n_captures or is_begun.is_set():
                    saved = f"{path}: {show.counted(n_captures, 'capture')} ({n_captures - n_before} new)"
                    stack.callback(show.note, saved)
    if report.n_recorded is not None:
        show.note(f"{record}: {report.n_recorded} samples recorded")
    _tell(report, n_captures, asked, person, n_wanted)
    if report.ending == "enough":
        show.note(f"  more         {_more(path)} --keep-going")
    show_next(path, rig, report.predicted, n_captures)


def _until_gone(show_state: Callable[[LiveState], None]) -> Callable[[LiveState], None]:
    """Show states until the terminal closes; its hangup then ends the collection cleanly."""
    is_gone = threading.Event()

    def tell(state: LiveState) -> None:
        if not is_gone.is_set():
            try:
                show_state(state)
            except OSError:
                is_gone.set()

    return tell


@contextmanager
def _session(path: Path, rig: Rig) -> Iterator[Session]:
    """Continue or start a session; delete a new session that stays empty because its rig does not respond."""
    is_new = not path.exists()
    try:
        with Session.resume(path, rig) as session:
            yield session
    except LceRigError:
        if is_new:
            discard_if_empty(path)
        raise


def _open_page(stack: ExitStack, address: str) -> "Preview":
    """Serve the preview page and print its link."""
    from lce_rig.show.phone.preview import Preview, parse_address  # aiohttp takes 0.2 s to import

    page = Preview(*parse_address(address))

    def tell_failure() -> None:
        if page.failure:
            show.note(f"preview: the page has ended: {page.failure}")

    stack.callback(tell_failure)
    stack.enter_context(page)
    for url in page.urls:
        show.note(f"preview: {url}")
    if sys.stderr.isatty():
        for line in qr_lines(page.urls[0]):
            click.secho(line, fg="bright_white", bg="black", err=True)
    return page


def _tell(
    report: LiveReport,
    n_captures: int,
    asked: Controls,
    simulated: SimulatedRig | None,
    n_wanted: int | None,
) -> None:
    """Report the outcome.

    Raises:
        SourceError: a sensor was lost permanently; the captures are kept.
        LceRigError: the recording ended early, for example on a full disk; the captures are kept.
        NotEnoughDataError: there are no captures, or too few when the new placements are exhausted.
    """
    for text in report.notes:
        show.note(text)
    lost = {name: n for name, n in report.n_lost.items() if n}
    if lost:
        show.note("dropped: " + ", ".join(f"{name} {n}" for name, n in sorted(lost.items())))
    ending = _ENDINGS[report.ending]
    if report.ending == "enough" and not report.predicted:
        ending = "enough placements"
    if report.ending == "exhausted" and n_wanted is not None:
        ending += f"; {n_captures} of {n_wanted} captures"
    show.note(f"ended: {ending}")
    if report.error is not None:
        raise report.error
    if asked.signal == signal.SIGINT:
        raise click.exceptions.Exit(130)
    remedy = "Run the same command again to continue."
    if simulated is None:
        remedy = (
            "Hold the board in view of all sensors at once; run `lce-rig doctor --rig RIG` to find the fault."
        )
    if n_captures == 0:
        raise NotEnoughDataError("nothing was captured", remedy)
    if report.recording_error is not None:
        raise report.recording_error
    if report.ending == "exhausted" and not report.is_enough:
        few = f"{show.counted(n_captures, 'capture')} are not enough: the target is not predicted to be met"
        raise NotEnoughDataError(few, remedy)


def show_next(path: Path, rig: Rig, predicted: Sequence[Finding], n_captures: int) -> None:
    """State whether the target is predicted to be met, the figures, and the next command."""
    are_enough = n_captures >= rig.quality.min_captures
    for prediction in predicted:
        state = "target met" if are_enough and is_met(prediction) else "target not met"
        show.note(f"  {state}: {prediction.text}")
    if not are_enough:
        lacking = show.counted(rig.quality.min_captures - n_captures, "more capture")
        show.note(f"  next         {lacking} at least: {_more(path)}")
        return
    if predicted and not all(map(is_met, predicted)):
        show.note(f"  more         {_more(path)}")
    show.name_next("calibrate", path)


def _more(path: Path) -> str:
    from lce_rig.cli.calibrate import collect_command

    return collect_command(Session.open(path))


def is_met(prediction: Finding) -> bool:
    """Check whether the predicted standard deviations are within the profile's target.

    The guide itself ends a collection later, when they are within it with a margin.
    """
    return all(
        prediction.figure(figure) <= prediction.figure(target)
        for figure, target in (("rotation_deg", "target_deg"), ("position_mm", "target_mm"))
    )
