"""Profiles from and to files."""

from itertools import chain

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lce_rig.core.errors import ProfileError
from lce_rig.rig import Rig, dump_rig, find_profile, load_rig, parse_rig, shipped_profiles

RLFS = find_profile("rlfs").read_text(encoding="utf-8")


def test_shipped_profiles_are_as_listed():
    of_papers, of_lidars = {"rlfs", "rles", "sss"}, {"os1_64", "os0_128", "xt32", "hdl32e", "mid360"}
    assert set(shipped_profiles()) == of_papers | of_lidars | {"two_cameras", "four_sensors"}
    assert all(load_rig(name).name == name for name in shipped_profiles())


def test_no_shipped_profile_gives_a_warning():
    assert not [*chain.from_iterable(load_rig(name).warnings() for name in shipped_profiles())]


@settings(max_examples=20)
@given(
    square_m=st.floats(0.02, 0.08),
    focal_px=st.floats(300, 3000),
    offset_s=st.floats(-1, 1),
    tiny=st.floats(1e-12, 1e-5),
    controls=st.dictionaries(
        st.text("abc_", min_size=1, max_size=5),
        st.booleans() | st.integers(-9, 9) | st.floats(-1, 1) | st.text(max_size=5),
    ),
)
def test_any_profile_survives_a_round_trip(square_m, focal_px, offset_s, tiny, controls):
    data = load_rig("rlfs").model_dump()
    data["board"]["square_m"] = square_m
    data["cameras"]["cam"]["intrinsics"] |= {
        "fx_px": focal_px,
        "fy_px": focal_px,
        "distortion": (tiny, -tiny, 0, 0),
    }
    data["lidars"]["lidar"]["timestamps"]["expected_offset_s"] = offset_s
    data["lidars"]["lidar"]["driver"]["controls"] = controls
    rig = Rig.model_validate(data)
    again = parse_rig(dump_rig(rig))
    assert again == rig
    assert again.lidars["lidar"].driver.controls == controls


def test_a_path_loads_a_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(RLFS.replace("name: rlfs", "name: mine"), encoding="utf-8")
    assert load_rig(path).name == "mine"
    assert load_rig(str(path)) == load_rig(path)


def test_misspelt_profile_lists_known_names():
    with pytest.raises(ProfileError) as caught:
        load_rig("rlsf")
    assert "rlfs" in caught.value.hint
    assert all(name in caught.value.hint for name in ("rles", "rlfs", "sss"))


@pytest.mark.parametrize("name", ["nothing.yaml", "no/such/rlfs", "/tmp"])
def test_missing_file_or_folder_is_not_a_profile(name):
    with pytest.raises(ProfileError):
        load_rig(name)


@pytest.mark.parametrize(
    ("content", "place"),
    [
        (b"", ""),
        (b"# only a comment\n", ""),
        (b"\xff\xfe\x00", ""),
        (b"\x00", ""),
        (b"- 1\n- 2\n", ""),
        (b"PNG", ""),
        (b"name: [1, 2", ":1"),
        (b"name: a\nboard:\n  x: 1\n  x: 2\n", ":4"),
        (b"name: !!python/object/apply:os.system [ls]\n", ":1"),
        (b"a: &a [*a, *a]\n", ":1"),
        (b"[" * 500, ""),
        (b"name: 2026-13-45\n", ""),
        (b"name: !!bool x\n", ""),
    ],
)
def test_invalid_profile_error_has_line(tmp_path, content, place):
    path = tmp_path / "mine.yaml"
    path.write_bytes(content)
    with pytest.raises(ProfileError) as caught:
        load_rig(path)
    assert f"{path}{place}: " in str(caught.value)


@settings(max_examples=30)
@given(st.integers(0, len(RLFS)), st.integers(0, 40), st.text(max_size=6))
def test_any_damage_is_a_profile_error_or_harmless(start, length, inserted):
    text = RLFS[:start] + inserted + RLFS[start + length :]
    try:
        rig = parse_rig(text)
    except ProfileError as error:
        assert str(error)
    else:
        assert parse_rig(dump_rig(rig)) == rig
