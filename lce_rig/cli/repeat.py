"""`lce-rig repeat`: compare the extrinsics from independent sessions of one rig, or the results of one."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np

from lce_rig.cli import show
from lce_rig.cli.options import explain_option, json_option
from lce_rig.core.errors import ResultRefusedError, UsageError
from lce_rig.core.phrasing import as_line, significant, sizes
from lce_rig.judge.repeatability import Repeatability
from lce_rig.pipeline.comparison import compare_results
from lce_rig.pipeline.comparison import repeat as compare


@click.command()
@click.argument("sessions", nargs=-1, type=click.Path(path_type=Path), metavar="SESSION...")
@click.option(
    "--name",
    "names",
    metavar="NAME",
    multiple=True,
    help="Compare this named result (see `lce-rig results`); repeatable with one session.",
)
@explain_option
@json_option
def repeat(sessions: tuple[Path, ...], names: tuple[str, ...], explain: bool, as_json: bool) -> None:
    """Compare the calibrations of two or more independent SESSIONs of one rig, or the results of one SESSION.

    The best test of extrinsics: collect again with new placements of the board. Errors that all sessions
    share stay hidden: intrinsics, the board's size, constant range errors.

    With one session, compare the results of `lce-rig calibrate SESSION --name NAME` with the current one.

    A session without a result is calibrated for the comparison; nothing is written. Exits with 7 if the
    calibrations disagree, or if one of them failed.
    """
    if len(sessions) == 1:
        compared = compare_results(sessions[0], names)
    elif len(names) > 1:
        raise UsageError("several results and several sessions given", "Give one session, or one result.")
    else:
        with show.progress_bar("reading") as progress:
            compared = compare(sessions, name=next(iter(names), None), progress=progress)
    for name in compared.calibrated:
        show.note(f"{name} has no result: calibrated for this comparison, not written")
    show.warn_of(finding for finding in compared.findings if finding.severity != "error")
    if as_json:
        show.print_json(
            {
                "format_version": 2,
                "rig": compared.rig,
                "calibrated": compared.calibrated,
                "findings": compared.findings,
                "pairs": [
                    {
                        name.replace("reported_", "claimed_"): value
                        for name, value in vars(c).items()
                        if name != "names"
                    }
                    | {"sessions": c.names, "agrees": c.agrees, "finding": c.finding}
                    for c in compared.comparisons
                ],
            }
        )
    else:
        for comparison in compared.comparisons:
            show.print_parts(_parts(comparison, str(sessions[0]), is_explained=explain))
    if compared.failed:
        raise ResultRefusedError(
            "; ".join(finding.text for finding in compared.failed), compared.failed[0].advice
        )
    refused = [comparison for comparison in compared.comparisons if not comparison.agrees]
    if refused:
        raise ResultRefusedError(
            f"the sessions disagree on the extrinsics of {', '.join(map(_sensors, refused))}"
        )


def _parts(c: Repeatability, session: str, *, is_explained: bool) -> Iterator[Any]:
    """State whether the sessions agree, the mean extrinsics, and the spread with the reported one."""
    shared = "" if c.are_independent else ", at least: the results share captures"
    colour = "green" if c.agrees else "red"
    yield f"[{colour}]{show.escape(c.finding.text)}[/]"
    if advice := c.finding.advice_at(session):
        yield f"  -> {show.escape(as_line(advice))}"
    yield "  mean T_cam_lidar (p_cam = R p_lidar + t)"
    yield from show.matrix_lines(c.T_cam_lidar, "    ")
    spread = sizes(c.spread_rotation_deg, c.spread_translation_m)
    yield f"  spread       {spread} (1 sigma of one session)"
    yield f"  reported     {sizes(c.reported_rotation_deg, c.reported_translation_m)}"
    chance = significant(max(c.p, 1e-300))  # "below ...", as no chance is 0
    yield f"  chance       {chance}{shared} (chi2 {c.chi2:.1f}, {c.dof} degrees of freedom)"
    if not is_explained:
        return
    headings: tuple[str, ...] = ("session", ">x mm", ">y mm", ">z mm")
    headings += (">about x deg", ">about y deg", ">about z deg")
    rows = [
        (
            show.escape(name),
            *(f"{1000 * value:+.1f}" for value in tangent[:3]),
            *(f"{value:+.3f}" for value in np.degrees(tangent[3:])),
        )
        for name, tangent in zip(c.names, c.deviations, strict=True)
    ]
    yield show.plain_table(f"{_sensors(c)}: difference from the mean", *headings, rows=rows)
    headings = ("first", "second", ">deg", ">mm", ">mm at boards", ">distance", ">chance")
    rows = []
    for pair in c.differences:
        at_boards = ", ".join(f"{1000 * m:.1f} at {at_m:g} m" for at_m, m in pair.displacements_m.items())
        figures = f"{pair.rotation_deg:.3f}", f"{1000 * pair.translation_m:.1f}", at_boards or "-"
        names = show.escape(pair.first), show.escape(pair.second)
        rows.append((*names, *figures, f"{pair.distance:.1f}", significant(pair.p)))
    yield show.plain_table("pairs of sessions", *headings, rows=rows)


def _sensors(comparison: Repeatability) -> str:
    return f"{comparison.camera} and {comparison.lidar}"
