"""`lce-rig collect` without --from: attached sensors, or the simulated rig."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lce_rig.cli import show
from lce_rig.cli.simulate import TRUTH, require_kind, write_truth
from lce_rig.core.errors import LceRigError
from lce_rig.show.screen.keys import Controls, controls
from lce_rig.words import sentence

if TYPE_CHECKING:
    from lce_rig.collect.live.simulated import SimulatedRig
    from lce_rig.collect.live.state import LiveReport, LiveState, TakeBack
    from lce_rig.core.findings import Finding
    from lce_rig.devices.reading import LiveSource
    from lce_rig.rig import Rig
    from lce_rig.session import Session
    from lce_rig.show.phone import Preview

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


@dataclass(frozen=True)
class LiveArguments:
    """The options of live collection, as given.

    Attributes:
        frames, timeout, keep_going, hold, plain, silent, preview, record, simulated, seed: see --help.
    """

    frames: int | None
    timeout: float | None
    keep_going: bool
    hold: float | None
    plain: bool
    silent: bool
    preview: str | None
    record: Path | None
    simulated: bool
    seed: int | None


def run_live(rig: "Rig", path: Path, given: LiveArguments) -> None:
    """Collect live into a session and report the outcome."""
    from lce_rig.collect.live.collection import collect_live
    from lce_rig.collect.live.state import HOLD_S, LiveOptions
    from lce_rig.core.errors import UsageError
    from lce_rig.show.screen.live_view import open_view

    if given.seed is not None and not given.simulated:
        raise UsageError("--seed applies to --simulated only", "Add --simulated, or omit --seed.")
    require_kind(path, (given.seed or 0) if given.simulated else None)
    hold_s = HOLD_S if given.hold is None else given.hold
    with ExitStack() as stack:
        # The page first: an address that cannot be served fails before anything is created or started.
        listeners, links, page_asked = _open_preview(stack, given)
        session = stack.enter_context(_session(path, rig))
        n_before = len(session.captures)
        sources, simulated = _open_rig(stack, rig, path, given)
        listeners += [simulated.watch] if simulated else []
        asked = stack.enter_context(controls())
        idle_s = _idle_s(given, asked)
        options = LiveOptions(given.frames, given.timeout, hold_s, goes_on=given.keep_going, idle_s=idle_s)
        with open_view(
            is_plain=given.plain,
            has_keys=asked.is_interactive,
            links=links,
            is_silent=given.silent,
            wants_code=lambda: asked.wants_code,
        ) as view:
            listeners.append(_until_gone(view.show))
            is_begun = threading.Event()

            def tell(state: "LiveState") -> None:
                is_begun.set()
                for listener in listeners:
                    listener(state)

            try:
                report = collect_live(
                    session, sources, options, tell, lambda: asked() or page_asked(), given.record
                )
            finally:
                n_captures = len(session.captures)
                if n_captures or is_begun.is_set():
                    saved = f"{path}: {show.counted(n_captures, 'capture')} ({n_captures - n_before} new)"
                    stack.callback(show.note, saved)
    _tell(report, n_captures, asked, simulated, given)
    show_next(path, rig, report.predicted, n_captures)


def _idle_s(given: LiveArguments, asked: Controls) -> float | None:
    """Return the time without a capture that ends an unattended run; None if the run is attended."""
    if given.simulated:
        return SIMULATED_IDLE_S
    return None if asked.is_interactive else UNATTENDED_IDLE_S


def _until_gone(show_state: "Callable[[LiveState], None]") -> "Callable[[LiveState], None]":
    """Show states until the terminal is gone; its hangup then ends the collection in good order."""
    is_gone = threading.Event()

    def tell(state: "LiveState") -> None:
        if not is_gone.is_set():
            try:
                show_state(state)
            except OSError:
                is_gone.set()

    return tell


@contextmanager
def _session(path: Path, rig: "Rig") -> "Iterator[Session]":
    """Continue or start a session; delete a new one that stays empty because its rig does not answer."""
    from lce_rig.session import Session, discard_if_empty

    is_new = not path.exists()
    try:
        with Session.resume(path, rig) as session:
            yield session
    except LceRigError:
        if is_new:
            discard_if_empty(path)
        raise


def _open_rig(
    stack: ExitStack, rig: "Rig", path: Path, given: LiveArguments
) -> "tuple[list[LiveSource], SimulatedRig | None]":
    """Open the attached or simulated sources; write the truth of simulated ones into the session."""
    if not given.simulated:
        from lce_rig.devices.opening import open_live

        return open_live(rig), None
    from lce_rig.collect.live.simulated import SimulatedRig
    from lce_rig.simulate import SimulationOptions, rig_truth

    seed = given.seed or 0
    show.note("starting the simulated rig ...")
    simulated = stack.enter_context(SimulatedRig(rig, seed))
    write_truth(path / TRUTH, rig_truth(rig, seed, SimulationOptions.for_rig(rig.name)))
    return simulated.sources, simulated


def _open_preview(
    stack: ExitStack, given: LiveArguments
) -> "tuple[list[Callable[[LiveState], None]], tuple[str, ...], Callable[[], TakeBack | None]]":
    """Serve the preview page if requested; return its listeners, links and what its viewers ask for."""
    if given.preview is None:
        return [], (), lambda: None
    from lce_rig.show.phone import Preview, parse_address
    from lce_rig.show.screen.live_view import qr_lines

    host, port = parse_address(given.preview)
    preview = Preview(host, port)
    stack.callback(_tell_troubles, preview)
    stack.enter_context(preview)
    for url in preview.urls:
        show.note(f"preview: {url}")
    if sys.stderr.isatty():
        for line in qr_lines(preview.urls[0]):
            click.secho(line, fg="bright_white", bg="black", err=True)
    return [preview.publish], preview.urls, preview.asked


def _tell_troubles(preview: "Preview") -> None:
    for text in preview.notes():
        show.note(text)


def _tell(
    report: "LiveReport",
    n_captures: int,
    asked: Controls,
    simulated: "SimulatedRig | None",
    given: LiveArguments,
) -> None:
    """Report the outcome.

    Raises:
        SourceError: a sensor was lost permanently; the captures are kept.
        LceRigError: the recording ended early, for example on a full disk; the captures are kept.
        NotEnoughDataError: there is no capture, or too few when the new placements are exhausted.
    """
    from lce_rig.core.errors import NotEnoughDataError

    for text in report.notes:
        show.note(text)
    if report.n_recorded is not None:
        show.note(f"{given.record}: {report.n_recorded} samples recorded")
    lost = {name: n for name, n in report.n_lost.items() if n}
    if lost:
        show.note("dropped: " + ", ".join(f"{name} {n}" for name, n in sorted(lost.items())))
    slow = None if simulated is None else simulated.pace.problem()
    if slow is not None:
        show.warn(sentence(slow))
    show.note(f"ended: {_ending(report, n_captures, given)}")
    if report.error is not None:
        raise report.error
    if asked.signal == signal.SIGINT:
        raise click.exceptions.Exit(130)
    if n_captures == 0:
        raise NotEnoughDataError("nothing was captured", _remedy(report, simulated))
    if report.recording_error is not None:
        raise report.recording_error
    if report.ending == "exhausted" and not report.is_enough:
        raise NotEnoughDataError(
            f"{show.counted(n_captures, 'capture')} are not enough: the target is not predicted to be met",
            _remedy(report, simulated),
        )


def show_next(path: Path, rig: "Rig", predicted: "Sequence[Finding]", n_captures: int) -> None:
    """Print the predicted standard deviations and the next command."""
    for found in predicted:
        show.note(sentence(found))
    if n_captures < rig.quality.min_captures:
        show.note(f"{show.counted(n_captures, 'capture')} (minimum {rig.quality.min_captures}): collect more")
    elif predicted and not all(found.figures["is_enough"] for found in predicted):
        show.note("the target is not predicted to be met: collect more, or see what these captures give")
    if n_captures >= rig.quality.min_captures:
        show.note(f"next: lce-rig calibrate {path}")


def _ending(report: "LiveReport", n_captures: int, given: LiveArguments) -> str:
    """Say why the collection ended, and how to continue if it ended at the target."""
    ending = _ENDINGS[report.ending]
    if report.ending == "enough":
        return f"{ending} (--keep-going or --frames N collect more)"
    if report.ending == "exhausted" and given.frames is not None:
        return f"{ending}; {n_captures} of {given.frames} captures"
    return ending


def _remedy(report: "LiveReport", simulated: "SimulatedRig | None") -> str:
    """Say what to do if too little was captured."""
    if report.lost:
        return "\n".join(f"{name} is lost: {error.what}. {error.hint}" for name, error in report.lost.items())
    if simulated is None:
        return "Hold the board in view of all sensors at once; run `lce-rig doctor` to find the fault."
    if simulated.pace.problem():
        return "This computer is too busy or too slow. End other programs, or use `lce-rig simulate`."
    if report.ending == "exhausted":
        return "Run the same command again to continue."
    return "Give the simulated person more time with a longer --timeout."
