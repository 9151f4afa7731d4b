"""Every output read by a program that is not ours, by the format's own conventions."""

import numpy as np
import pytest

from lce_rig.core.geometry import perturb
from lce_rig.export import EXPORTS, is_export, remove_exports, usual_formats
from lce_rig.rig import load_rig
from lce_rig.rig.profile import OutputFormat
from tests.export.readers import MODELS, READERS, Case, off_px, outputs_case


@pytest.fixture(scope="module", params=MODELS)
def case(request, tmp_path_factory):
    return outputs_case("rlfs", tmp_path_factory.mktemp("outputs"), model=request.param)


@pytest.mark.parametrize(("read_by", "reader"), READERS.items(), ids=[" by ".join(key) for key in READERS])
def test_another_program_draws_the_same_points(case, read_by, reader):
    assert off_px(case, read_by[0], reader) < 1e-6


def test_every_format_has_a_reader_and_a_wrong_pose_is_seen(case):
    read = {name for name, _ in READERS}
    assert set(EXPORTS) == read
    wrong = perturb(case.calibration.T_cam_lidar, np.array([1e-6, 0, 0, 0, 0, 1e-6]))
    moved = Case(
        case.folder,
        case.rig,
        type(case.calibration)(**(vars(case.calibration) | {"T_cam_lidar": wrong})),
        case.points_lidar,
        case.lens,
    )
    key = ("extrinsics", "PyYAML, scipy")
    assert off_px(moved, key[0], READERS[key]) > 1e-6


def test_all_files_are_known_as_exports_and_nothing_else_is_removed(case, tmp_path):
    import shutil

    folder = tmp_path / "out"
    shutil.copytree(case.folder, folder)
    assert all(is_export(path) for path in folder.iterdir())
    (folder / "mine").mkdir()
    (folder / "mine/metadata.yaml").write_text("rosbag2_bagfile_information: {}\n", encoding="utf-8")
    (folder / "scan.ply").write_bytes(b"ply\nformat ascii 1.0\n")
    remove_exports(folder)
    assert sorted(path.name for path in folder.iterdir()) == ["mine", "scan.ply"]


def test_the_profile_names_the_formats_that_are_written():
    assert set(OutputFormat.__args__) == set(EXPORTS)  # type: ignore[attr-defined]
    rig = load_rig("rlfs")
    assert usual_formats(rig)[0] == "extrinsics" and "kalibr" not in usual_formats(rig)
    assert usual_formats(rig.model_copy(update={"exports": ("opencv", "urdf")})) == ("opencv", "urdf")
