"""`lce-rig fleet lidar`: the constant errors of a LiDAR from all its sessions in a registry."""

from pathlib import Path

import click

from lce_rig.cli import show
from lce_rig.cli.lidar_intrinsics import print_errors
from lce_rig.cli.options import json_option, registry_option


@click.command()
@registry_option
@click.option("--serial", metavar="S", help="Choose the LiDAR; without it, those with results are listed.")
@click.option(
    "--most",
    default=20,
    show_default=True,
    type=click.IntRange(1, 1000),
    metavar="N",
    help="Use the latest N sessions.",
)
@click.option(
    "--save-profile",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write the latest session's profile to a new file, with the estimated errors.",
)
@json_option
def lidar(registry: str, serial: str | None, most: int, save_profile: Path | None, as_json: bool) -> None:
    """Estimate a LiDAR's constant errors from its sessions in the registry, as `lidar-intrinsics` does.

    All captures of these sessions enter one joint estimate; the sessions must be on this computer and of one
    board. Sessions whose boards moved are not used. Exits with 6 and 7 like `lidar-intrinsics`.
    """
    from lce_rig.core.errors import UsageError
    from lce_rig.fleet.registry import Registry
    from lce_rig.fleet.shared_lidar import LIDAR_COLUMNS, serials, sessions_of
    from lce_rig.fleet.storage import Storage
    from lce_rig.pipeline.lidar_intrinsics import measure_lidar, save_lidar

    table = Registry(Storage.at(registry)).read_table(LIDAR_COLUMNS)
    if serial is None:
        listed = serials(table)
        if as_json:
            names = ("serial", "n_sessions", "n_robots")
            show.print_json({"lidars": [dict(zip(names, each, strict=True)) for each in listed]})
        else:
            shown = show.plain_table("", "serial", "sessions", "robots")
            for name, *counts in listed:
                shown.add_row(show.escape(name), *map(str, counts))
            show.print_table(shown)
        return
    if save_profile is not None and save_profile.exists():
        raise UsageError(f"{save_profile} exists already", "Choose another file; existing files are kept.")
    found = sessions_of(table, serial)
    for n, why in ((found.n_moving, "boards moved"), (found.n_elsewhere, "not on this computer")):
        if n:
            show.warn(f"{show.counted(n, 'session')} not used: {why}")
    sessions = found.sessions[-most:]
    with show.progress_bar("detecting") as progress:
        errors = measure_lidar(sessions, found.lidar, progress=progress)
    print_errors(errors, as_json=as_json)
    if save_profile is not None:
        save_lidar(sessions[-1], found.lidar, errors, save_profile)
        show.note(f"written: {save_profile}")
