"""`lce-rig lidar-intrinsics`: estimate a LiDAR's constant errors from the boards of sessions."""

from pathlib import Path
from typing import Any

import click
import numpy as np

from lce_rig.calibrate.likelihood.lidar_errors import LidarErrors
from lce_rig.cli import show
from lce_rig.cli.options import explain_option, json_option
from lce_rig.core.errors import UsageError
from lce_rig.pipeline.measure_lidar import measure_lidar, save_lidar
from lce_rig.session import Session


@click.command(name="lidar-intrinsics")
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="SESSION...")
@click.option("--lidar", metavar="NAME", help="Choose the LiDAR [default: the profile's first].")
@click.option(
    "--save-profile",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write the first session's profile to a new file, with the estimated errors.",
)
@explain_option
@json_option
def lidar_intrinsics(
    sessions: tuple[Path, ...], lidar: str | None, save_profile: Path | None, explain: bool, as_json: bool
) -> None:
    """Estimate the constant errors of a LiDAR from the boards of one or several SESSIONs.

    Prints the errors of range, azimuth and elevation of each laser and the displacement of the beams' origin,
    with standard deviations. The sessions' extrinsics may differ; boards must have stood still. With the
    profile written by --save-profile, `calibrate` of later sessions starts from these errors.
    Exits with 6 for too few captures, with 7 if boards moved or captures do not determine the lasers' ranges.
    """
    if save_profile is not None and save_profile.exists():
        raise UsageError(f"{save_profile} exists already", "Choose another file; existing files are kept.")
    opened = [Session.open(path) for path in sessions]
    with show.progress_bar("detecting") as progress:
        errors = measure_lidar(opened, lidar, progress=progress)
    document = _document(errors)
    show.print_json(document) if as_json else _print(document, is_explained=explain)
    if save_profile is not None:
        save_lidar(opened[0], lidar, errors, save_profile)
        show.note(f"written: {save_profile}")


def _print(document: dict[str, Any], *, is_explained: bool) -> None:
    mm, n_captures = 1e3, document["n_captures"]
    lateral, vertical = (
        f"{mm * document[f'lens_{value}']:+.1f} +- {mm * document[f'lens_{sigma}']:.1f} mm"
        for value, sigma in (
            ("lateral_m", "lateral_sigma_m"),
            ("vertical_m_per_rad", "vertical_sigma_m_per_rad"),
        )
    )
    lasers = document["lasers"]
    lines = [
        f"{show.counted(sum(n_captures), 'capture')} of {show.counted(len(n_captures), 'session')}, "
        f"{len(lasers)} lasers"
    ]
    for name, key, scale, digits, unit in (
        ("range", "range{}_m", mm, 1, "mm"),
        ("azimuth", "azimuth{}_deg", 1.0, 3, "deg"),
        ("elevation", "elevation{}_deg", 1.0, 3, "deg"),
    ):
        errors = [scale * row[key.format("")] for row in lasers]
        sigma = float(np.median([scale * row[key.format("_sigma")] for row in lasers]))
        lines.append(
            f"  {name:<13}{min(errors):+.{digits}f} to {max(errors):+.{digits}f} {unit} "
            f"(median standard deviation {sigma:.{digits}f} {unit})"
        )
    show.print_lines(
        [*lines, f"  {'lens':<13}{lateral} beside the axis", f"  {'':<13}{vertical} per rad of elevation"]
    )
    if not is_explained:
        return
    angles = (">azimuth deg", ">sigma", ">elevation deg", ">sigma")
    table = show.plain_table("", ">laser", ">range mm", ">sigma", *angles, ">returns")
    for row in document["lasers"]:
        cells = [f"{row['ring']}", f"{mm * row['range_m']:+.1f}", f"{mm * row['range_sigma_m']:.1f}"]
        for angle in ("azimuth", "elevation"):
            cells += [f"{row[f'{angle}_deg']:+.3f}", f"{row[f'{angle}_sigma_deg']:.3f}"]
        table.add_row(*cells, f"{row['n_points']}")
    show.print_table(table)


def _document(errors: LidarErrors) -> dict[str, Any]:
    estimate = errors.found
    values, sigmas = estimate.lasers.copy(), estimate.lasers_sigma.copy()
    values[1:], sigmas[1:] = np.degrees(values[1:]), np.degrees(sigmas[1:])
    lasers = []
    for k, ring in enumerate(estimate.rings.tolist()):
        row: dict[str, Any] = {"ring": ring, "n_points": int(errors.n_points[k])}
        row |= zip(("range_m", "azimuth_deg", "elevation_deg"), values[:, k].tolist(), strict=True)
        row |= zip(
            ("range_sigma_m", "azimuth_sigma_deg", "elevation_sigma_deg"), sigmas[:, k].tolist(), strict=True
        )
        lasers.append(row)
    return {
        "n_captures": list(errors.n_captures),
        "lens_lateral_m": float(estimate.lens[0]),
        "lens_lateral_sigma_m": float(estimate.lens_sigma[0]),
        "lens_vertical_m_per_rad": float(estimate.lens[1]),
        "lens_vertical_sigma_m_per_rad": float(estimate.lens_sigma[1]),
        "lasers": lasers,
    }
