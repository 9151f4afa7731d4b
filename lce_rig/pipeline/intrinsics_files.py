"""Write measured intrinsics as files: a block for the profile, a new profile, camera_info, plots."""

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.calibration import MADE_BY
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import ResultRefusedError, UsageError
from lce_rig.core.files import read_json
from lce_rig.core.phrasing import significant
from lce_rig.export.ros_files import camera_info_text
from lce_rig.export.writing import number, numbers
from lce_rig.judge.findings import verdict_of
from lce_rig.pipeline.measure_intrinsics import MeasuredIntrinsics
from lce_rig.pipeline.result_files import keep_foreign
from lce_rig.rig import Rig, parse_rig, set_value
from lce_rig.session import Session
from lce_rig.session.durable import replacing, write_atomically
from lce_rig.session.session import INTRINSICS

DOCUMENT = "intrinsics.json"
FORMAT_VERSION = 1


def write_intrinsics(session: Session, measured: Sequence[MeasuredIntrinsics]) -> list[Path]:
    """Write the session's intrinsics/ in one step.

    For each camera a block to paste into the profile, a camera_info file and a page of plots; and
    intrinsics.json for machines. Other files there stay, as those of cameras that an earlier run measured.

    Returns:
        The files of this run.

    Raises:
        LceRigError: a file cannot be written; earlier ones are unchanged.
    """
    from lce_rig.show.overlays.intrinsics_plot import draw_intrinsics
    from lce_rig.show.overlays.overlay_files import write_picture

    names = [DOCUMENT]

    def finish(earlier: Path, draft: Path) -> None:
        content = document(session.rig, measured)
        with suppress(OSError, ValueError, KeyError, TypeError):  # no entries of an earlier run, or damaged
            others = read_json(earlier / DOCUMENT)["cameras"]
            cameras = {one.camera for one in measured}
            content["cameras"] += [other for other in others if other["camera"] not in cameras]
        write_atomically(draft / DOCUMENT, json.dumps(content, indent=2) + "\n")
        keep_foreign(earlier, draft, lambda path: path.name in names)

    with replacing(session.path, session.path / INTRINSICS, finish) as draft:
        for one in measured:
            block, info, page = f"{one.camera}.yaml", f"camera_info_{one.camera}.yaml", f"{one.camera}.png"
            write_atomically(draft / block, profile_block(session.rig, one))
            head = _head(session.rig, one)
            write_atomically(draft / info, camera_info_text(one.camera, one.intrinsics, head))
            title, notes = f"Intrinsics of camera {one.camera}, rig {session.rig.name}", one.weaknesses
            plot = draw_intrinsics(one.estimate, one.certainty, title=title, weaknesses=notes)
            write_picture(draft / page, plot)
            names += [block, info, page]
    return [session.path / INTRINSICS / name for name in names]


def profile_block(rig: Rig, measured: MeasuredIntrinsics) -> str:
    """Write the camera's block `intrinsics:`, indented for pasting into a profile."""
    lens, sigma = measured.intrinsics, measured.estimate.sigma
    lines = [f"# {line}" for line in _head(rig, measured)]
    lines += [
        f"# In the profile this block belongs to cameras.{measured.camera}, whose images have",
        f"#   resolution_px: [{lens.width_px}, {lens.height_px}]",
        "    intrinsics:",
        f"      model: {lens.model}",
    ]
    for index, key in enumerate(("fx_px", "fy_px", "cx_px", "cy_px")):
        lines.append(f"      {key}: {number(getattr(lens, key))}   # +- {significant(sigma[index])}")
    names = " ".join(measured.estimate.model.coefficients)
    spread = " ".join(f"{value:.1g}" for value in sigma[4:])
    lines.append(f"      distortion: {numbers(lens.distortion)}   # {names}, +- {spread}")
    lines += [f"      {key}: {value:g}" for key, value in measured.deviations().items()]
    return "\n".join(lines) + "\n"


