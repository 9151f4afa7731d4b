"""What makers publish of their spinning LiDARs: beams, timing, noise. The only place with such figures.

The simulator, the guidance, a profile's defaults and `lce-rig rigs new` read this table. Every entry names
where its figures are published, and what in it is an estimate; docs/rig-profiles.md says which were compared
with a document or a unit. Rings of a single unit differ from its model's by hundredths of a
degree: `elevations_deg` in a profile replaces them.
"""

from dataclasses import dataclass, replace

import numpy as np

from lce_rig.core.geometry import Array

_FWHM = np.pi / 180


@dataclass(frozen=True)
class DataSheet:
    """One model of a spinning LiDAR.

    Attributes:
        name: the maker's.
        source: where the figures are from.
        elevations_deg: of each laser, in firing order.
        sequence_ns: time between two firings of one laser; None where the maker fixes `columns` instead.
        columns: firings of each laser per revolution, where they do not depend on the rate.
        firing_ns: time between two groups of lasers of one sequence.
        n_at_once: lasers that fire together.
        azimuths_deg: of each laser from the rotor's, towards growing azimuth; empty for none.
        heights_mm: of each laser's optical centre; empty for none.
        origin_radius_m: distance of the optical centres from the axis, along the rotor's direction.
        range_m: nearest and farthest return.
        rates_hz: slowest and fastest revolutions per second.
        range_step_m: resolution of ranges.
        range_sigma_m: white noise of a range on a diffuse surface indoors.
        laser_bias_sigma_m: spread of the lasers' constant range errors about their mean.
        range_offset_sigma_m: standard deviation of that mean.
        aperture_m: width of the beam where it leaves the sensor.
        divergence_rad: full angle by which it widens, horizontal and vertical.
        rim_m: by how much further than half of that width an edge still returns, at least.
        exit_m: size of the beam at its exit, horizontal and vertical, as the simulator spreads its energy.
        aliases: other names.
        estimated: attributes that no maker publishes: typical values, or those of a like model.
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
    aliases: tuple[str, ...] = ()
    estimated: tuple[str, ...] = ()

    @property
    def n_rings(self) -> int:
        """How many lasers it has."""
        return len(self.elevations_deg)

    @property
    def rings_rad(self) -> Array:
        """The elevation of each ring (L,), from the lowest."""
        return np.asarray(np.radians(np.sort(self.elevations_deg)))

    def step_rad(self, rate_hz: float) -> float:
        """Give the turn of the rotor between two firings of one laser."""
        if self.sequence_ns is None:
            return 2 * np.pi / (self.columns or 1)
        return 2 * np.pi * self.sequence_ns * 1e-9 * rate_hz

    def with_rings(self, elevations_deg: tuple[float, ...] | None, columns: int | None) -> "DataSheet":
        """Exchange the beams for those of a single unit; None keeps the model's."""
        sheet = self
        if elevations_deg is not None:
            sheet = replace(sheet, elevations_deg=elevations_deg, azimuths_deg=(), heights_mm=())
        return sheet if columns is None else replace(sheet, columns=columns, sequence_ns=None)


_NOISE = ("range_sigma_m", "laser_bias_sigma_m", "range_offset_sigma_m")
_SPOT = ("aperture_m", "divergence_rad", "rim_m", "exit_m")

