"""The text of a new profile from its parts: sensors, lenses, board; nothing of another rig."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data_sheets import TYPICAL, VLP_16, find_data_sheet
from lce_rig.rig.editing import as_text
from lce_rig.rig.loading import read_document, rig_from_document


class LidarDraft(NamedTuple):
    """A LiDAR of the new profile.

    Attributes:
        name: in the profile.
        model: maker's name of the model.
        frame: of its points; None for the usual one.
        topic: in bags.
        rate_hz: scans per second; None for the default.
        sees: what is known of it beside, as a comment, such as "64 rings in the recording".
        elevations_deg: of the rings, lowest first, as measured; empty where they are the model's or unknown.
        columns: firings of each ring per revolution, as measured; None where they are the model's or unknown.
    """

    name: str = "lidar"
    model: str = VLP_16.name
    frame: str | None = None
    topic: str | None = None
    rate_hz: float | None = None
    sees: str = ""
    elevations_deg: Sequence[float] = ()
    columns: int | None = None


class CameraDraft(NamedTuple):
    """A camera of the new profile.

    Attributes:
        name: in the profile.
        intrinsics: of its images.
        optical_frame: None for the usual one.
        channels: at least one: kind, "frames" or "events", and topic in bags.
    """

    name: str
    intrinsics: Intrinsics
    optical_frame: str | None = None
    channels: Sequence[tuple[Literal["frames", "events"], str | None]] = (("frames", None),)


def draft_profile(
    name: str, lidars: Sequence[LidarDraft], cameras: Sequence[CameraDraft], board: Board, source: str
) -> str:
    """Write the text of a profile.

    Args:
        name: of the rig.
        lidars: at least one.
        cameras: at least one.
        board: as it was measured.
        source: what to call the text in errors.

    Raises:
        ProfileError: the parts do not make a valid profile.
    """
    lines = [
        f"# {name}: written by `lce-rig rigs new`; `lce-rig rigs show FILE` shows every setting.",
        "format_version: 1",
        f"name: {as_text(name)}",
        "",
        "board:                            # measure it; do not rely on the CAD model",
        f"  inner_corners: [{board.cols}, {board.rows}]           "
        "# where four squares meet: [along the width, along the height]",
        f"  square_m: {board.square_m}",
        f"  width_m: {board.width_m}",
        f"  height_m: {board.height_m}",
        f"  pattern_offset_m: [{board.pattern_offset_m[0]}, {board.pattern_offset_m[1]}]"
        "    # pattern's centre from the plate's centre: [right, up]",
        f"  square_sigma_m: {board.square_m / 1000:.2g}      # standard deviation of square_m",
        "  pattern_offset_sigma_m: 0.003  # of each coordinate of pattern_offset_m",
        "  plate_sigma_m: 0.002           # of width_m and height_m",
        "  bow_sigma_m: 0.001             # of the height of the plate's middle over its ends",
        "",
        "lidars:",
    ]
    for lidar in lidars:
        lines += _lidar(lidar)
    lines += ["", "cameras:"]
    for camera in cameras:
        lines += _camera(camera)
    text = "\n".join(lines) + "\n"
    # Nobody has seen the text yet: errors name keys, not its lines.
    rig_from_document(replace(read_document(text, source), root=None))
    return text


def _lidar(lidar: LidarDraft) -> list[str]:
    model = f"    model: {as_text(lidar.model)}"
    return [
        f"  {lidar.name}:",
        f"{model:<34}# {lidar.sees}" if lidar.sees else model,
        f"    frame: {lidar.frame or f'{lidar.name}_link'}",
        *([f"    topic: {lidar.topic}"] if lidar.topic else []),
        *([f"    rate_hz: {lidar.rate_hz:g}"] if lidar.rate_hz else []),
        *_beams(lidar),
        "    timestamps:",
        "      clock: host                 # device, host or utc",
        "      reference: first_firing     # or last_firing, as some drivers timestamp",
        "      sync: none                  # hardware (shared pulse), ptp or none",
    ]


def _beams(lidar: LidarDraft) -> list[str]:
    """Give the beams as measured and, of an unknown model, what is typical to be replaced."""
    lines = []
    if lidar.elevations_deg:
        values = [f"{each:.2f}" for each in lidar.elevations_deg]
        rows = [", ".join(values[k : k + 12]) for k in range(0, len(values), 12)]
        lines += ["    elevations_deg: [               # of the rings, as recorded"]
        lines += [f"      {row}," for row in rows] + ["    ]"]
    if lidar.columns is not None:
        lines.append(f"    columns: {lidar.columns}")
    if find_data_sheet(lidar.model) is None:
        lines += [
            f"    laser_bias_sigma_m: {TYPICAL.laser_bias_sigma_m}     # these four are typical: enter your "
            "LiDAR's",
            f"    range_offset_sigma_m: {TYPICAL.range_offset_sigma_m}",
            f"    beam_aperture_m: {TYPICAL.aperture_m}",
            f"    beam_divergence_rad: {TYPICAL.divergence_rad[0]}",
        ]
    return lines


def _camera(camera: CameraDraft) -> list[str]:
    lens = camera.intrinsics
    lines = [
        f"  {camera.name}:",
        f"    frame: {camera.name}_link",
        f"    optical_frame: {camera.optical_frame or f'{camera.name}_optical_frame'}",
        f"    resolution_px: [{lens.width_px}, {lens.height_px}]",
        "    intrinsics:",
        f"      model: {lens.model}",
        *(f"      {key}: {getattr(lens, key):.10g}" for key in ("fx_px", "fy_px", "cx_px", "cy_px")),
        f"      distortion: [{', '.join(f'{value:.10g}' for value in lens.distortion)}]",
        "    channels:",
    ]
    for kind, topic in camera.channels:
        lines += [
            f"      {kind}:",
            f"        kind: {kind}",
            *([f"        topic: {topic}"] if topic else []),
            "        timestamps:",
            "          clock: host",
            "          reference: mid_exposure # or start",
            "          sync: none",
        ]
    return lines
