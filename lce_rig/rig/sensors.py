"""The sensors' blocks of a profile: LiDARs, cameras, their channels, drivers and clocks."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from lce_rig.core.camera import Intrinsics
from lce_rig.core.data_sheets import TYPICAL, VLP_16, DataSheet, find_data_sheet
from lce_rig.rig.settings import (
    Deviation,
    Figure,
    FrameName,
    Name,
    NotNegative,
    Positive,
    Rate,
    Settings,
    Text,
    TopicName,
    require,
)

MAX_PIXELS = 1 << 26
"""Of a camera; OpenCV reads no larger images (`lce_rig/__init__.py`)."""

LIDAR_DRIVERS, CAMERA_DRIVERS = ("vlp16", "ros2"), ("v4l2", "command", "davis", "ros2")
"""Values of `driver.type`."""
Elevation = Annotated[float, Field(ge=-90, le=90)]
Coefficient = Annotated[float, Field(ge=-1000, le=1000)]
_COUNTS = {"radtan": ((0, 4, 5, 8), "4, 5 or 8 (or none)"), "equidistant": ((4,), "4")}


class TimestampSettings(Settings):
    """The meaning of a sensor's timestamps.

    Attributes:
        clock: clock of the timestamps: the sensor's own, the computer's, or UTC by GPS or PTP.
        reference: the moment a timestamp marks: start or middle of the exposure, first or last firing.
        sync: how clocks are synchronised: by a shared pulse, by PTP, or not at all.
        expected_offset_s: offset to add to these timestamps to get the rig's time.
        tolerance_s: maximum time difference of an image and a scan after that.
    """

    clock: Literal["device", "host", "utc"] = "host"
    reference: Literal["start", "mid_exposure", "first_firing", "last_firing"]
    sync: Literal["hardware", "ptp", "none"] = "none"
    expected_offset_s: Annotated[float, Field(ge=-1e10, le=1e10)] = 0.0
    tolerance_s: Annotated[float, Field(gt=0, le=60)] = 0.05


class FrameTimingSettings(Settings):
    """The meaning of the kernel's timestamp of an image, if the camera's driver does not report it correctly.

    Attributes:
        clock: the clock that timestamps images; "auto" finds the one that fits.
        mark: the moment that is timestamped; "auto" uses the driver's flags.
        exposure_us: exposure time of a row; None to read it from the camera.
        line_time_us: time between rows of a rolling shutter; 0 for a global one.
        trigger_delay_us: time from the trigger's edge to the start of the first row's exposure.
    """

    clock: Literal["auto", "monotonic", "monotonic_raw", "tsc", "boottime", "realtime"] = "auto"
    mark: Literal["auto", "start_of_exposure", "start_of_frame", "end_of_frame", "trigger"] = "auto"
    exposure_us: Positive | None = None
    line_time_us: Annotated[float, Field(ge=0, le=1000)] = 0.0
    trigger_delay_us: NotNegative = 0.0


class DriverSettings(Settings):
    """The connection to a live sensor.

    Attributes:
        type: the driver; None for the default driver of the model.
        port: UDP port of a networked sensor.
        address: IP address of a networked sensor.
        device: device file or serial number of an attached sensor.
        command: program and arguments whose standard output is the camera's images.
        pixel_format: four characters of the pixel format ("UYVY"); None for the camera's first.
        frame_rate_hz: images per second; None for the camera's own rate.
        frame_timing: the meaning of an image's timestamp.
        controls: settings passed to the driver unchanged.
    """

    type: Literal["vlp16", "v4l2", "command", "davis", "ros2"] | None = None
    port: Annotated[int, Field(ge=1, le=65535)] | None = None
    address: Text | None = None
    device: Text | None = None
    command: Annotated[tuple[Text, ...], Field(max_length=1000)] = ()
    pixel_format: Text | None = None
    frame_rate_hz: Rate | None = None
    frame_timing: FrameTimingSettings = FrameTimingSettings()
    controls: dict[Text, bool | int | float | Text] = Field(default_factory=dict)


class LaserSettings(Settings):
    """Constant errors of one laser, with their standard deviations about the errors common to all.

    Attributes:
        ring: the ring's number.
        range_m: range error, positive for too long.
        azimuth_deg, elevation_deg: deviation of the true beam from the reported one.
    """

    ring: Annotated[int, Field(ge=0, le=1000)]
    range_m: Annotated[float, Field(ge=-1, le=1)]
    range_sigma_m: Annotated[float, Field(gt=0, le=0.2)]
    azimuth_deg: Annotated[float, Field(ge=-5, le=5)] = 0.0
    azimuth_sigma_deg: Annotated[float, Field(gt=0, le=5)] = 0.023
    elevation_deg: Annotated[float, Field(ge=-5, le=5)] = 0.0
    elevation_sigma_deg: Annotated[float, Field(gt=0, le=5)] = 0.011


class LidarIntrinsicsSettings(Settings):
    """Constant errors of a LiDAR, as `lce-rig lidar-intrinsics` measures them, for the joint estimate.

    Attributes:
        lens_lateral_m: displacement of the beams' origin from the axis, towards growing azimuth.
        lens_vertical_m_per_rad: height of that origin, per rad of elevation.
        lasers: errors of each laser.
    """

    lens_lateral_m: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    lens_lateral_sigma_m: Annotated[float, Field(gt=0, le=0.5)] = 0.02
    lens_vertical_m_per_rad: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    lens_vertical_sigma_m_per_rad: Annotated[float, Field(gt=0, le=0.5)] = 0.04
    lasers: Annotated[tuple[LaserSettings, ...], Field(min_length=1, max_length=256)]


class LidarSettings(Settings):
    """One LiDAR; figures that the profile omits are those of the model's data sheet.

    Attributes:
        model: maker's name of the model, or "other".
        serial: serial number of the unit, for devices that do not report it.
        frame: frame of its points, x forward, y left, z up.
        topic: topic of its point clouds in bags.
        rate_hz: rate of its scans. Without rings, faster scans are accumulated to this rate.
        min_range_m: nearer returns are ignored.
        max_range_m: farther returns are ignored.
        elevations_deg: elevations of the rings, lowest first; None for the model's.
        columns: firings of each ring per revolution; None for the model's.
        beam_aperture_m: width of the light beam at the sensor's exit; 0 for an ideal one.
        beam_divergence_rad: full divergence angle of the beam.
        range_offset_m: constant excess of the driver's ranges, the same for all; subtracted first.
        laser_bias_sigma_m: standard deviation of the lasers' constant range errors about their mean.
        range_offset_sigma_m: standard deviation of that mean, the error common to all ranges left after
            `range_offset_m`.
        intrinsics: measured constant errors; None if there are none.
    """

    model: Text = VLP_16.name
    serial: Text | None = None
    frame: FrameName = "lidar_link"
    topic: TopicName | None = None
    rate_hz: Rate = 10.0
    elevations_deg: Annotated[tuple[Elevation, ...], Field(min_length=2, max_length=1024)] | None = None
    columns: Annotated[int, Field(ge=16, le=65536)] | None = None
    min_range_m: NotNegative
    max_range_m: Positive
    beam_aperture_m: NotNegative
    beam_divergence_rad: NotNegative
    range_offset_m: Annotated[float, Field(ge=-1, le=1)] = 0.0
    laser_bias_sigma_m: Deviation
    range_offset_sigma_m: Deviation
    intrinsics: LidarIntrinsicsSettings | None = None
    timestamps: TimestampSettings = TimestampSettings(reference="first_firing")
    driver: DriverSettings = DriverSettings()

    @model_validator(mode="before")
    @classmethod
    def _follows_its_data_sheet(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        model = values.get("model", VLP_16.name)
        sheet = (find_data_sheet(model) if isinstance(model, str) else None) or TYPICAL
        return {
            "min_range_m": sheet.range_m[0],
            "max_range_m": sheet.range_m[1],
            "beam_aperture_m": sheet.aperture_m,
            "beam_divergence_rad": sheet.divergence_rad[0],
            "laser_bias_sigma_m": sheet.laser_bias_sigma_m,
            "range_offset_sigma_m": sheet.range_offset_sigma_m,
            "rate_hz": 10.0 if sheet.has_rings else 1.0,
        } | values

    def data_sheet(self) -> DataSheet | None:
        """Return the model's data sheet, with the profile's own beams; None if the beams are unknown."""
        sheet = find_data_sheet(self.model)
        if sheet is None and self.elevations_deg is None:
            return None
        return (sheet or TYPICAL).with_rings(self.elevations_deg, self.columns)

    @property
    def has_rings(self) -> bool:
        """Whether its beams sweep cones about its axis; assumed for unknown models."""
        sheet = self.data_sheet()
        return sheet is None or sheet.has_rings or self.elevations_deg is not None

    @model_validator(mode="after")
    def _is_consistent(self) -> "LidarSettings":
        is_rising = self.elevations_deg is None or bool(np.all(np.diff(self.elevations_deg) > 0))
        require(is_rising, "the elevations do not rise", "elevations_deg")
        what = f"{self.min_range_m:g} m is not below max_range_m {self.max_range_m:g} m"
        require(self.min_range_m < self.max_range_m, what, "min_range_m")
        what = f"{self.timestamps.reference} belongs to a camera; a LiDAR has first_firing or last_firing"
        is_of_lidar = self.timestamps.reference in ("first_firing", "last_firing")
        require(is_of_lidar, what, "timestamps.reference")
        return self


def lens_block(lens: Intrinsics) -> dict[str, Any]:
    """List the keys of a lens in a camera's block `intrinsics`."""
    pixels = {key: getattr(lens, key) for key in ("fx_px", "fy_px", "cx_px", "cy_px")}
    return {"model": lens.model, **pixels, "distortion": list(lens.distortion)}