VLP_16 = DataSheet(
    name="VLP-16",
    aliases=("Puck", "Puck LITE"),
    source="VLP-16 User Manual 63-9243 Rev. D, tables 9-1 (beams), 2-1 (ranges), appendix C (beam)",
    elevations_deg=(-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15),
    heights_mm=(11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2),
    firing_ns=2_304,
    sequence_ns=55_296,
    aperture_m=0.0127,
    divergence_rad=(0.0030, 0.0015),
    # Recorded boards: returns reach 9 to 10 mm beyond a border.
    rim_m=0.004,
    estimated=("range_sigma_m", "laser_bias_sigma_m", "range_offset_sigma_m", "rim_m", "exit_m"),
)
_PUCK_HI_RES = replace(
    VLP_16,
    name="Puck Hi-Res",
    aliases=("VLP-16 Hi-Res", "VLP-16HR", "VLP16HiRes"),
    source="VLP-16 User Manual 63-9243 Rev. D, appendix on the Puck Hi-Res; VeloView's calibration file",
    elevations_deg=(
        -10, 0.667, -8.667, 2, -7.333, 3.333, -6, 4.667, -4.667, 6, -3.333, 7.333, -2, 8.667, -0.667, 10,
    ),
    heights_mm=(7.4, -0.9, 6.5, -1.8, 5.5, -2.7, 4.6, -3.7, 3.7, -4.6, 2.7, -5.5, 1.8, -6.5, 0.9, -7.4),
)  # fmt: skip
_HDL32E = replace(
    VLP_16,
    name="HDL-32E",
    aliases=(),
    source="HDL-32E User's Manual 63-9113 Rev. H, laser firing sequence; data sheet",
    elevations_deg=tuple(
        round(low + k * 4 / 3, 2) for k in range(16) for low in (-92 / 3, -28 / 3)
    ),
    heights_mm=(),
    firing_ns=1_152,
    sequence_ns=46_080,
    estimated=(*_NOISE, *_SPOT),
)  # fmt: skip
_VLP32C = replace(
    VLP_16,
    name="VLP-32C",
    aliases=("Ultra Puck",),
    source="VLP-32C User Manual 63-9325 Rev. B, table 9-1; VeloView's calibration file",
    elevations_deg=(
        -25, -1, -1.667, -15.639, -11.31, 0, -0.667, -8.843, -7.254, 0.333, -0.333, -6.148, -5.333, 1.333,
        0.667, -4, -4.667, 1.667, 1, -3.667, -3.333, 3.333, 2.333, -2.667, -3, 7, 4.667, -2.333, -2, 15,
        10.333, -1.333,
    ),
    # Velodyne counts clockwise, the frame's azimuth grows the other way.
    azimuths_deg=(
        1.4, -4.2, 1.4, -1.4, 1.4, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4, -1.4, 4.2, -1.4, 4.2, -1.4, 1.4, -4.2,
        1.4, -4.2, 4.2, -1.4, 1.4, -1.4, 1.4, -1.4, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4,
    ),
    heights_mm=(),
    n_at_once=2,
    range_m=(0.5, 200.0),
    range_step_m=0.004,
    estimated=(*_NOISE, *_SPOT),
)  # fmt: skip
_ALPHA_AZIMUTHS = (6.354, 4.548, 2.732, 0.911, -0.911, -2.732, -4.548, -6.354)
_VLS128 = replace(
    _VLP32C,
    name="VLS-128",
    aliases=("Alpha Prime",),
    source="VLS-128 User Manual 63-9483, appendix F (beam); VeloView's calibration file",
    elevations_deg=(
        -11.742, -1.99, 3.4, -5.29, -0.78, 4.61, -4.08, 1.31, -6.5, -1.11, 4.28, -4.41, 0.1, 6.48, -3.2, 2.19,
        -3.86, 1.53, -9.244, -1.77, 2.74, -5.95, -0.56, 4.83, -2.98, 2.41, -6.28, -0.89, 3.62, -5.07, 0.32,
        7.58, -0.34, 5.18, -3.64, 1.75, -25, -2.43, 2.96, -5.73, 0.54, 9.7, -2.76, 2.63, -7.65, -1.55, 3.84,
        -4.85, 3.18, -5.51, -0.12, 5.73, -4.3, 1.09, -16.042, -2.21, 4.06, -4.63, 0.76, 15, -3.42, 1.97,
        -6.85, -1.33, -5.62, -0.23, 5.43, -3.53, 0.98, -19.582, -2.32, 3.07, -4.74, 0.65, 11.75, -2.65, 1.86,
        -7.15, -1.44, 3.95, -2.1, 3.29, -5.4, -0.01, 4.5, -4.19, 1.2, -13.565, -1.22, 4.17, -4.52, 0.87, 6.08,
        -3.31, 2.08, -6.65, 1.42, -10.346, -1.88, 3.51, -6.06, -0.67, 4.72, -3.97, 2.3, -6.39, -1, 4.39,
        -5.18, 0.21, 6.98, -3.09, 4.98, -3.75, 1.64, -8.352, -2.54, 2.85, -5.84, -0.45, 8.43, -2.87, 2.52,
        -6.17, -1.66, 3.73, -4.96, 0.43,
    ),
    azimuths_deg=16 * _ALPHA_AZIMUTHS,
    firing_ns=2_665,
    sequence_ns=53_300,
    n_at_once=8,
    range_m=(0.5, 245.0),
)  # fmt: skip


