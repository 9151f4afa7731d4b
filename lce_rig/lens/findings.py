"""Kinds of findings of a lens."""

from lce_rig.core.findings import Kind

OTHER_LENS = Kind(
    "calibrate.other_lens",
    "corners {rms_px:.2f} px rms from the intrinsics of the other boards (median {median_px:.2f} px)",
    "look whether it is cut off: `lce-rig check {session} --debug-images`",
)
