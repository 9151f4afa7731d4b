"""`lce-rig collect`: a session from attached sensors, guided, or from recordings, unattended."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import click

from lce_rig.cli import show
from lce_rig.cli.options import FiniteRange, require_sensors
from lce_rig.words import sentence


def _topics(_ctx: click.Context, _param: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    topics = {}
    for value in values:
        sensor, separator, topic = value.partition("=")
        if not (sensor and separator and topic):
            raise click.BadParameter(f"{value!r} is not SENSOR=/topic, such as cam=/camera/image_raw")
        topics[sensor] = topic
    return topics


@click.command()
@click.option("--rig", "rig_name", required=True, metavar="NAME|FILE", help="Rig profile: a name or a file.")
@click.argument("session", type=click.Path(path_type=Path), default="session")
@click.option(
    "--from",
    "paths",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="PATH",
    help="Read a recording: a folder with img/ (several cameras: img/CAMERA/) and pcd/, what --record kept, "
    "a ROS 1 or ROS 2 bag, an mcap or pcap file, or an event camera's file (AEDAT4, Prophesee RAW, HDF5); "
    "may be repeated, also for several recorders of one moment.",
)
@click.option(
    "--pair",
    type=click.Choice(["auto", "stem", "order", "time"]),
    default="auto",
    show_default=True,
    help="How a folder's pictures and clouds belong together: equal names, sorted order, nearest time.",
)
@click.option("--pair-tolerance", type=FiniteRange(0), metavar="S", help="Largest difference of a pair.")
@click.option(
    "--topic", "topics", multiple=True, callback=_topics, metavar="SENSOR=/TOPIC", help="Topic of a sensor."
)
@click.option(
    "--camera",
    "cameras",
    multiple=True,
    metavar="NAME",
    help="Camera that a folder's pictures belong to, where the rig has several and the folder none of its "
    "name: one for all, or one for each --from in turn.",
)
@click.option(
    "--channel",
    "channels",
    multiple=True,
    metavar="NAME",
    help="Channel of it, such as events for pictures reconstructed from events; likewise.",
)
@click.option(
    "--lidar",
    "lidars",
    multiple=True,
    metavar="NAME",
    help="LiDAR that a folder's clouds belong to, where the rig has several; likewise.",
)
@click.option("--max-captures", type=click.IntRange(1), metavar="N", help="Leave the session at N captures.")
@click.option(
    "--target",
    type=click.IntRange(1),
    metavar="N",
    help="Stop reading once the session has N captures; say so where it stays short.",
)
@click.option(
    "--frames",
    type=click.IntRange(1),
    metavar="N",
    help="Live: stop when the session holds N captures, not when the target is met.",
)
@click.option("--timeout", type=FiniteRange(0, min_open=True), metavar="S", help="Live: stop after so long.")
@click.option("--keep-going", is_flag=True, help="Live: go on when the target is met, until told to stop.")
@click.option(
    "--hold", type=FiniteRange(0, 30), metavar="S", help="Live: how long a board stands still.  [1.5]"
)
@click.option("--plain", is_flag=True, help="Live: lines on stderr in place of a screen.")
@click.option(
    "--preview",
    is_flag=False,
    flag_value="127.0.0.1:8765",
    metavar="[HOST:PORT]",
    help="Live: serve a page for a phone; by default on 127.0.0.1:8765. Elsewhere it asks for a token.",
)
@click.option(
    "--record",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Live: keep the raw streams too, in a new folder that --from reads.",
)
@click.option("--simulated", is_flag=True, help="Live: of a simulated rig, with a simulated person.")
@click.option("--seed", type=click.IntRange(0), help="Of --simulated.  [0]")
def collect(
    rig_name: str,
    session: Path,
    paths: tuple[Path, ...],
    pair: Any,
    pair_tolerance: float | None,
    topics: dict[str, str],
    cameras: tuple[str, ...],
    channels: tuple[str, ...],
    lidars: tuple[str, ...],
    max_captures: int | None,
    target: int | None,
    **live: Any,
) -> None:
    """Build or continue SESSION (default: session/), live or from recordings.

    Without --from the rig's attached sensors are read. One person holds the board and is told where to go;
    captures are taken when it stands still there, or moves slowly before an event camera. No key has to be
    pressed. Collection ends when the calibration is predicted to meet the profile's target, and can be
    continued any time. Without a terminal it also ends after 30 minutes without a capture, with --simulated
    after 10. `lce-rig doctor` checks the rig first.

    With --from, every pair of a folder becomes a capture; pictures of several cameras lie in img/CAMERA/, and
    go with the same cloud. Bags are cut where the board stands still in both
    sensors and is somewhere new; where they hold raw events, where it moves slowly, and the events are kept.
    Recordings of one moment, such as --from lidar.bag --from events.aedat4, are read as one: each adds a
    sensor to those before it. Run it again to continue: what is captured already is not captured twice.
    """
    if not paths:
        _refuse_options(_OF_RECORDINGS, "belongs to recordings", "name one with --from")
        from lce_rig.cli.collect_live import LiveArguments, run_live

        run_live(rig_name, session, LiveArguments(**live))
        return
    from lce_rig.cli.simulate import require_kind

    _refuse_options(tuple(live), "belongs to live collection", "leave --from out, or this option")
    from lce_rig.collect import CollectOptions
    from lce_rig.core.errors import NotEnoughDataError
    from lce_rig.pipeline.collection import fill_session
    from lce_rig.recordings import open_recordings
    from lce_rig.recordings.protocol import PairedRecording, SourceOptions
    from lce_rig.rig import load_rig
    from lce_rig.session import Session

    rig = load_rig(rig_name)
    require_kind(session, None)
    sensors = zip(
        _one_for_each(paths, "--camera", cameras, rig.cameras),
        _one_for_each(paths, "--channel", channels),
        _one_for_each(paths, "--lidar", lidars, rig.lidars),
        strict=True,
    )
    options = [SourceOptions(*names, pair, pair_tolerance, topics) for names in sensors]
    recordings = open_recordings(paths, rig, options)
    wanted = CollectOptions(max_captures=max_captures, target=target)
    with show.progress_bar("collecting") as progress:
        report = fill_session(rig, recordings, session, wanted, progress)
    n_captures = len(Session.open(session).captures)
    if topics and any(isinstance(recording, PairedRecording) for recording in recordings):
        show.warn("--topic means nothing for a folder of pictures and clouds")
    _tell(report, session, n_captures)
    if n_captures == 0:
        raise NotEnoughDataError(
            f"{session}: no capture could be made of {', '.join(map(str, paths))}",
            _remedy(report),
        )


_OF_RECORDINGS = (
    "pair",
    "pair_tolerance",
    "topics",
    "cameras",
    "channels",
    "lidars",
    "max_captures",
    "target",
)


def _one_for_each(
    paths: Sequence[Path], option: str, names: Sequence[str], known: Collection[str] | None = None
) -> list[str | None]:
    """Give each recording the name it is read by: the only one, its own, or None.

    Raises:
        UsageError: there are some, but neither one nor as many as recordings; or one is not known.
    """
    from lce_rig.core.errors import UsageError

    if known is not None:
        require_sensors(option.removeprefix("--"), names, known)
    if len(names) < 2:
        return [*names, None][:1] * len(paths)
    if len(names) != len(paths):
        raise UsageError(
            f"{option} is given {len(names)} times for {show.counted(len(paths), 'recording')}",
            f"Give it once, or for each --from: --from A {option} {names[0]} --from B {option} {names[1]}",
        )
    return list(names)


def _refuse_options(names: tuple[str, ...], what: str, hint: str) -> None:
    """Refuse options that mean nothing here, rather than leave them unheard.

    Raises:
        UsageError: one was given; it is named.
    """
    from lce_rig.core.errors import UsageError

    context = click.get_current_context()
    for param in context.command.params:
        source = context.get_parameter_source(param.name or "")
        if param.name in names and source is click.core.ParameterSource.COMMANDLINE:
            raise UsageError(f"{param.opts[-1]} {what}", hint)


def _remedy(report: Any) -> str:
    """Say what to do where nothing could be captured."""
    if report.has_events:
        return "The board must move slowly, about 10 cm/s, and be seen by both sensors; the causes are above."
    return "The board must stand still for a second in both sensors at once; do their clocks agree?"


def _tell(report: Any, session: Path, n_captures: int) -> None:
    """Say what became of everything that was read.

    Raises:
        SourceError: a recording could not be read to its end; what was captured before is kept.
    """
    for text in report.notes:
        show.note(text)
    for label, capture in report.duplicates.items():
        show.note(f"{label}: duplicate of {capture}, left out")
    for label, refusal in report.refused.items():
        show.warn(f"{label}: {sentence(refusal)}")
    counts = report.counts.counts()
    if counts:
        show.note("not captured:\n" + "\n".join(f"  {n} x {sentence(why)}" for why, n in counts))
    if report.n_missing:
        show.warn(f"{report.n_missing} captures short of the target")
    new = f"{len(report.captured)} new" + (f", {report.n_resumed} known already" if report.n_resumed else "")
    new += f", {report.n_rejected} rejected earlier" if report.n_rejected else ""
    show.note(f"{session}: {show.counted(n_captures, 'capture')} ({new})")
    for error in report.errors[:-1]:
        show.warn(str(error))
    if report.errors:
        raise report.errors[-1]
