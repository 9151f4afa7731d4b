"""Every output read by a program that is not ours, by the format's own conventions."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import ResultRefusedError
from lce_rig.core.geometry import perturb
from lce_rig.export import EXPORTS, ExportJob, is_export, remove_exports, usual_formats, write_exports
from lce_rig.export.coloured_cloud import coloured
from lce_rig.rig import load_rig
from lce_rig.rig.profile import OutputFormat
from tests.export.readers import MODELS, READERS, Case, off_px, outputs_case, session_image


@pytest.fixture(scope="module", params=MODELS)
def case(request, tmp_path_factory):
    return outputs_case("rlfs", tmp_path_factory.mktemp("outputs"), model=request.param)


@pytest.mark.parametrize(("read_by", "reader"), READERS.items(), ids=[" by ".join(key) for key in READERS])
def test_other_program_projects_same_points(case, read_by, reader):
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


def test_remove_exports_spares_other_files(case, tmp_path):
    import shutil

    folder = tmp_path / "out"
    shutil.copytree(case.folder, folder)
    assert all(is_export(path) for path in folder.iterdir())
    (folder / "mine").mkdir()
    (folder / "mine/metadata.yaml").write_text("rosbag2_bagfile_information: {}\n", encoding="utf-8")
    (folder / "scan.ply").write_bytes(b"ply\nformat ascii 1.0\n")
    remove_exports(folder)
    assert sorted(path.name for path in folder.iterdir()) == ["mine", "scan.ply"]


def test_refused_export_leaves_earlier_files(case, tmp_path):
    import shutil

    folder = tmp_path / "out"
    shutil.copytree(case.folder, folder)
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    with pytest.raises(ResultRefusedError):
        write_exports([replace(case.calibration, verdict="fail")], case.rig, folder)
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == before


def test_the_profile_names_the_formats_that_are_written():
    assert set(OutputFormat.__args__) == set(EXPORTS)  # type: ignore[attr-defined]
    rig = load_rig("rlfs")
    assert usual_formats(rig)[0] == "extrinsics" and "mcap" not in usual_formats(rig)
    assert usual_formats(rig.model_copy(update={"exports": ("ply", "urdf")})) == ("ply", "urdf")


def test_points_outside_camera_view_have_no_colour(case):
    """A board at 1 m hides a part of the wall at 4 m from a camera beside the LiDAR, and not the rest."""
    T_cam_lidar = case.calibration.T_cam_lidar.copy()
    T_cam_lidar[:3, 3] = [0.3, 0.0, 0.0]
    calibration = replace(case.calibration, T_cam_lidar=T_cam_lidar)
    v = np.linspace(-0.2, 0.2, 81)
    rays = np.stack(np.meshgrid(np.linspace(-0.3, 0.3, 241), v), axis=-1).reshape(-1, 2)
    is_board = (np.abs(rays) < 0.1).all(axis=1)
    points = np.column_stack([rays, np.ones(len(rays))]) * np.where(is_board, 1.0, 4.0)[:, None]
    # As the LiDAR's rays see them: its origin lies beside the camera, and it looks past the board's edge.
    points_lidar = (points @ T_cam_lidar[:3, :3]).astype(np.float32)
    points_camera = points_lidar @ T_cam_lidar[:3, :3].T + T_cam_lidar[:3, 3]
    u = points_camera[:, 0] / points_camera[:, 2]
    w = points_camera[:, 1] / points_camera[:, 2]
    # In the camera the board covers [0.2, 0.4] of x / z; the wall's points there are hidden.
    is_behind = ~is_board & (np.abs(u - 0.3) < 0.09) & (np.abs(w) < 0.09)
    is_free = ~is_board & ((np.abs(u - 0.3) > 0.13) | (np.abs(w) > 0.13))
    assert is_behind.sum() > 100 and is_free.sum() > 1000
    rings = np.repeat(np.arange(81), 241).astype(np.int16)
    scan = Scan(calibration.lidar, None, points_lidar, np.zeros(len(points), np.float32), rings, None)
    image = Image(case.camera, "frames", None, session_image(case.rig, case.camera))
    job = ExportJob([calibration], case.rig, case.folder)
    cloud = coloured(image, scan, calibration, job, 0)
    kept = {tuple(p) for p in np.stack([cloud[axis] for axis in "xyz"], axis=1)}
    seen = np.array([tuple(p) in kept for p in points_lidar])
    assert not seen[is_behind].any() and seen[is_board].all() and seen[is_free].all()