class IntrinsicsSettings(Settings):
    """A camera matrix and its distortion; pixel centres at integers.

    Attributes:
        model: radtan (OpenCV's and ROS's plumb_bob) or equidistant (OpenCV's fisheye).
        distortion: radtan k1 k2 p1 p2 [k3 [k4 k5 k6]]; equidistant k1 k2 k3 k4.
        focal_sigma_px: common standard deviation of both focal lengths; by default 0.25 % of `fx_px`.
        principal_point_sigma_px: standard deviation of `cx_px` and of `cy_px`; by default 0.4 % of `fx_px`.
        distortion_sigma_px: standard deviation of a pixel's displacement in the image's corner by errors of
            the distortion; by default 0.25 % of `fx_px`.
    """

    model: Literal["radtan", "equidistant"] = "radtan"
    fx_px: Positive
    fy_px: Positive
    cx_px: Figure
    cy_px: Figure
    distortion: tuple[Coefficient, ...] = ()
    focal_sigma_px: NotNegative | None = None
    principal_point_sigma_px: NotNegative | None = None
    distortion_sigma_px: NotNegative | None = None

    @model_validator(mode="after")
    def _has_right_number_of_coefficients(self) -> "IntrinsicsSettings":
        counts, wanted = _COUNTS[self.model]
        what = f"{len(self.distortion)} coefficients given, {self.model} has {wanted}"
        require(len(self.distortion) in counts, what, "distortion")
        return self


