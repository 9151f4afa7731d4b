"""Bring the scans of a LiDAR that lce-rig has no reader for into a session, and calibrate it.

    python own_lidar.py RIG FOLDER SESSION

FOLDER holds one image and one scan for each board placement: 000.png and 000.npy, 001.png and 001.npy, ...
Each scan is an array (N, 5) float64: x, y, z in m (x forward, y left, z up), intensity, and elevation in deg.
Replace `read_scan` with a reader of your own format.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

import lce_rig as lce


def read_scan(path: Path, sensor: str) -> lce.Scan:
    """Read one scan. Rings count from 0 at the lowest elevation; azimuth gaps and order do not matter."""
    table = np.load(path)
    table = table[np.isfinite(table).all(axis=1) & (np.linalg.norm(table[:, :3], axis=1) > 0)]
    elevations_deg = np.unique(np.round(table[:, 4], 3))
    ring = np.searchsorted(elevations_deg, np.round(table[:, 4], 3))
    return lce.Scan(
        sensor=sensor,  # name of the LiDAR in the profile
        stamp_ns=None,  # of the first firing, where the recording has times
        points=table[:, :3].astype(np.float32),
        intensity=table[:, 3].astype(np.float32),
        ring=ring.astype(np.int16),
    )


def main(rig_name: str, folder: str, session_folder: str) -> None:
    """Store each image with its scan as a capture, then calibrate."""
    rig = lce.load_rig(rig_name)
    camera, lidar = next(iter(rig.cameras)), next(iter(rig.lidars))
    with lce.Session.resume(session_folder, rig) as session:
        for path in sorted(Path(folder).glob("*.npy")):
            pixels = cv2.imread(str(path.with_suffix(".png")))
            if pixels is None:
                raise SystemExit(f"{path.with_suffix('.png')} cannot be read")
            image = lce.Image(camera, "frames", stamp_ns=None, pixels=pixels.astype(np.uint8))
            scan = read_scan(path, lidar)
            # A second run stores nothing twice.
            if session.find_duplicate([image], [scan]) is None:
                session.add_capture([image], [scan], meta={"source": path.name})
        for pair in lce.calibrate_session(session).pairs:
            print(f"{pair.camera} and {pair.lidar}: {pair.verdict}, {len(pair.captures_used)} captures")
            print(pair.T_cam_lidar)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except lce.LceRigError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_code)
