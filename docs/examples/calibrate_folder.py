"""Calibrate a folder of images and point clouds: img/000000.png, ... and pcd/000000.pcd, ... side by side.

python calibrate_folder.py RIG FOLDER SESSION
"""

import sys

import numpy as np

import lce_rig as lce


def main(rig_name: str, folder: str, session_folder: str) -> None:
    """Make a session of the folder, calibrate it, and write the result and the overlays."""
    rig = lce.load_rig(rig_name)
    session = lce.collect_from(rig, folder, session_folder)
    result = lce.calibrate_session(session)
    for pair in result.pairs:
        print(f"{pair.camera} and {pair.lidar}: {pair.verdict}")
        print(np.array_str(pair.T_cam_lidar, precision=4, suppress_small=True))
        print(f"1 sigma: {pair.sigma_rotation_deg:.3f} deg, {1000 * pair.sigma_translation_m:.1f} mm")
        for finding in pair.findings:
            print(f"  {finding.sentence}")
        # A point 5 m ahead of the LiDAR, in the camera's frame: p_cam = R p_lidar + t.
        point_cam = pair.T_cam_lidar @ [5.0, 0.0, 0.0, 1.0]
        print(f"p_lidar (5, 0, 0) m is p_cam {np.round(point_cam[:3], 3)} m")
    for shortage in result.shortages:
        print(f"{shortage.subject}: {shortage.sentence}")
    written = result.write()
    print(f"{len(written.files)} files in {written.files[0].parent}")
    overlays = lce.verify(session, result).write()
    print(f"overlays: {', '.join(str(each.page) for each in overlays)}")


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except lce.LceRigError as error:
        # Each error says what is wrong and what to do; its exit code is that of the command line.
        print(error, file=sys.stderr)
        sys.exit(error.exit_code)
