"""What benchmarks keep: found again by the same code, profile and options, and by no others."""

from dataclasses import replace

from benchmarks.kept import kept_folder

from lce_rig.rig import load_rig
from lce_rig.simulate import SimulationOptions


def test_what_is_kept_is_found_again_under_the_same_conditions_only(tmp_path):
    rig, options = load_rig("rlfs"), SimulationOptions()
    stricter = rig.model_copy(update={"quality": rig.quality.model_copy(update={"min_rings": 9})})
    folders = [
        kept_folder(tmp_path, rig, options),
        kept_folder(tmp_path, rig, replace(options, tilt_deg=10.0)),
        kept_folder(tmp_path, stricter, options),
        kept_folder(tmp_path, load_rig("rles"), options),
        kept_folder(tmp_path, rig, options, packages=("simulate", "collect/guidance")),
    ]
    assert len(set(folders)) == len(folders)
    assert kept_folder(tmp_path, load_rig("rlfs"), SimulationOptions()) == folders[0]
