"""lce-rig: extrinsic calibration of LiDARs and cameras, frame or event, with a checkerboard."""

import os

__version__ = "0.1.0"

# OpenCV reads this once, when it is first loaded: images that declare more are refused before any
# memory is taken.
# `core/image_codec.py` does the same in words, wherever OpenCV was loaded before. The figure is MAX_PIXELS of
# `core/limits.py`.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 26))
