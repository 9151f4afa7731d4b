"""Two cameras without a LiDAR, from folders of images to the files for the robot."""

import cv2
import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from lce_rig.core.calibration import read_result
from lce_rig.core.data import Image
from lce_rig.io.ros.bag_recorder import IMAGE_TYPE, encode_image
from lce_rig.rig import load_rig
from lce_rig.rig.loading import dump_rig
from lce_rig.simulate.sampling import simulate_captures

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def stereo(tmp_path_factory):
    """Profile of two cameras, and folders with their images of ten placements."""
    folder = tmp_path_factory.mktemp("stereo")
    both = load_rig("two_cameras")
    (folder / "stereo.yaml").write_text(
        dump_rig(both.model_copy(update={"name": "stereo", "lidars": {}, "nominal_extrinsics": ()}))
    )
    for capture in simulate_captures(both, n_captures=10, seed=0):
        for image in capture.images:
            place = folder / "images" / image.sensor / f"{capture.index:06d}.png"
            place.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(place), image.pixels)
    return folder


def test_images_of_two_cameras_give_a_robot_description(stereo, tmp_path, lce_rig):
    session = tmp_path / "session"
    collected = lce_rig("collect", "--rig", stereo / "stereo.yaml", session, "--from", stereo / "images")
    assert collected.code == 0 and "10 captures" in collected.out + collected.err
    calibrated = lce_rig("calibrate", session)
    assert calibrated.code == 0 and "p_left = R p_right + t" in calibrated.out
    (pair,) = read_result(session / "calibration/result.json").pairs
    assert pair.is_of_cameras and pair.verdict == "pass"
    assert abs(float(pair.T_cam_lidar[0, 3]) - 0.3) < 0.05
    assert "right_link" in (session / "calibration/stereo.urdf").read_text()
    verified = lce_rig("verify", session)
    assert verified.code == 0 and "agree with the extrinsics" in verified.out
    assert lce_rig("verify", session, "--json").code == 0
    assert len(list((session / "calibration/overlays").glob("*.png"))) == 10
    assert lce_rig("export", session, "--formats", "kalibr", "-o", tmp_path / "out").code == 0
    assert (tmp_path / "out/camchain.yaml").exists()


def test_bag_of_two_cameras_is_captured_at_still_boards(stereo, tmp_path, lce_rig):
    rig = load_rig(stereo / "stereo.yaml")
    with Writer(tmp_path / "drive", version=8) as writer:
        topics = {
            name: writer.add_connection(
                camera.channels["frames"].topic, IMAGE_TYPE, typestore=get_typestore(Stores.ROS2_HUMBLE)
            )
            for name, camera in rig.cameras.items()
        }
        for placement in range(2):
            for step in range(15):
                stamp_ns = round(1e18) + 10**8 * (40 * placement + step)
                for name, topic in topics.items():
                    pixels = cv2.imread(str(stereo / f"images/{name}/{placement:06d}.png"), 0)
                    data = encode_image(Image(name, "frames", stamp_ns, pixels), f"{name}_optical", False)
                    writer.write(topic, stamp_ns, data)
    run = lce_rig(
        "collect", "--rig", stereo / "stereo.yaml", tmp_path / "session", "--from", tmp_path / "drive"
    )
    assert run.code == 0 and "2 captures" in run.out + run.err


def test_images_of_one_camera_are_refused_with_both_folders(stereo, tmp_path, lce_rig):
    images = tmp_path / "images"
    (images / "left").mkdir(parents=True)
    (images / "left/000000.png").write_bytes((stereo / "images/left/000000.png").read_bytes())
    run = lce_rig("collect", "--rig", stereo / "stereo.yaml", tmp_path / "session", "--from", images)
    assert run.code == 5 and "fewer than two cameras" in run.err and "right/" in run.err


def test_simulating_a_rig_without_lidar_is_refused(stereo, tmp_path, lce_rig):
    run = lce_rig("simulate", "--rig", stereo / "stereo.yaml", tmp_path / "session")
    assert run.code == 3 and "without a LiDAR" in run.err