class ChannelSettings(Settings):
    """One stream of a camera.

    Attributes:
        kind: "frames", or "events" and the images reconstructed from them.
        topic: topic of its images or events in bags.
    """

    kind: Literal["frames", "events"] = "frames"
    topic: TopicName | None = None
    timestamps: TimestampSettings = TimestampSettings(reference="mid_exposure")

    @model_validator(mode="after")
    def _is_consistent(self) -> "ChannelSettings":
        what = f"{self.timestamps.reference} belongs to a LiDAR; a camera has start or mid_exposure"
        require(self.timestamps.reference in ("start", "mid_exposure"), what, "timestamps.reference")
        return self


class CameraSettings(Settings):
    """One camera: pixels, lens and the channels that share them.

    Attributes:
        model: maker's name of the model.
        serial: serial number of the unit, for devices that do not report it.
        frame: the camera's body frame, x forward, y left, z up.
        optical_frame: frame of its optics, x right, y down, z forward.
        resolution_px: (width, height) of the images.
    """

    model: Text = ""
    serial: Text | None = None
    frame: FrameName = "camera_link"
    optical_frame: FrameName = "camera_optical_frame"
    resolution_px: tuple[Annotated[int, Field(ge=16, le=65535)], Annotated[int, Field(ge=16, le=65535)]]
    intrinsics: IntrinsicsSettings
    channels: Annotated[dict[Name, ChannelSettings], Field(min_length=1, max_length=64)] = Field(
        default_factory=lambda: {"frames": ChannelSettings()}
    )
    driver: DriverSettings = DriverSettings()

    @model_validator(mode="after")
    def _intrinsics_belong_to_resolution(self) -> "CameraSettings":
        lens, size = self.intrinsics, self.resolution_px
        what = f"{size[0]}x{size[1]} px exceed the limit of {MAX_PIXELS} pixels"
        require(size[0] * size[1] <= MAX_PIXELS, what, "resolution_px")
        doubled = f"{round(2 * lens.cx_px)}x{round(2 * lens.cy_px)}"
        hint = f"; check whether they belong to another resolution (about {doubled} px)"
        for axis, side, centre, focal, length in (
            ("x", "width", lens.cx_px, lens.fx_px, size[0]),
            ("y", "height", lens.cy_px, lens.fy_px, size[1]),
        ):
            what = f"{centre:g} lies outside the image, whose {side} is {length} px"
            require(0 < centre < length - 1, what + hint, f"intrinsics.c{axis}_px")
            what = f"a focal length of {focal:g} px is implausible for images with a {side} of {length} px"
            require(0.1 <= focal / length <= 30, what + hint, f"intrinsics.f{axis}_px")
        # A lens is near the middle; numbers of another resolution differ by the same factor in x and y.
        x, y = lens.cx_px / size[0], lens.cy_px / size[1]
        is_near = max(x, y) >= 0.4 and min(x, y) <= 0.6 and 0.2 < x < 0.8 and 0.2 < y < 0.8
        point = f"{lens.cx_px:g}, {lens.cy_px:g}"
        what = f"the principal point {point} is far from the middle of {size[0]}x{size[1]} px"
        require(is_near, what + hint, "intrinsics")
        what = "fx_px and fy_px differ by more than a factor of two"
        require(0.5 < lens.fx_px / lens.fy_px < 2, what, "intrinsics.fy_px")
        return self

    def first_channel(self, kind: Literal["frames", "events"]) -> str | None:
        """Return the first channel of a kind, or None."""
        return next((name for name, channel in self.channels.items() if channel.kind == kind), None)

    def with_intrinsics(self, lens: Intrinsics) -> "CameraSettings":
        """Replace the camera's intrinsics; their standard deviations stay those of the profile."""
        values = lens_block(lens) | {"distortion": lens.distortion}
        return self.model_copy(update={"intrinsics": self.intrinsics.model_copy(update=values)})

    def to_intrinsics(self) -> Intrinsics:
        """Build the camera model for the algorithms."""
        lens = self.intrinsics
        return Intrinsics(
            lens.fx_px,
            lens.fy_px,
            lens.cx_px,
            lens.cy_px,
            *self.resolution_px,
            model=lens.model,
            distortion=lens.distortion,
        )
