"""Findings of exports: content that a format leaves out or changes."""

from lce_rig.core.findings import Kind

LENS_FITTED = Kind(
    "export.lens_fitted",
    "{format} has {n_coefficients} distortion coefficients: those of camera {subject} are fitted, "
    "{rms_px:.3f} px rms, {max_px:.3f} px at most over the image",
    severity="note",
)
NO_FRAME = Kind(
    "export.no_frame",
    "{format}: {file} is not written: it needs the frame {frame} (profile: mount), and the root is {root}",
    "`lce-rig export {session} --formats {format} --tree URDF -o FOLDER`",
    severity="warning",
)
NO_SESSION = Kind(
    "export.no_session",
    "{format} is not written: it needs the images and scans of a session",
    "export from the session",
    severity="warning",
)
NO_IMAGES = Kind(
    "export.no_images",
    "{format}: camera {subject} is left out: the session has no images of it",
    severity="warning",
)
MOUNT_UNUSED = Kind(
    "export.mount_unused",
    "the profile's mount is not used: {source} has {frame} elsewhere, {angle_deg:deg} and "
    "{distance_m:1mm} off",
    severity="note",
)
