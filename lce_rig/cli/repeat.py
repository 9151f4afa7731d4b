"""`lce-rig repeat`: compare the extrinsics from independent sessions of one rig, or the results of one."""

from pathlib import Path
from typing import Any

import click
import numpy as np

from lce_rig.cli import show
from lce_rig.cli.options import explain_option, json_option
from lce_rig.core.errors import ResultRefusedError, UsageError
from lce_rig.core.phrasing import as_line, significant
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

    The best test of extrinsics: collect again with new board placements, and compare the differences of the
    results with their reported uncertainties. It cannot show errors that all sessions share: those of the
    intrinsics, the board's size, and constant errors of the LiDAR's ranges.

    With one session, compare its results, such as that of `calibrate --channels events --name events` with
    the current one. They share captures, so that common errors stay hidden.

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
    for finding in compared.findings:
        if finding.severity != "error":
            show.warn(finding.sentence)
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
            show.print_lines(_lines(comparison, str(sessions[0])))
            if explain:
                show.print_table(_deviations(comparison))
                show.print_table(_differences(comparison))
    if compared.failed:
        raise ResultRefusedError(
            "; ".join(finding.text for finding in compared.failed), compared.failed[0].advice
        )
    refused = [comparison for comparison in compared.comparisons if not comparison.agrees]
    if refused:
        raise ResultRefusedError(
            f"the sessions disagree on the extrinsics of {', '.join(map(_sensors, refused))}"
        )


def _deviations(comparison: Repeatability) -> Any:
    headings = (">x mm", ">y mm", ">z mm", ">about x deg", ">about y deg", ">about z deg")
    table = show.plain_table(f"{_sensors(comparison)}: difference from the mean", "session", *headings)
    for name, tangent in zip(comparison.names, comparison.deviations, strict=True):
        cells = [f"{1000 * value:+.1f}" for value in tangent[:3]]
        cells += [f"{value:+.3f}" for value in np.degrees(tangent[3:])]
        table.add_row(show.escape(name), *cells)
    return table


def _differences(comparison: Repeatability) -> Any:
    headings = ("first", "second", ">deg", ">mm", ">mm at boards", ">distance", ">chance")
    table = show.plain_table("pairs of sessions", *headings)
    for pair in comparison.differences:
        at_boards = ", ".join(f"{1000 * m:.1f} at {at_m:g} m" for at_m, m in pair.displacements_m.items())
        sizes = f"{pair.rotation_deg:.3f}", f"{1000 * pair.translation_m:.1f}"
        figures = (*sizes, at_boards or "-", f"{pair.distance:.1f}")
        table.add_row(show.escape(pair.first), show.escape(pair.second), *figures, significant(pair.p))
    return table


def _lines(comparison: Repeatability, session: str) -> list[str]:
    """State whether the sessions agree, the mean extrinsics, and the spread with the reported one."""
    c = comparison
    shared = "" if c.are_independent else ", at least: the results share captures"
    colour = "green" if c.agrees else "red"
    lines = [f"[{colour}]{show.escape(c.finding.text)}[/]"]
    advice = c.finding.advice_at(session)
    lines += [f"  -> {show.escape(as_line(advice))}"] if advice else []
    return [
        *lines,
        "  mean T_cam_lidar (p_cam = R p_lidar + t)",
        *show.matrix_lines(c.T_cam_lidar, "    "),
        f"  spread       {c.spread_rotation_deg:.3f} deg, {1000 * c.spread_translation_m:.1f} mm "
        "(1 sigma of one session)",
        f"  reported     {c.reported_rotation_deg:.3f} deg, {1000 * c.reported_translation_m:.1f} mm",
        f"  chance       {significant(c.p)}{shared} (chi2 {c.chi2:.1f}, {c.dof} degrees of freedom)",
    ]


def _sensors(comparison: Repeatability) -> str:
    return f"{comparison.camera} and {comparison.lidar}"
