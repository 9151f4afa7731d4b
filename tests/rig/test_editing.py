"""Profiles derived from others by editing their text."""

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from lce_rig.core.errors import ProfileError, UsageError
from lce_rig.rig import derive_text, find_profile, load_rig, parse_rig, set_value

RLES = find_profile("rles").read_text(encoding="utf-8")


def test_derive_new_focus_keeps_comments():
    numbers = {"fx_px": "305.5716", "fy_px": "305.6182", "cx_px": "175.2111", "cy_px": "125.4881"}
    settings = [(f"cameras.davis.intrinsics.{key}", value) for key, value in numbers.items()]
    text = derive_text(RLES, "rles02", settings, "rles02.yaml", "rles")
    # The comments above the first key, and the description, are of the other rig.
    own = RLES[RLES.index("format_version") :]
    changed = [(a, b) for a, b in zip(own.splitlines(), text.splitlines()[1:], strict=True) if a != b]
    assert len(changed) == 6 and "description: ''" in text
    assert text.count("#") == own.count("#") + 1
    rig = parse_rig(text)
    assert rig.name == "rles02"
    assert rig.cameras["davis"].to_intrinsics().fx_px == 305.5716
    assert rig.board == load_rig("rles").board


def test_a_missing_key_is_added_at_the_end_of_its_block():
    text = set_value(RLES, "calibration.target_sigma_m", "0.02")
    text = set_value(text, "quality.min_rings", "5")
    text = set_value(text, "quality.min_points", "50")
    rig = parse_rig(text)
    assert rig.calibration.target_sigma_m == 0.02
    assert (rig.quality.min_rings, rig.quality.min_points) == (5, 50)
    assert rig.calibration.target_sigma_deg == load_rig("rles").calibration.target_sigma_deg


def test_set_value_reaches_list_entries_by_index():
    rig = parse_rig(set_value(RLES, "nominal_extrinsics.0.translation_m", "[1, 2, 3]"))
    assert rig.nominal_extrinsics[0].translation_m == (1, 2, 3)


def test_derive_wrong_profile_names_the_key():
    with pytest.raises(ProfileError, match=r"new\.yaml"):
        derive_text(RLES, "new", [("board.square_m", "68")], "new.yaml", "rles")
    with pytest.raises(ProfileError, match=r"board\.sqare_m"):
        derive_text(RLES, "new", [("board.sqare_m", "0.068")], "new.yaml", "rles")


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("board.square_m", "[1"),
        ("board.square_m", "1\nx: 2"),
        ("board.square_m.x", "1"),
        ("board..x", "1"),
        ("quality.x.y", "1 # b"),
    ],
)
def test_implausible_settings_are_usage_errors(path, value):
    with pytest.raises(UsageError):
        set_value(RLES, path, value)


def test_a_name_that_yaml_reads_as_a_number_stays_a_name():
    assert parse_rig(derive_text(RLES, "346", [], "x", "rles")).name == "346"


def paths(data, prefix=""):
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else []
    return [prefix.lstrip("."), *(p for key, value in items for p in paths(value, f"{prefix}.{key}"))]


PATHS = [path for path in paths(yaml.safe_load(RLES)) if path]


@settings(max_examples=15)
@given(st.sampled_from(PATHS), st.sampled_from(["1.5", "[1, 2]", "{a: 1}", "text", '"a # b"', "null", "{}"]))
def test_setting_a_key_changes_that_key_and_nothing_else(path, value):
    wanted = yaml.safe_load(RLES)
    *parents, last = [int(key) if key.isdigit() else key for key in path.split(".")]
    block = wanted
    for key in parents:
        block = block[key]
    block[last] = yaml.safe_load(value)
    assert yaml.safe_load(set_value(RLES, path, value)) == wanted
