"""Data sheet figures of LiDARs: beams, timing, noise. No other module contains such figures.

The table is `data_sheets.json`, an object of `DataSheet`'s attributes for each model. The simulator, the
guidance, a profile's defaults and `lce-rig rigs new` read it. Every entry names its sources and its
estimates; docs/rig-profiles.md lists which figures were compared with a document or a
unit. Rings of a single unit differ from its model's by hundredths of a degree: `elevations_deg` in a profile
replaces them.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lce_rig.core.geometry import Array

# Angle between neighbouring lines and returns of a LiDAR without rings, deg, for the guidance's predictions.
_LINE_DEG = 0.5


@dataclass(frozen=True)
class DataSheet:
    """One model of a LiDAR.

    Attributes:
        name: the maker's name of the model.
        source: origin of the figures.
        elevations_deg: elevations of each laser, in firing order; empty without rings.
        sequence_ns: time between two firings of one laser; None where the maker fixes `columns` instead.
        columns: firings of each laser per revolution, if they do not depend on the rate.
        firing_ns: time between two groups of lasers of one sequence.
        n_at_once: lasers that fire together.
        azimuths_deg: azimuth of each laser relative to the rotor, towards growing azimuth (Velodyne and
            Hesai count the other way); empty for none.
        heights_mm: height of each laser's optical centre; empty for none.
        origin_radius_m: distance of the optical centres from the axis, along the rotor's direction.
        range_m: nearest and farthest return.
        rates_hz: slowest and fastest revolutions per second.
        range_step_m: resolution of ranges.
        range_sigma_m: white noise of a range on a diffuse surface indoors.
        laser_bias_sigma_m: spread of the lasers' constant range errors about their mean.
        range_offset_sigma_m: standard deviation of that mean.
        aperture_m: width of the beam at the sensor.
        divergence_rad: full angle of the beam, horizontal and vertical.
        rim_m: least distance beyond half of that width at which an edge still returns; the VLP-16's is from
            recorded boards, whose returns reach 9 to 10 mm beyond a border.
        exit_m: size of the beam at its exit, horizontal and vertical, as the simulator spreads its energy.
        pattern: how its beams sweep the field of view: in "rings", as a "rosette", as the "mid360" does, or
            in any other way ("any").
        fov_deg: width of the field of view, and its lowest and highest elevation.
        points_hz: returns per second, of LiDARs without rings.
        aliases: other names.
        estimated: attributes that no maker publishes: typical values, or those of a similar model.
    """

    name: str
    source: str
    elevations_deg: tuple[float, ...]
    sequence_ns: int | None = None
    columns: int | None = None
    firing_ns: int = 0
    n_at_once: int = 1
    azimuths_deg: tuple[float, ...] = ()
    heights_mm: tuple[float, ...] = ()
    origin_radius_m: float = 0.0
    range_m: tuple[float, float] = (0.4, 100.0)
    rates_hz: tuple[float, float] = (5.0, 20.0)
    range_step_m: float = 0.002
    range_sigma_m: float = 0.010
    laser_bias_sigma_m: float = 0.008
    range_offset_sigma_m: float = 0.005
    aperture_m: float = 0.010
    divergence_rad: tuple[float, float] = (0.003, 0.003)
    rim_m: float = 0.0
    exit_m: tuple[float, float] = (0.010, 0.010)
    pattern: Literal["rings", "rosette", "mid360", "any"] = "rings"
    fov_deg: tuple[float, float, float] = (360.0, -90.0, 90.0)
    points_hz: int = 0
    aliases: tuple[str, ...] = ()
    estimated: tuple[str, ...] = ()

    @property
    def has_rings(self) -> bool:
        """Whether the beams sweep cones about the LiDAR's axis."""
        return self.pattern == "rings"

    @property
    def n_rings(self) -> int:
        """Number of lasers."""
        return len(self.elevations_deg)

    @property
    def rings_rad(self) -> Array:
        """The elevation of each ring (L,), from the lowest.

        Without rings, virtual lines with the density of the returns, for the guidance's predictions.
        """
        if not self.has_rings:
            low, high = self.fov_deg[1:]
            return np.asarray(np.radians(np.linspace(low, high, max(int((high - low) / _LINE_DEG), 2))))
        return np.asarray(np.radians(np.sort(self.elevations_deg)))

    def step_rad(self, rate_hz: float) -> float:
        """Return the rotor's rotation between two firings of one laser."""
        if not self.has_rings:
            return float(np.radians(_LINE_DEG))
        if self.sequence_ns is None:
            return 2 * np.pi / (self.columns or 1)
        return 2 * np.pi * self.sequence_ns * 1e-9 * rate_hz

    def with_rings(self, elevations_deg: tuple[float, ...] | None, columns: int | None) -> "DataSheet":
        """Replace the beams by those of an individual unit; None keeps the model's."""
        sheet = self
        if elevations_deg is not None:
            sheet = replace(sheet, elevations_deg=elevations_deg, azimuths_deg=(), heights_mm=())
        return sheet if columns is None else replace(sheet, columns=columns, sequence_ns=None)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


DATA_SHEETS: tuple[DataSheet, ...] = tuple(
    DataSheet(**{name: _tuples(value) for name, value in sheet.items()})
    for sheet in json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))
)
"""Every model that is known."""
VLP_16 = DATA_SHEETS[0]
TYPICAL = DataSheet(name="other", source="typical of spinning LiDARs", elevations_deg=(), columns=1800)
"""Noise and beam of a LiDAR whose model is not known."""


def find_data_sheet(model: str) -> DataSheet | None:
    """Find a model by name in any spelling; None if unknown.

    "VLP-16", "vlp16" and "Velodyne VLP 16 (Puck)" are one model; words after a known name are ignored.
    """
    words = model.split()
    names = (" ".join(words[:n]) for n in range(len(words), 0, -1))
    return next((_BY_NAME[_plain(name)] for name in names if _plain(name) in _BY_NAME), None)


def _plain(name: str) -> str:
    word = "".join(c for c in name.lower() if c.isalnum())
    for maker in ("velodyne", "ouster", "hesai", "robosense", "livox"):
        word = word.removeprefix(maker)
    return word


_BY_NAME = {_plain(name): sheet for sheet in DATA_SHEETS for name in (sheet.name, *sheet.aliases)}
