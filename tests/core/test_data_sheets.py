"""The table of LiDAR models: completeness, spellings of names, and agreement with Velodyne's own files."""

from pathlib import Path

import numpy as np
import pytest
import velodyne_decoder
import yaml

from lce_rig.core.data_sheets import DATA_SHEETS, VLP_16, DataSheet, find_data_sheet


@pytest.mark.parametrize("sheet", DATA_SHEETS, ids=lambda sheet: sheet.name)
def test_data_sheets_are_complete_with_source(sheet):
    assert sheet.source
    assert set(sheet.estimated) <= set(DataSheet.__dataclass_fields__)
    if not sheet.has_rings:
        assert sheet.n_rings == 0 and sheet.points_hz > 0 and sheet.fov_deg[1] < sheet.fov_deg[2]
        return
    assert len(np.unique(sheet.elevations_deg)) == sheet.n_rings >= 16
    assert -90 <= min(sheet.elevations_deg) < max(sheet.elevations_deg) <= 90
    assert len(sheet.azimuths_deg) in (0, sheet.n_rings) and len(sheet.heights_mm) in (0, sheet.n_rings)
    assert (sheet.sequence_ns is None) != (sheet.columns is None)
    assert np.radians(0.05) < sheet.step_rad(10.0) < np.radians(0.5)
    # Whatever fires in one sequence does so before the next begins.
    if sheet.sequence_ns is not None:
        assert (sheet.n_rings - 1) // sheet.n_at_once * sheet.firing_ns < sheet.sequence_ns


def test_every_model_is_in_the_documentation():
    text = (Path(__file__).parents[2] / "docs" / "rig-profiles.md").read_text(encoding="utf-8")
    listed = [line.split(" | ")[0].removeprefix("| ") for line in text.splitlines() if line.count(" | ") == 5]
    assert set(listed) >= {sheet.name for sheet in DATA_SHEETS}


@pytest.mark.parametrize("name", ["VLP-16", "Puck Hi-Res", "HDL-32E", "VLP-32C", "Alpha Prime"])
def test_velodyne_beams_match_calibration_files(name):
    folder = Path(velodyne_decoder.__file__).parent / "calibrations"
    document = yaml.safe_load((folder / f"{name}.yml").read_text(encoding="utf-8"))
    lasers = sorted(document["lasers"], key=lambda laser: int(laser["laser_id"]))
    sheet = find_data_sheet(name)
    assert sheet is not None
    assert np.degrees([laser["vert_correction"] for laser in lasers]) == pytest.approx(
        sheet.elevations_deg, abs=1e-3
    )
    # Velodyne counts azimuths clockwise.
    clockwise_deg = -np.array(sheet.azimuths_deg or sheet.n_rings * (0.0,))
    assert np.degrees([laser["rot_correction"] for laser in lasers]) == pytest.approx(clockwise_deg, abs=1e-3)


@pytest.mark.parametrize(
    ("spelling", "name"),
    [
        ("VLP-16", "VLP-16"),
        ("vlp16", "VLP-16"),
        ("Velodyne VLP 16 (rev. D)", "VLP-16"),
        ("Puck LITE", "VLP-16"),
        ("VLP-16 Hi-Res", "Puck Hi-Res"),
        ("os1_64 gen2", "OS1-64"),
        ("Ouster OS0-128", "OS0-128"),
        ("PandarXT-32", "XT32"),
        ("RS-Bpearl", "Bpearl"),
        ("XT32M2X", None),
        ("OS1-640", None),
        ("other", None),
        ("", None),
    ],
)
def test_data_sheet_any_spelling_is_found(spelling, name):
    found = find_data_sheet(spelling)
    assert (found and found.name) == name


def test_unit_beams_replace_model_beams():
    own = VLP_16.with_rings((-10.0, 0.0, 10.0), 2048)
    assert np.degrees(own.rings_rad) == pytest.approx([-10, 0, 10])
    assert own.step_rad(10.0) == own.step_rad(20.0) == pytest.approx(2 * np.pi / 2048)
    assert own.aperture_m == VLP_16.aperture_m
    assert VLP_16.with_rings(None, None) is VLP_16
