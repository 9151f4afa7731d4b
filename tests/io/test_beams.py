"""Rings of a scan compared with the beams of the profile's model."""

import numpy as np
import pytest

from lce_rig.core.data import Scan
from lce_rig.core.data_sheets import DATA_SHEETS, find_data_sheet
from lce_rig.io.beams import compare_beams, measure_elevations, suggest_models
from lce_rig.rig import LidarSettings

RINGED = [sheet for sheet in DATA_SHEETS if sheet.has_rings]


def scan_of(elevations_deg, every=1, start=0, n_columns=1024):
    """A hall of 8 x 12 m seen by a LiDAR, in firing order; every k-th point of it."""
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, n_columns, endpoint=False), np.radians(elevations_deg), indexing="ij"
    )
    rho = np.minimum(4 / np.abs(np.cos(azimuth)), 6 / np.maximum(np.abs(np.sin(azimuth)), 1e-9))
    ring = np.broadcast_to(np.argsort(np.argsort(elevations_deg)), azimuth.shape)
    points = np.stack([rho * np.cos(azimuth), rho * np.sin(azimuth), rho * np.tan(elevation)], axis=-1)
    points, ring = points.reshape(-1, 3)[start::every], ring.ravel()[start::every]
    n = len(points)
    return Scan("lidar", None, points.astype(np.float32), np.zeros(n, np.float32), ring.astype(np.int16))


def settings_of(model):
    return LidarSettings.model_validate({"model": model})


@pytest.mark.parametrize("sheet", RINGED, ids=lambda sheet: sheet.name)
def test_compare_beams_every_model_fits_itself(sheet):
    assert compare_beams(scan_of(sheet.elevations_deg), settings_of(sheet.name)) == []


@pytest.mark.parametrize(
    ("recorded", "profile", "names"),
    [
        ("OS1-64 gen1", "OS1-64", "OS1-64 gen1"),
        ("Puck Hi-Res", "VLP-16", "Puck Hi-Res"),
        ("VLP-16", "OS1-64", "Helios-16P or VLP-16 or XT16"),
        ("VLP-16", "XT32", "Helios-16P or VLP-16 or XT16"),
        ("VLP-32C", "VLP-16", "VLP-32C"),
        ("HDL-32E", "VLP-32C", "HDL-32E"),
    ],
)
def test_compare_beams_of_another_model_names_it(recorded, profile, names):
    sheet = find_data_sheet(recorded)
    (finding,) = compare_beams(scan_of(sheet.elevations_deg), settings_of(profile))
    assert finding.code == "recording.beams_of_other_model" and finding.figures["names"] == names
    assert f"lidars.lidar.model to {names}" in finding.sentence


def test_compare_beams_accepts_unit_deviations():
    """Nor are unseen rings."""
    rng = np.random.default_rng(1)
    for model in ("OS1-64", "VLP-16"):
        beams_deg = np.sort(find_data_sheet(model).elevations_deg)
        of_unit = beams_deg + 0.5 + 0.05 * rng.standard_normal(len(beams_deg))
        assert compare_beams(scan_of(of_unit), settings_of(model)) == []
        assert compare_beams(scan_of(beams_deg[:-3]), settings_of(model)) == []


@pytest.mark.parametrize(("every", "model"), [(2, "VLP-16"), (4, "VLP-16"), (4, "other"), (8, "VLP-16")])
def test_compare_beams_skipped_points_are_named(every, model):
    beams_deg = (find_data_sheet(model) or find_data_sheet("VLP-16")).elevations_deg
    whole = scan_of(beams_deg)
    is_returned = np.random.default_rng(2).random(len(whole.points)) > 0.01
    kept = np.flatnonzero(is_returned)[::every]
    thin = Scan("lidar", None, whole.points[kept], whole.intensity[kept], whole.ring[kept])
    (finding,) = compare_beams(thin, settings_of(model))
    assert finding.code == "recording.rings_skipped" and finding.figures["n_seen"] <= 8
    assert finding.figures["n_rings"] == len(beams_deg)
    assert "point_filter_num" in finding.sentence


@pytest.mark.parametrize(("every", "model"), [(3, "VLP-16"), (5, "VLP-32C"), (3, "OS1-64")])
def test_compare_beams_thin_rings_are_named(every, model):
    """Every ring keeps points in each direction, as they are skipped in all of them by turns."""
    sheet = find_data_sheet(model)
    n_columns = round(2 * np.pi / sheet.step_rad(10.0))
    whole = scan_of(sheet.elevations_deg, n_columns=n_columns)
    assert compare_beams(whole, settings_of(model)) == []
    thin = scan_of(sheet.elevations_deg, every=every, n_columns=n_columns)
    (finding,) = compare_beams(thin, settings_of(model))
    assert finding.code == "recording.points_skipped" and finding.figures["n"] == every
    key = "columns" if model == "OS1-64" else "rate_hz"
    assert "point_filter_num: 1" in finding.sentence and f"lidars.lidar.{key}" in finding.sentence


def test_compare_beams_faster_rotor_skips_no_points():
    beams_deg = find_data_sheet("VLP-16").elevations_deg
    assert compare_beams(scan_of(beams_deg, n_columns=900), settings_of("VLP-16")) == []


def test_suggest_models_of_unknown_beams_are_none():
    assert suggest_models(np.sort(np.r_[np.linspace(-20, -6, 8), np.linspace(-5, 5, 16), [8, 14]])) == []
    assert suggest_models(measure_elevations(scan_of(np.linspace(-40, 40, 40)))) == []
