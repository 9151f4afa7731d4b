"""lce-rig: extrinsic calibration of LiDARs and cameras, frame or event, with a checkerboard."""

__version__ = "0.1.0"
