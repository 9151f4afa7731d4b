"""lce-rig: extrinsic calibration of LiDARs and cameras, frame or event, with a checkerboard.

    import lce_rig as lce

    rig = lce.load_rig("rlfs")
    session = lce.collect_from(rig, "recording.bag", "session/")
    result = lce.calibrate_session(session)          # .pairs[0].T_cam_lidar, .cov, .verdict, .findings
    result.write()                                   # the files of `lce-rig calibrate`
    lce.verify(session, result).write("overlays/")

docs/python-api.md lists every public name. Each is imported when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lce_rig.calibrate import CalibrateOptions
    from lce_rig.core.calibration import Calibration, ResultFile, read_result
    from lce_rig.core.data import Events, Image, Scan
    from lce_rig.core.errors import (
        LceRigError,
        NotEnoughDataError,
        ProfileError,
        ResultRefusedError,
        SessionError,
        SourceError,
        UsageError,
    )
    from lce_rig.core.findings import Finding, Refusal
    from lce_rig.detect.detection import Detections
    from lce_rig.export import write_exports
    from lce_rig.export.extrinsics import Reference, read_reference
    from lce_rig.io.recording import SourceOptions
    from lce_rig.pipeline.calibration import calibrate_session
    from lce_rig.pipeline.collect_recordings import collect_from
    from lce_rig.pipeline.comparison import Repeat, repeat
    from lce_rig.pipeline.detect_session import detect_boards
    from lce_rig.pipeline.pair_drift import DriftReport
    from lce_rig.pipeline.result_files import Result
    from lce_rig.pipeline.verification import Verification, verify
    from lce_rig.pipeline.watch_drift import drift
    from lce_rig.rig import Rig, load_rig
    from lce_rig.session import Session

__all__ = [
    "CalibrateOptions",
    "Calibration",
    "Detections",
    "DriftReport",
    "Events",
    "Finding",
    "Image",
    "LceRigError",
    "NotEnoughDataError",
    "ProfileError",
    "Reference",
    "Refusal",
    "Repeat",
    "Result",
    "ResultFile",
    "ResultRefusedError",
    "Rig",
    "Scan",
    "Session",
    "SessionError",
    "SourceError",
    "SourceOptions",
    "UsageError",
    "Verification",
    "calibrate_session",
    "collect_from",
    "detect_boards",
    "drift",
    "load_rig",
    "read_reference",
    "read_result",
    "repeat",
    "verify",
    "write_exports",
]
__version__ = "0.1.0"

_HOMES = {
    "lce_rig.calibrate": ("CalibrateOptions",),
    "lce_rig.core.calibration": ("Calibration", "ResultFile", "read_result"),
    "lce_rig.core.data": ("Events", "Image", "Scan"),
    "lce_rig.core.errors": tuple(name for name in __all__ if name.endswith("Error")),
    "lce_rig.core.findings": ("Finding", "Refusal"),
    "lce_rig.detect.detection": ("Detections",),
    "lce_rig.export": ("write_exports",),
    "lce_rig.export.extrinsics": ("Reference", "read_reference"),
    "lce_rig.pipeline.collect_recordings": ("collect_from",),
    "lce_rig.pipeline.detect_session": ("detect_boards",),
    "lce_rig.pipeline.pair_drift": ("DriftReport",),
    "lce_rig.pipeline.watch_drift": ("drift",),
    "lce_rig.pipeline.comparison": ("Repeat", "repeat"),
    "lce_rig.pipeline.result_files": ("Result",),
    "lce_rig.pipeline.calibration": ("calibrate_session",),
    "lce_rig.pipeline.verification": ("Verification", "verify"),
    "lce_rig.rig": ("Rig", "load_rig"),
    "lce_rig.session": ("Session",),
    "lce_rig.io.recording": ("SourceOptions",),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
