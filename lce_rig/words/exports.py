"""Phrases of outputs: what a format leaves out or puts differently."""

from collections.abc import Mapping

from lce_rig.words.rendering import Phrase

PHRASES: Mapping[str, Phrase] = {
    "export.lens_fitted": Phrase(
        "{format} has {n_coefficients} distortion coefficients: those of camera {subject} are fitted, "
        "{rms_px:.3f} px rms, {max_px:.3f} px at most over the image"
    ),
    "export.no_frame": Phrase(
        "{format}: {file} is not written: it needs the frame {frame}, and the root is {root}",
        "set `mount` in the profile, or give the robot's tree with --tree",
    ),
    "export.no_session": Phrase(
        "{format} is not written: it needs the images and scans of a session", "export from the session"
    ),
    "export.no_images": Phrase("{format}: camera {subject} is left out: the session has no images of it"),
    "export.mount_unused": Phrase(
        "the profile's mount is not used: {source} has {frame} elsewhere, {angle_deg:deg} and "
        "{distance_m:1mm} off"
    ),
}