def save_profile(
    session: Session, measured: Sequence[MeasuredIntrinsics], path: Path, *, is_forced: bool = False
) -> tuple[str, ...]:
    """Write the session's profile with the intrinsics that the session determines better, and its comments.

    Args:
        session: whose profile.
        measured: intrinsics from its boards.
        path: of the new profile.
        is_forced: write all of them.

    Returns:
        The cameras whose intrinsics were replaced.

    Raises:
        UsageError: the file exists already.
        ResultRefusedError: the session determines none better than its profile; nothing is written.
        ProfileError: the intrinsics make no valid profile.
    """
    refused = [one for one in measured if one.judgement.code != "intrinsics.better" and not is_forced]
    measured = [one for one in measured if one not in refused]
    if not measured:
        command = f"lce-rig intrinsics {session.path} --save-profile {path} --force"
        raise ResultRefusedError(
            f"{path} is not written: the session determines no intrinsics better than the profile",
            f"To write them nevertheless: {command}",
        )
    text = session.profile_text()
    for one in measured:
        lens, block = one.intrinsics, f"cameras.{one.camera}"
        if (lens.width_px, lens.height_px) != session.rig.cameras[one.camera].resolution_px:
            text = set_value(text, f"{block}.resolution_px", f"[{lens.width_px}, {lens.height_px}]")
        for key in ("fx_px", "fy_px", "cx_px", "cy_px"):
            text = set_value(text, f"{block}.intrinsics.{key}", number(getattr(lens, key)))
        for key, value in one.deviations().items():
            text = set_value(text, f"{block}.intrinsics.{key}", f"{value:g}")
        text = set_value(text, f"{block}.intrinsics.model", lens.model)
        text = set_value(text, f"{block}.intrinsics.distortion", numbers(lens.distortion))
    head = "".join(f"# {line}\n" for one in measured for line in _head(session.rig, one))
    write_profile(head + text, path)
    return tuple(one.camera for one in measured)


def write_profile(text: str, path: Path) -> None:
    """Write the text of a valid profile to a new file.

    Raises:
        UsageError: the file exists already.
        ProfileError: the profile is not valid.
    """
    if path.exists():
        raise UsageError(f"{path} exists already", "Choose another file; existing files are kept.")
    parse_rig(text, str(path))
    write_atomically(path, text)


def _head(rig: Rig, measured: MeasuredIntrinsics) -> list[str]:
    estimate = measured.estimate
    n = len({view.capture for view in estimate.views})
    return [
        f"intrinsics of camera {measured.camera} of rig {rig.name}, measured by {MADE_BY} from {n} captures",
        f"reprojection error {estimate.rms_px:.3f} px rms, {estimate.held_out_rms_px:.3f} px on held-out "
        "captures",
        *(f"weak: {text}" for text in measured.weaknesses),
    ]


def document(rig: Rig, measured: Sequence[MeasuredIntrinsics]) -> dict[str, Any]:
    """Build the content of intrinsics.json from plain types; figures that could not be computed are null."""
    return {
        "format_version": FORMAT_VERSION,
        "rig": rig.name,
        "made_by": MADE_BY,
        "cameras": [*map(_camera, measured)],
    }


def _camera(measured: MeasuredIntrinsics) -> dict[str, Any]:
    """List one camera's intrinsics; its profile's are null if they are for another resolution."""
    estimate, lens = measured.estimate, measured.intrinsics
    check, difference = measured.check, measured.difference
    profile = None
    if check is not None and difference is not None:
        profile = {
            "intrinsics": _settings(measured.given),
            **{name: _figure(value) for name, value in asdict(check).items()},
            "displacement_max_px": _figure(difference.max_px),
            "turn_rad": np.asarray(difference.turn_rad).tolist(),
            "verdict": verdict_of([] if measured.misfit is None else [measured.misfit]),
        }
    return {
        "camera": measured.camera,
        "channels": list(measured.channels),
        "model": estimate.model.name,
        "resolution_px": [lens.width_px, lens.height_px],
        "intrinsics": _settings(lens),
        "parameters": list(estimate.model.parameters),
        "sigma": estimate.sigma.tolist(),
        "cov": estimate.cov.tolist(),
        "inflation": estimate.inflation,
        "rms_px": estimate.rms_px,
        "held_out_px": estimate.held_out_rms_px,
        "board": {
            "bow_m": estimate.pattern_shape[0][:2].tolist(),
            "aspect": float(estimate.pattern_shape[0][2]),
            "sigma": estimate.pattern_shape[1].tolist(),
            "print_rms_m": estimate.print_rms_m,
        },
        "covered": float(measured.certainty.is_covered.mean()),
        "judgement": measured.judgement.as_json(),
        "weaknesses": list(measured.weaknesses),
        "views_used": [view.name for view in estimate.views],
        "views_refused": {name: why.as_json() for name, why in measured.refused.items()},
        "profile": profile,
    }


def _settings(lens: Intrinsics) -> dict[str, Any]:
    pixels = {key: getattr(lens, key) for key in ("fx_px", "fy_px", "cx_px", "cy_px")}
    return {"model": lens.model, **pixels, "distortion": list(lens.distortion)}


def _figure(value: float | None) -> float | None:
    """Return null for a figure that is not finite, as when the profile's intrinsics project nothing."""
    return value if value is not None and np.isfinite(value) else None
