"""`lce-rig collect`: build a session from attached sensors (guided) or from recordings."""

import re
from collections.abc import Collection, Sequence
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import Any

import click

from lce_rig.cli import show
from lce_rig.cli.collect_live import run_live, show_next
from lce_rig.cli.options import FiniteRange, path_option, require_sensors, robot_option, session_argument
from lce_rig.cli.simulate import require_kind
from lce_rig.collect.findings import IMAGE_NONE
from lce_rig.collect.gates import stillness_window_s
from lce_rig.collect.live.guide import predict
from lce_rig.collect.offline import collect as collect_into
from lce_rig.core.errors import NotEnoughDataError, UsageError
from lce_rig.detect.findings import LENS_MISFITS
from lce_rig.io import open_recordings
from lce_rig.io.folder import FolderRecording
from lce_rig.io.recording import SourceOptions
from lce_rig.rig import find_profile, load_rig, read_profile
from lce_rig.session import Session
from lce_rig.session.identity import MARKER
from lce_rig.show.phone import DEFAULT_PORT, LOOPBACK


def _topics(_ctx: click.Context, _param: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    topics = {}
    for value in values:
        sensor, separator, topic = value.partition("=")
        if not (sensor and separator and topic):
            raise click.BadParameter(f"{value!r} is not SENSOR=/topic, such as cam=/camera/image_raw")
        topics[sensor] = topic
    return topics


# Address of --preview if none is given: this computer only.
_PREVIEW_DEFAULT = f"{LOOPBACK}:{DEFAULT_PORT}"
_PREVIEW_ADDRESS = re.compile(r"[^/\s]*:\d*|\d+|\d+(\.\d+){3}|localhost")


class _Command(click.Command):
    """Let `--preview session/` mean the option without an address, followed by the session."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Give --preview its default address if no address follows it."""
        args = list(args)
        for k, (word, following) in enumerate(pairwise(args)):
            if word == "--preview" and not _PREVIEW_ADDRESS.fullmatch(following):
                args[k] = f"--preview={_PREVIEW_DEFAULT}"
        return super().parse_args(ctx, args)


@click.command(cls=_Command)
@click.option(
    "--rig",
    "rig_name",
    metavar="NAME|FILE",
    help="Set the rig profile: a shipped name or a file [default: that of an existing SESSION].",
)
@robot_option
@session_argument
@path_option(
    "--from",
    "paths",
    "PATH",
    "Read a recording: a folder with img/ (several cameras: img/CAMERA/) and pcd/ (a rig without cameras: "
    "folders of point clouds named after its LiDARs), a folder of "
    "--record, a ROS 1 or ROS 2 bag, an mcap or pcap file, an event camera's file (AEDAT4, Prophesee "
    "RAW, HDF5), or beside these a folder of images named after their times. "
    "Repeatable, also for simultaneous recordings of several sensors.",
    multiple=True,
)
@click.option(
    "--topic",
    "topics",
    multiple=True,
    callback=_topics,
    metavar="SENSOR=/TOPIC",
    help="Set the topic of a sensor in a bag; repeatable.",
)
@click.option(
    "--camera",
    "cameras",
    multiple=True,
    metavar="NAME",
    help="Name the camera of a folder's images if the rig has several and the folder does not name it. "
    "Give one for all recordings, or one per --from in the same order.",
)
@click.option(
    "--channel",
    "channels",
    multiple=True,
    metavar="NAME",
    help="Name that camera's channel, such as events for images from events; once or per --from.",
)
@click.option(
    "--lidar",
    "lidars",
    multiple=True,
    metavar="NAME",
    help="Name the LiDAR of a folder's point clouds if the rig has several; once or per --from.",
)
@click.option(
    "--captures",
    "n_wanted",
    type=click.IntRange(1),
    metavar="N",
    help="Stop at N captures in the session: live instead of at the predicted target, from recordings with a "
    "warning if they give fewer.",
)
@click.option(
    "--timeout", type=FiniteRange(0, min_open=True), metavar="S", help="Live: stop after S seconds."
)
@click.option("--keep-going", is_flag=True, help="Live: continue after the target is met, until stopped.")
@click.option(
    "--hold",
    type=FiniteRange(0, 30),
    metavar="S",
    help="Live: capture after the board has stood still for S seconds  [default: 1.5]",
)
@click.option("--plain", is_flag=True, help="Live: print lines on stderr instead of the full-screen view.")
@click.option(
    "--preview",
    is_flag=False,
    flag_value=_PREVIEW_DEFAULT,
    metavar="[HOST:PORT]",
    help=f"Live: serve a page for a phone [default address: {_PREVIEW_DEFAULT}]. Its link has a token.",
)
@path_option("--record", "FOLDER", "Live: also record the raw streams into a new folder, which --from reads.")
@click.option("--simulated", is_flag=True, help="Live: collect from a simulated rig with a simulated person.")
@click.option("--seed", type=click.IntRange(0), help="Set the seed of the simulated rig  [default: 0]")
def collect(
    rig_name: str | None,
    robot: str | None,
    session: Path,
    paths: tuple[Path, ...],
    topics: dict[str, str],
    cameras: tuple[str, ...],
    channels: tuple[str, ...],
    lidars: tuple[str, ...],
    n_wanted: int | None,
    **live: Any,
) -> None:
    """Build or continue SESSION (default: session/), live or from recordings.

    Without --from, read the attached sensors (check them with `lce-rig doctor`) and guide the person
    with the board. Captures are taken automatically when the board stands still, or moves slowly before an
    event camera, until the profile's target is predicted to be met. Without a terminal it also ends after 30
    minutes without a capture, with --simulated after 10.

    With --from, each image-scan pair of a folder becomes a capture; in other recordings, each new placement
    where the board stands still, or moves slowly if there are events. Simultaneous recordings, such as --from
    lidar.bag --from events.aedat4, are joined.

    Run the same command again to continue; existing captures are not repeated.
    """
    if rig_name is not None:
        rig = load_rig(rig_name)
    elif (session / MARKER).exists():
        rig = Session.open(session).rig
    else:
        raise UsageError(
            f"{session} is a new session: its rig is missing",
            "Add --rig NAME|FILE: one of `lce-rig rigs list`, or a file of `lce-rig rigs new NAME`.",
        )
    rig = rig.of_robot(robot)
    if not paths:
        _refuse_options(_OF_RECORDINGS, "applies to recordings only", "Add --from, or omit this option.")

        try:
            run_live(rig, session, n_wanted, **live)
        finally:
            _keep_text(session, rig_name)
        return
    _refuse_options(tuple(live), "applies to live collection only", "Omit --from or this option.")

    require_kind(session, None)
    sensors = zip(
        _one_for_each(paths, "--camera", cameras, rig.cameras),
        _one_for_each(paths, "--channel", channels),
        _one_for_each(paths, "--lidar", lidars, rig.lidars),
        strict=True,
    )
    sources = [SourceOptions(*names, topics) for names in sensors]
    recordings = open_recordings(paths, rig, sources)
    with show.progress_bar("collecting", has_lines=True) as progress, Session.resume(session, rig) as writer:
        report = collect_into(writer, recordings, n_wanted, progress)
    _keep_text(session, rig_name)
    n_captures = len(Session.open(session).captures)
    if topics and any(isinstance(recording, FolderRecording) for recording in recordings):
        show.warn("--topic is ignored for a folder of images and point clouds")
    _tell(report, session, n_captures)
    if n_captures == 0:
        window_s = stillness_window_s(rig)
        hold_s = ceil(window_s)
        hint = (
            f"Hold the board still for {hold_s} s in view of both sensors, and check that their clocks agree."
        )
        causes = {why.code for why, _ in report.counts.counts()}
        if causes == {IMAGE_NONE.code}:
            hint = (
                "Compare `board` in the profile with an image: count inner corners, or squares with markers."
            )
        elif causes and causes <= {IMAGE_NONE.code, *LENS_MISFITS}:
            hint = (
                "Correct the camera's `intrinsics` in the profile: those of the images as recorded "
                "(rectified, binned, cropped), and flatten the board."
            )
        elif report.has_events:
            hint = "Move the board slowly, about 10 cm/s, in view of both sensors; the causes are above."
        what = f"{session}: no capture from {', '.join(map(str, paths))}"
        if 0 < report.longest_s < window_s:
            what += f", which lasts {report.longest_s:.1f} s (minimum {window_s:.1f} s)"
            hint = (
                f"Record each placement with the board standing still in view of both sensors for {hold_s} s."
            )
        raise NotEnoughDataError(what, hint)
    show_next(session, rig, predict(Session.open(session)), n_captures)


def _keep_text(session: Path, rig_name: str | None) -> None:
    """Keep the profile's comments in the session, for profiles derived from it."""
    if rig_name is not None and (session / MARKER).exists():
        Session.open(session).keep_text(read_profile(find_profile(rig_name)))


_MOST_CAUSES = 5
_OF_RECORDINGS = ("topics", "cameras", "channels", "lidars")


def _one_for_each(
    paths: Sequence[Path], option: str, names: Sequence[str], sensors_of_rig: Collection[str] | None = None
) -> list[str | None]:
    """Return the sensor name of each recording: the only one given, its own, or None.

    Raises:
        UsageError: the number of names is neither one nor that of the recordings, or a name is unknown.
    """
    if sensors_of_rig is not None:
        require_sensors(option.removeprefix("--"), names, sensors_of_rig)
    if len(names) < 2:
        return [*names, None][:1] * len(paths)
    if len(names) != len(paths):
        raise UsageError(
            f"{option} is given {len(names)} times for {show.counted(len(paths), 'recording')}",
            f"Give it once, or once per --from: --from A {option} {names[0]} --from B {option} {names[1]}",
        )
    return list(names)


def _refuse_options(names: tuple[str, ...], what: str, hint: str) -> None:
    """Reject options that do not apply here instead of ignoring them.

    Raises:
        UsageError: one was given; the message names it.
    """
    context = click.get_current_context()
    for param in context.command.params:
        source = context.get_parameter_source(param.name or "")
        if param.name in names and source is click.core.ParameterSource.COMMANDLINE:
            raise UsageError(f"{param.opts[-1]} {what}", hint)


def _tell(report: Any, session: Path, n_captures: int) -> None:
    """Report captures, duplicates and refusals.

    Raises:
        SourceError: a recording could not be read to its end; captures before it are kept.
    """
    for text in report.notes:
        show.note(text)
    for label, refusal in report.refused.items():
        show.warn(f"{label}: {refusal.sentence}")
    counts = report.counts.counts()
    if counts:
        lines = [f"  {n} x {why.sentence}" for why, n in counts[:_MOST_CAUSES]]
        lines += [f"  {len(counts) - _MOST_CAUSES} more causes"] if len(counts) > _MOST_CAUSES else []
        show.note("not captured:\n" + "\n".join(lines))
    if report.n_missing:
        show.warn(f"{report.n_missing} captures short of the target")
    new = f"{len(report.captured)} new" + (f", {report.n_known} held already" if report.n_known else "")
    show.note(f"{session}: {show.counted(n_captures, 'capture')} ({new})")
    for error in report.errors[:-1]:
        show.warn(str(error))
    if report.errors:
        raise report.errors[-1]
