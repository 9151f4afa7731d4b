"""`lce-rig intrinsics` of cameras, and `lce-rig lidar-intrinsics`, a LiDAR's constant errors."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np

from lce_rig.cli import show
from lce_rig.cli.options import (
    cameras_option,
    explain_option,
    json_option,
    names_option,
    path_option,
    require_sensors,
)
from lce_rig.core.errors import NotEnoughDataError, UsageError, join_shortages
from lce_rig.core.phrasing import as_line
from lce_rig.lens.models import MODELS
from lce_rig.pipeline.camera_intrinsics import (
    MeasuredIntrinsics,
    document,
    measure_intrinsics,
    write_intrinsics,
)
from lce_rig.pipeline.camera_intrinsics import save_profile as write_profile
from lce_rig.pipeline.measure_lidar import lidar_document, measure_lidar, save_lidar
from lce_rig.session import Session


@click.command()
@click.argument("sessions", nargs=-1, type=click.Path(path_type=Path), metavar="[SESSION]...")
@cameras_option
@names_option(
    "--channels", "Use these channels together, as they share the lens [default: those of kind frames]."
)
@click.option(
    "--model",
    type=click.Choice(list(MODELS)),
    help="Set the lens model [default: the profile's].",
)
@path_option(
    "--save-profile",
    "FILE",
    "Write the first session's profile to a new file, with the intrinsics that the boards determine better.",
)
@click.option("--force", is_flag=True, help="With --save-profile: write all estimated intrinsics.")
@explain_option
@json_option
def intrinsics(
    sessions: tuple[Path, ...],
    cameras: tuple[str, ...],
    channels: list[str] | None,
    model: str | None,
    save_profile: Path | None,
    force: bool,
    explain: bool,
    as_json: bool,
) -> None:
    """Estimate each camera's intrinsics from the boards in the images of SESSIONs (default: session/).

    Reports whether the profile's intrinsics still fit, and the weaknesses of the captures. Writes
    a camera_info file for each camera into intrinsics/ of the first SESSION. Exits with 6 if the
    captures are insufficient, with 7 if --save-profile has nothing better than the profile to write.

    Sessions of one camera share its lens: with the profile of all of them (--save-profile FILE
    --force, then `calibrate --rig FILE`) their extrinsics differ less.
    """
    every = [Session.open(path) for path in sessions or (Path("session"),)]
    opened = every[0]
    require_sensors("camera", cameras, opened.rig.cameras)
    if save_profile is not None and save_profile.exists():
        raise UsageError(f"{save_profile} exists already", "Choose another file; existing files are kept.")
    wanted, measured, troubles = channels or [], [], []
    for camera in cameras or tuple(opened.rig.cameras):
        try:
            with show.progress_bar(f"detecting in {camera}") as progress:
                measured.append(
                    measure_intrinsics(every, camera, channels=wanted, model=model, progress=progress)
                )
        except NotEnoughDataError as error:
            troubles.append(error)
    if not measured:
        raise troubles[0]
    files = write_intrinsics(opened, measured)
    described = document(opened.rig, measured)
    if as_json:
        show.print_json(described)
    else:
        for one in measured:
            is_followed = save_profile is not None and one.judgement.code == "intrinsics.better"
            advice = "" if is_followed else one.judgement.advice_at(*(str(each.path) for each in every))
            show.print_parts(_parts(one, advice))
    if explain and not as_json:
        show.print_figures(described)
    show.note(f"  files        {files[0].parent}/: {', '.join(path.name for path in files)}")
    if save_profile is not None:
        replaced = write_profile(opened, measured, save_profile, is_forced=force)
        show.note(f"  written      {save_profile}, with new intrinsics of {', '.join(replaced)}")
        for each in every:
            show.name_next("calibrate", each.path, f" --rig {save_profile}")
        for one in measured:
            if one.judgement.code != "intrinsics.better":
                how = "new intrinsics forced" if one.camera in replaced else "intrinsics kept"
                show.note(f"{one.camera}: {how}: {one.judgement.text}")
    if troubles:
        raise join_shortages(troubles)


def _parts(measured: MeasuredIntrinsics, advice: str) -> Iterator[str]:
    """State the judgement with its action, the fit, the intrinsics and the main weakness.

    Args:
        measured: estimated intrinsics of one camera.
        advice: the action, or "".
    """
    estimate, lens, judgement = measured.estimate, measured.intrinsics, measured.judgement
    covered = f"{100 * measured.certainty.covered:.0f}"
    colour = {"intrinsics.fit": "green", "intrinsics.better": "red"}.get(judgement.code, "yellow")
    yield f"[bold]{measured.camera}[/]: [{colour}]{show.escape(judgement.text)}[/]"
    if advice:
        yield f"  -> {show.escape(as_line(advice))}"
    if measured.check is None:
        size = f"{measured.given.width_px}x{measured.given.height_px}"
        yield f"  [red]the profile's intrinsics are for {size} px, the images have another size[/]"
    images = f"{len(estimate.views)} images of {', '.join(measured.channels)}"
    yield f"  estimate     {estimate.model.name}, {images}, {covered} % of the image covered"
    yield f"  corners      {estimate.rms_px:.3f} px rms, {estimate.held_out_rms_px:.3f} px on held-out ones"
    values = (f"{name} {getattr(lens, f'{name}_px'):.1f}" for name in ("fx", "fy", "cx", "cy"))
    yield f"  values       {', '.join(values)} px"
    if judgement.code != "intrinsics.fit":
        weaknesses = [text for text in measured.weaknesses if text not in judgement.sentence]
        yield from (f"  [yellow]{show.escape(text)}[/]" for text in weaknesses[:1])
        if len(weaknesses) > 1:
            yield f"  {len(weaknesses) - 1} more: with --explain"


@click.command(name="lidar-intrinsics")
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="SESSION...")
@click.option("--lidar", metavar="NAME", help="Choose the LiDAR [default: the profile's first].")
@path_option(
    "--save-profile", "FILE", "Write the first session's profile to a new file, with the estimated errors."
)
@explain_option
@json_option
def lidar_intrinsics(
    sessions: tuple[Path, ...], lidar: str | None, save_profile: Path | None, explain: bool, as_json: bool
) -> None:
    """Estimate the constant errors of a LiDAR from the boards of one or several SESSIONs.

    These are range, azimuth and elevation of each laser, the displacement of the beams' origin, and an
    offset of all ranges if significant (range_offset_m). Boards must have stood still. `calibrate`
    starts from the errors in the profile that --save-profile writes. Exits with 6 for too few captures, with
    7 if boards moved or captures do not determine the lasers' ranges.
    """
    if save_profile is not None and save_profile.exists():
        raise UsageError(f"{save_profile} exists already", "Choose another file; existing files are kept.")
    opened = [Session.open(path) for path in sessions]
    with show.progress_bar("detecting") as progress:
        errors = measure_lidar(opened, lidar, progress=progress)
    document = lidar_document(errors)
    if as_json:
        show.print_json(document)
    else:
        show.print_parts(_errors(document))
        if explain:
            show.print_figures(document)
    if save_profile is not None:
        save_lidar(opened[0], lidar, errors, save_profile)
        show.note(f"written: {save_profile}")


# Name, keys of a laser's row, factor to the printed unit, digits, unit.
_ERRORS = (
    ("range", "range_m", "range_sigma_m", 1000, 1, "mm"),
    ("azimuth", "azimuth_deg", "azimuth_sigma_deg", 1, 3, "deg"),
    ("elevation", "elevation_deg", "elevation_sigma_deg", 1, 3, "deg"),
)


def _errors(document: dict[str, Any]) -> Iterator[str]:
    """State the spread of each kind of error over the lasers, and the lens."""
    lasers, n_captures = document.get("lasers", ()), document["n_captures"]
    sessions = show.counted(len(n_captures), "session")
    of_lasers = f"{len(lasers)} lasers" if lasers else "too few for single lasers"
    yield f"{show.counted(sum(n_captures), 'capture')} of {sessions}, {of_lasers}"
    if document["range_offset_m"] is not None:
        offset, sigma = (1000 * document[f"range_offset{part}_m"] for part in ("", "_sigma"))
        yield f"  {'range offset':<13}{offset:+.1f} +- {sigma:.1f} mm, of all lasers"
    if not lasers:
        return
    for name, key, sigma_key, scale, digits, unit in _ERRORS:
        errors = [scale * row[key] for row in lasers]
        sigma = float(np.median([scale * row[sigma_key] for row in lasers]))
        spread = f"{min(errors):+.{digits}f} to {max(errors):+.{digits}f} {unit}"
        yield f"  {name:<13}{spread} (median standard deviation {sigma:.{digits}f} {unit})"
    for title, key, where in (
        ("lens", "lens_lateral{}_m", "beside the axis"),
        ("", "lens_vertical{}_m_per_rad", "per rad of elevation"),
    ):
        value, sigma = (1000 * document[key.format(part)] for part in ("", "_sigma"))
        yield f"  {title:<13}{value:+.1f} +- {sigma:.1f} mm {where}"
