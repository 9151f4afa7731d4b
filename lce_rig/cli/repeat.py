"""`lce-rig repeat`: do independent sessions of one rig give the same extrinsic?"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lce_rig.cli import show
from lce_rig.cli.options import json_option

if TYPE_CHECKING:
    from lce_rig.validation.repeatability import Repeatability


@click.command()
@click.argument("sessions", nargs=-1, type=click.Path(path_type=Path), metavar="SESSION...")
@json_option
def repeat(sessions: tuple[Path, ...], as_json: bool) -> None:
    """Compare the calibrations of two or more independent SESSIONs of one rig.

    The best test of an extrinsic: collect again, with the board put up anew, and see whether the results
    differ by no more than their stated uncertainties say. Errors that all sessions share do not show: those
    of the intrinsics, of the board's size, and constant ones of the LiDAR's ranges.

    A session that was not calibrated yet is calibrated for this; nothing is written. Exits with 7 where the
    calibrations disagree, or one of them failed by itself.
    """
    from lce_rig.core.errors import ResultRefusedError
    from lce_rig.pipeline.comparison import repeat as compare

    with show.progress_bar("reading") as progress:
        compared = compare(sessions, progress=progress)
    for name in compared.calibrated:
        show.note(f"{name} held no result: calibrated for this comparison, not written")
    for remark in compared.remarks:
        show.warn(remark)
    if as_json:
        pairs = [_document(comparison) for comparison in compared.comparisons]
        document = {"format_version": 1, "rig": compared.rig, "failed": list(compared.failed), "pairs": pairs}
        show.print_json(document)
    else:
        for comparison in compared.comparisons:
            show.print_table(_deviations(comparison))
            show.print_table(_differences(comparison))
            show.print_lines(_summary(comparison))
    if compared.failed:
        raise ResultRefusedError(
            f"the calibration of {', '.join(compared.failed)} failed by itself",
            "Its reasons stand in what `lce-rig calibrate` says.",
        )
    refused = [comparison for comparison in compared.comparisons if not comparison.agrees]
    if refused:
        raise ResultRefusedError(f"the calibrations of {', '.join(c.sensors for c in refused)} disagree")


def _deviations(comparison: "Repeatability") -> Any:
    import numpy as np

    table = show.plain_table(f"{comparison.sensors}: from the mean")
    table.add_column("session")
    for title in ("x mm", "y mm", "z mm", "about x deg", "about y deg", "about z deg"):
        table.add_column(title, justify="right")
    for name, tangent in zip(comparison.names, comparison.deviations, strict=True):
        cells = [f"{1000 * value:+.1f}" for value in tangent[:3]]
        cells += [f"{value:+.3f}" for value in np.degrees(tangent[3:])]
        table.add_row(show.escape(name), *cells)
    return table


def _differences(comparison: "Repeatability") -> Any:
    table = show.plain_table("each two")
    for title in ("first", "second", "deg", "mm", "distance", "chance"):
        table.add_column(title, justify="left" if title in ("first", "second") else "right")
    for pair in comparison.differences:
        figures = (f"{pair.rotation_deg:.3f}", f"{1000 * pair.translation_m:.1f}", f"{pair.distance:.1f}")
        table.add_row(show.escape(pair.first), show.escape(pair.second), *figures, f"{pair.p:.2g}")
    return table


def _summary(comparison: "Repeatability") -> list[str]:
    c = comparison
    lines = [
        "mean T_cam_lidar (p_cam = R p_lidar + t)",
        *("  " + "  ".join(f"{value: .6f}" for value in row) for row in c.T_cam_lidar[:3]),
        f"spread   {c.spread_rotation_deg:.3f} deg, {1000 * c.spread_translation_m:.1f} mm "
        "(1 sigma of one session)",
        f"claimed  {c.claimed_rotation_deg:.3f} deg, {1000 * c.claimed_translation_m:.1f} mm{_scatter(c)}",
        f"chi2     {c.chi2:.1f} with {c.dof} degrees of freedom, chance {c.p:.2g}",
    ]
    colour = "green" if c.agrees else "red"
    return [*lines, f"[{colour}]{show.escape(c.sentence())}[/]"]


def _scatter(comparison: "Repeatability") -> str:
    """Say which part of the claim can differ between sessions at all."""
    if comparison.scatter_rotation_deg is None or comparison.scatter_translation_m is None:
        return ""
    return (
        f", without what all sessions share {comparison.scatter_rotation_deg:.3f} deg, "
        f"{1000 * comparison.scatter_translation_m:.1f} mm"
    )


def _document(comparison: "Repeatability") -> dict[str, Any]:
    c = comparison
    return {
        "sensors": c.sensors,
        "sessions": list(c.names),
        "agrees": c.agrees,
        "sentence": c.sentence(),
        "T_cam_lidar": c.T_cam_lidar.tolist(),
        "deviations": c.deviations.tolist(),
        "spread_rotation_deg": c.spread_rotation_deg,
        "spread_translation_m": c.spread_translation_m,
        "claimed_rotation_deg": c.claimed_rotation_deg,
        "claimed_translation_m": c.claimed_translation_m,
        "scatter_rotation_deg": c.scatter_rotation_deg,
        "scatter_translation_m": c.scatter_translation_m,
        "chi2": c.chi2,
        "dof": c.dof,
        "p": c.p,
        "odd_one": c.odd_one,
        "differences": [vars(pair) for pair in c.differences],
    }
