"""The profile of a rig: its sensors, its board, and the limits and targets of a calibration."""

from lce_rig.rig.board_settings import BoardSettings
from lce_rig.rig.editing import as_yaml, derive_text, edit_text, lens_settings, set_value
from lce_rig.rig.loading import dump_rig, find_profile, load_rig, parse_rig, read_profile, shipped_profiles
from lce_rig.rig.profile import NominalExtrinsic, Rig
from lce_rig.rig.sensors import (
    CameraSettings,
    DriverSettings,
    FrameTimingSettings,
    IntrinsicsSettings,
    LidarIntrinsicsSettings,
    LidarSettings,
    TimestampSettings,
)
from lce_rig.rig.thresholds import CalibrationSettings, QualitySettings

__all__ = [
    "BoardSettings",
    "CalibrationSettings",
    "CameraSettings",
    "DriverSettings",
    "FrameTimingSettings",
    "IntrinsicsSettings",
    "LidarIntrinsicsSettings",
    "LidarSettings",
    "NominalExtrinsic",
    "QualitySettings",
    "Rig",
    "TimestampSettings",
    "as_yaml",
    "derive_text",
    "dump_rig",
    "edit_text",
    "find_profile",
    "lens_settings",
    "load_rig",
    "parse_rig",
    "read_profile",
    "set_value",
    "shipped_profiles",
]