def _ouster(
    name: str, n: int, top_deg: float, bottom_deg: float, like: DataSheet, source: str = ""
) -> DataSheet:
    """Spread an Ouster's lasers evenly; they look into four directions in turn."""
    spacing_deg = 360 / 256
    return replace(
        like,
        name=name,
        source=source or like.source,
        elevations_deg=tuple(np.round(np.linspace(top_deg, bottom_deg, n), 3).tolist()),
        azimuths_deg=(n // 4) * (3 * spacing_deg, spacing_deg, -spacing_deg, -3 * spacing_deg),
        n_at_once=n,
    )


_OS0 = DataSheet(
    name="OS0",
    source="Ouster OS0 data sheet (field of view, columns, beam, ranges); metadata of units (lens radius)",
    elevations_deg=(),
    columns=1024,
    origin_radius_m=0.02767,
    range_m=(0.3, 75.0),
    rates_hz=(10.0, 20.0),
    range_step_m=0.001,
    range_sigma_m=0.015,
    laser_bias_sigma_m=0.005,
    aperture_m=0.005,
    divergence_rad=(0.35 * _FWHM, 0.35 * _FWHM),
    exit_m=(0.005, 0.005),
    estimated=("azimuths_deg", "laser_bias_sigma_m", "range_offset_sigma_m", "rim_m"),
)
_OS1 = replace(
    _OS0,
    name="OS1",
    source="Ouster OS1 data sheet (field of view, columns, beam, ranges); metadata of units (lens radius)",
    origin_radius_m=0.015806,
    range_m=(0.5, 200.0),
    range_sigma_m=0.010,
    aperture_m=0.0095,
    divergence_rad=(0.18 * _FWHM, 0.18 * _FWHM),
    exit_m=(0.0095, 0.0095),
)
_RECORDED = "elevations of a recorded OS1-64; the rest as the OS1 data sheet"

_XT32 = DataSheet(
    name="XT32",
    aliases=("PandarXT", "PandarXT-32", "Pandar XT32", "Hesai XT32"),
    source="Hesai PandarXT user manual, 1.3 (channels), specifications (ranges, accuracy, 0.18 deg at 10 Hz)",
    elevations_deg=tuple(float(15 - k) for k in range(32)),
    sequence_ns=50_000,
    firing_ns=1_512,
    range_m=(0.3, 120.0),
    range_step_m=0.004,
    range_sigma_m=0.005,
    laser_bias_sigma_m=0.005,
    estimated=("firing_ns", "laser_bias_sigma_m", "range_offset_sigma_m", *_SPOT),
)
_XT16 = replace(
    _XT32,
    name="XT16",
    aliases=("PandarXT-16", "Pandar XT16", "Hesai XT16"),
    source="Hesai PandarXT-16 user manual, 1.3 (channels) and specifications",
    elevations_deg=tuple(float(15 - 2 * k) for k in range(16)),
)
_PANDAR_40P = DataSheet(
    name="Pandar40P",
    aliases=("Pandar 40P", "Pandar40"),
    source="Hesai's angle file of the Pandar40P (beams); user manual (0.2 deg at 10 Hz, ranges)",
    elevations_deg=(
        14.794, 10.944, 7.971, 4.969, 2.952, 1.94, 1.6, 1.263, 0.925, 0.587, 0.249, -0.088, -0.425, -0.763,
        -1.101, -1.439, -1.776, -2.116, -2.453, -2.788, -3.128, -3.463, -3.8, -4.138, -4.473, -4.808, -5.145,
        -5.479, -5.814, -6.149, -7.151, -8.147, -9.148, -10.133, -11.12, -12.094, -13.062, -14.018, -18.977,
        -24.985,
    ),
    # Hesai counts clockwise.
    azimuths_deg=(*(6 * (1.042,)), *(8 * (-3.125, 5.208, 1.042)), *(10 * (1.042,))),
    sequence_ns=55_556,
    firing_ns=1_300,
    range_m=(0.3, 200.0),
    range_step_m=0.004,
    estimated=("firing_ns", *_NOISE, *_SPOT),
)  # fmt: skip
_PANDAR_128 = replace(
    _PANDAR_40P,
    name="Pandar128",
    aliases=("Pandar128E3X", "Pandar128E4X", "OT128"),
    source="angle file of one Pandar128E4X (its azimuth offsets, up to 5 deg, are left out); user manual "
    "(0.2 deg at 10 Hz, ranges)",
    elevations_deg=(
        15.139, 13.432, 11.919, 10.634, 9.967, 9.3, 8.621, 7.945, 7.595, 7.244, 6.905, 6.55, 6.193, 5.843,
        5.482, 5.116, 4.768, 4.402, 4.04, 3.68, 3.314, 2.94, 2.58, 2.203, 2.081, 1.967, 1.844, 1.71, 1.596,
        1.474, 1.333, 1.23, 1.109, 0.97, 0.856, 0.734, 0.597, 0.477, 0.361, 0.217, 0.102, -0.012, -0.146,
        -0.272, -0.387, -0.522, -0.649, -0.757, -0.899, -1.018, -1.135, -1.272, -1.397, -1.512, -1.648,
        -1.777, -1.884, -2.028, -2.146, -2.261, -2.397, -2.526, -2.639, -2.775, -2.894, -3.016, -3.154,
        -3.271, -3.394, -3.534, -3.644, -3.768, -3.913, -4.022, -4.149, -4.285, -4.405, -4.52, -4.662,
        -4.777, -4.896, -5.043, -5.155, -5.272, -5.419, -5.539, -5.654, -5.806, -5.907, -6.288, -6.669,
        -7.039, -7.416, -7.794, -8.173, -8.546, -8.915, -9.295, -9.666, -10.041, -10.414, -10.785, -11.15,
        -11.521, -11.895, -12.26, -12.638, -12.992, -13.368, -13.727, -14.096, -14.451, -14.806, -15.167,
        -15.517, -15.881, -16.233, -16.585, -16.934, -17.288, -17.642, -18.332, -19.005, -19.665, -20.318,
        -21.598, -22.989, -24.71,
    ),
    azimuths_deg=(),
    n_at_once=8,
    range_m=(0.3, 200.0),
    estimated=("firing_ns", "n_at_once", "azimuths_deg", *_NOISE, *_SPOT),
)  # fmt: skip
_HELIOS_5515 = DataSheet(
    name="Helios-5515",
    aliases=("RS-Helios", "RS-Helios-5515", "RS-Helios 5515", "Helios"),
    source="RoboSense RS-Helios-5515 user manual (channels, 0.2 deg at 10 Hz, ranges)",
    elevations_deg=(
        15, 13, 11, 9, 7, 5.5, 4, 2.67, 1.33, 0, -1.33, -2.67, -4, -5.33, -6.67, -8, -10, -16, -13, -19, -22,
        -28, -25, -31, -34, -37, -40, -43, -46, -49, -52, -55,
    ),
    sequence_ns=55_560,
    firing_ns=1_570,
    range_m=(0.2, 150.0),
    range_step_m=0.0025,
    estimated=("firing_ns", "azimuths_deg", *_NOISE, *_SPOT),
)  # fmt: skip
_HELIOS_1615 = replace(
    _HELIOS_5515,
    name="Helios-1615",
    aliases=("RS-Helios-1615", "RS-Helios 1615"),
    source="RoboSense RS-Helios-1615 user manual (31 deg from -16 to 15, 1 deg; 0.2 deg at 10 Hz)",
    elevations_deg=tuple(float(15 - k) for k in range(32)),
)
_HELIOS_16P = replace(
    _HELIOS_5515,
    name="Helios-16P",
    aliases=("RS-Helios-16P", "RS-Helios 16P"),
    source="RoboSense RS-Helios-16P user manual (30 deg from -15 to 15, 2 deg; 0.2 deg at 10 Hz)",
    elevations_deg=tuple(float(15 - 2 * k) for k in range(16)),
    firing_ns=3_150,
)
_BPEARL = replace(
    _HELIOS_5515,
    name="Bpearl",
    aliases=("RS-Bpearl", "RS BPearl"),
    source="angle file of one RS-Bpearl; user manual (0.2 deg at 10 Hz, ranges)",
    elevations_deg=(
        2.31, 47.32, 5.12, 50.13, 7.93, 52.95, 10.74, 55.77, 13.55, 58.59, 16.35, 61.4, 19.16, 64.21, 21.97,
        67.03, 24.78, 69.83, 27.59, 72.64, 30.41, 75.44, 33.22, 78.25, 36.04, 81.06, 38.86, 83.87, 41.68,
        86.69, 44.5, 89.5,
    ),
    range_m=(0.1, 30.0),
    range_step_m=0.005,
)  # fmt: skip

DATA_SHEETS: tuple[DataSheet, ...] = (
    VLP_16,
    _PUCK_HI_RES,
    _HDL32E,
    _VLP32C,
    _VLS128,
    *(_ouster(f"OS0-{n}", n, 45.0, -45.0, _OS0) for n in (32, 64, 128)),
    _ouster("OS1-32", 32, 21.2, -21.2, _OS1),
    _ouster("OS1-64", 64, 21.4, -20.8, _OS1, _RECORDED),
    _ouster("OS1-128", 128, 21.2, -21.2, _OS1),
    _XT32,
    _XT16,
    _PANDAR_40P,
    _PANDAR_128,
    _HELIOS_5515,
    _HELIOS_1615,
    _HELIOS_16P,
    _BPEARL,
)
"""Every model that is known."""

TYPICAL = DataSheet(
    name="other",
    source="typical of spinning LiDARs",
    elevations_deg=(),
    columns=1800,
    estimated=("range_m", *_NOISE, *_SPOT),
)
"""Noise and beam of a LiDAR whose model is not known."""


def find_data_sheet(model: str) -> DataSheet | None:
    """Find a model by its name in any spelling; None if it is not known.

    "VLP-16", "vlp16" and "Velodyne VLP 16 (Puck)" are one model; words behind a known name do not matter.
    """
    words = model.split()
    names = (" ".join(words[:n]) for n in range(len(words), 0, -1))
    return next((_BY_NAME[_plain(name)] for name in names if _plain(name) in _BY_NAME), None)


def _plain(name: str) -> str:
    word = "".join(c for c in name.lower() if c.isalnum())
    for maker in ("velodyne", "ouster", "hesai", "robosense"):
        word = word.removeprefix(maker)
    return word


_BY_NAME = {_plain(name): sheet for sheet in DATA_SHEETS for name in (sheet.name, *sheet.aliases)}
