"""The profile of a rig: which sensors it carries, which board they look at, and what counts as good."""

from lce_rig.rig.board import BoardSettings
from lce_rig.rig.editing import derive_text, set_value
from lce_rig.rig.extrinsics import NominalExtrinsic
from lce_rig.rig.loading import dump_rig, find_profile, load_rig, parse_rig, shipped_profiles
from lce_rig.rig.profile import Rig
from lce_rig.rig.sensors import (
    CameraSettings,
    ChannelSettings,
    DriverSettings,
    IntrinsicsSettings,
    LidarSettings,
    TimestampSettings,
)
from lce_rig.rig.thresholds import CalibrationSettings, QualitySettings

__all__ = [
    "BoardSettings",
    "CalibrationSettings",
    "CameraSettings",
    "ChannelSettings",
    "DriverSettings",
    "IntrinsicsSettings",
    "LidarSettings",
    "NominalExtrinsic",
    "QualitySettings",
    "Rig",
    "TimestampSettings",
    "derive_text",
    "dump_rig",
    "find_profile",
    "load_rig",
    "parse_rig",
    "set_value",
    "shipped_profiles",
]
