"""The profile of a rig: start reading the schema here."""

from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError, model_validator

from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Scan
from lce_rig.core.errors import UsageError
from lce_rig.core.findings import Finding, Kind
from lce_rig.core.geometry import ROUNDING, Array, invert, pose, project_to_so3
from lce_rig.rig.board_settings import BoardSettings
from lce_rig.rig.sensors import (
    CameraSettings,
    ChannelSettings,
    LidarSettings,
)
from lce_rig.rig.settings import (
    Figure,
    FrameName,
    Name,
    Positive,
    RigName,
    RobotName,
    Row,
    Settings,
    Text,
    problem,
    require,
)
from lce_rig.rig.thresholds import CalibrationSettings, QualitySettings

_MOST_SENSORS = 64
OutputFormat = Literal[
    "extrinsics",
    "urdf",
    "camera_info",
    "static_tf",
    "ros2_launch",
    "tf_static_bag",
    "kalibr",
    "autoware",
    "fast_livo2",
    "koide3",
    "opencv",
    "mcap",
    "ply",
]


OutputFormats = tuple[OutputFormat, ...]

SWAPPED_SIDES = Kind(
    "profile.swapped_sides",
    "{subject}: {n_cols}x{n_rows} corners run along the shorter side of the plate "
    "{width_m:g} x {height_m:g} m",
    "check whether to swap width_m and height_m, or the [columns, rows]",
    severity="warning",
)
DRIFTING_CLOCK = Kind(
    "profile.drifting_clock",
    "{subject}: the sensor's own clock without sync drifts away from the others",
    severity="warning",
)
UNKNOWN_MODEL = Kind(
    "profile.unknown_model",
    "{subject}: the beams of {value} are not known: recordings can be calibrated, live guidance and "
    "simulation need elevations_deg and columns",
    "the model `other` measures them: `lce-rig rigs new --help`",
    severity="warning",
)

BOARD, PPS_LINE = "sync", "pps"
"""Reserved names: the sync board among the sensors, and its pulse per second among the camera lines."""
# Largest distance of two sensors of one rig, m; larger figures are in millimetres.
_Metres = Annotated[float, Field(ge=-20, le=20)]


class TriggerSettings(Settings):
    """The pulses that trigger one camera.

    Attributes:
        channel: number of the board's line.
        rate_hz: pulses per second.
        phase_us: delay of the first pulse of a second after its beginning.
        pulse_us: length of a pulse.
        max_delay_s: maximum delay of an image's timestamp after its pulse; as short as the camera allows.
    """

    channel: Annotated[int, Field(ge=0, le=15)]
    rate_hz: Annotated[float, Field(gt=0, le=1000)]
    phase_us: Annotated[int, Field(ge=0, lt=1_000_000)] = 0
    pulse_us: Annotated[int, Field(ge=1, lt=1_000_000)] = 100
    max_delay_s: Annotated[float, Field(gt=0, le=1)] = 0.1

    @model_validator(mode="after")
    def _pulses_fit_into_their_period(self) -> "TriggerSettings":
        period_us = 1e6 / self.rate_hz
        period = f"the period of {period_us:.0f} us"
        require(self.pulse_us < period_us, f"pulses of {self.pulse_us} us exceed {period}", "pulse_us")
        require(self.phase_us < period_us, f"{self.phase_us} us is beyond {period}", "phase_us")
        return self


class SyncSettings(Settings):
    """A board that generates the pulse per second and triggers cameras.

    Attributes:
        type: serial protocol: lce-rig's own (docs/sync-protocol.md).
        device: serial port of the board.
        baud: speed of the port; None for 115200; ignored over USB.
        triggers: the trigger lines, by the camera's name.
    """

    type: Literal["lce1"] = "lce1"
    device: Annotated[str, Field(min_length=1, max_length=4096)]
    baud: Annotated[int, Field(ge=1200, le=4_000_000)] | None = None
    triggers: dict[Name, TriggerSettings] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _lines_are_used_once(self) -> "SyncSettings":
        cameras: dict[int, str] = {}
        for camera, trigger in self.triggers.items():
            first = cameras.setdefault(trigger.channel, camera)
            what = f"line {trigger.channel} triggers {first} already"
            require(first == camera, what, f"triggers.{camera}.channel")
        return self

    @property
    def port_baud(self) -> int:
        """The speed of the port."""
        return self.baud or 115_200


class Mount(Settings):
    """The pose of one sensor on the robot, which makes the sensors part of the robot's tree of frames.

    Attributes:
        parent: a frame of the robot, such as base_link.
        of: the frame of the LiDAR, or of a camera's body, whose pose is given.
        xyz_m: origin of that frame in the parent's.
        rpy_deg: (roll, pitch, yaw) about the parent's fixed axes, R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF.
    """

    parent: FrameName
    of: FrameName
    xyz_m: Row
    rpy_deg: Row = (0.0, 0.0, 0.0)

    def to_matrix(self) -> Array:
        """Build T_parent_of (4, 4)."""
        from scipy.spatial.transform import Rotation

        R = Rotation.from_euler("xyz", self.rpy_deg, degrees=True).as_matrix()
        return pose(R, np.array(self.xyz_m))


class NominalExtrinsic(Settings):
    """The expected extrinsics of a camera, compared with the result.

    Only `calibrate --scene` uses them as the initial guess. They transform points from the LiDAR's frame to
    the camera's optical frame: p_cam = R p_lidar + t. Exactly one form of the rotation must be given.

    Attributes:
        quaternion_wxyz: unit quaternion of R, scalar first.
        rpy_deg: (roll, pitch, yaw) about fixed axes, R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF.
        matrix: the rows of R.
        translation_m: t, the LiDAR's origin in the optical frame.
        source: "cad" for this rig's CAD model, with which the result must agree; "typical" for a common
            mounting of such rigs, used for guidance and simulation but not to judge results.
        tolerance_deg, tolerance_m: larger differences from the result are reported.
    """

    camera: Name
    lidar: Name
    quaternion_wxyz: tuple[Figure, Figure, Figure, Figure] | None = None
    rpy_deg: Row | None = None
    matrix: tuple[Row, Row, Row] | None = None
    translation_m: tuple[_Metres, _Metres, _Metres]
    source: Literal["cad", "typical"] = "cad"
    tolerance_deg: Positive = 5.0
    tolerance_m: Positive = 0.1

    @model_validator(mode="after")
    def _is_a_pose(self) -> "NominalExtrinsic":
        rotations = [
            key for key in ("quaternion_wxyz", "rpy_deg", "matrix") if getattr(self, key) is not None
        ]
        names = " and ".join(rotations) if rotations else "none"
        ways = "quaternion_wxyz, rpy_deg, matrix"
        require(len(rotations) == 1, f"{names} given; give the rotation as one of {ways}")
        if self.quaternion_wxyz is not None:
            norm = float(np.linalg.norm(self.quaternion_wxyz))
            what = f"not a unit quaternion: its norm is {norm:.4g}"
            require(abs(norm - 1) <= ROUNDING, what, "quaternion_wxyz")
        if self.matrix is not None:
            R = np.array(self.matrix)
            error = float(np.abs(R @ R.T - np.eye(3)).max())
            what = f"not a rotation: R R^T differs from the identity by {error:.3g}"
            require(error <= 2 * ROUNDING, what, "matrix")
            what = "not a rotation but a mirroring: its determinant is -1"
            require(np.linalg.det(R) > 0, what, "matrix")
        return self

    def to_matrix(self) -> Array:
        """Build T_cam_lidar (4, 4)."""
        from scipy.spatial.transform import Rotation

        if self.quaternion_wxyz is not None:
            R = Rotation.from_quat(np.roll(self.quaternion_wxyz, -1)).as_matrix()
        elif self.rpy_deg is not None:
            R = Rotation.from_euler("xyz", self.rpy_deg, degrees=True).as_matrix()
        else:
            R = project_to_so3(np.array(self.matrix))
        return pose(R, np.array(self.translation_m))

    def corrections(self) -> dict[str, "NominalExtrinsic"]:
        """Build the entry without each usual error, by the error's name.

        "inverted": parent and child exchanged. "reordered": a quaternion given scalar last.
        "reordered_inverted": both.
        """
        from scipy.spatial.transform import Rotation

        entries = {}
        if self.quaternion_wxyz is not None:
            x, y, z, w = self.quaternion_wxyz
            entries["reordered"] = self.model_copy(update={"quaternion_wxyz": (w, x, y, z)})
        for error, entry in [("inverted", self), *((f"{name}_inverted", e) for name, e in entries.items())]:
            T = invert(entry.to_matrix())
            x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist()
            update = {"quaternion_wxyz": (w, x, y, z), "translation_m": tuple(T[:3, 3].tolist())}
            entries[error] = self.model_copy(update={"rpy_deg": None, "matrix": None, **update})
        return entries


class Rig(Settings):
    """A rig: its sensors and its board.

    Attributes:
        format_version: version of this schema.
        name: name of the rig; a session belongs to one rig by name.
        description: one line for `lce-rig rigs`.
        robot: name of the robot that carries this rig; stored in results.
        base_frame: a LiDAR's or camera's frame, root of the URDF; by default that of `mount`, or the first
            LiDAR's.
        mount: the pose of one sensor on the robot; the root is then a frame of the robot.
        exports: formats that `calibrate` and `export` write; empty for the usual ones.
        lidars: settings by the LiDAR's name; none where cameras are calibrated with each other alone.
        cameras: settings by the camera's name; none where LiDARs are calibrated with each other alone.
        nominal_extrinsics: the CAD model's values, a sanity check only.
        sync: the board that generates the pulse per second and triggers cameras; None without one.
    """

    format_version: Literal[1]
    name: RigName
    description: Text = ""
    robot: RobotName | None = None
    base_frame: FrameName | None = None
    mount: Mount | None = None
    exports: OutputFormats = ()
    board: BoardSettings
    lidars: Annotated[dict[Name, LidarSettings], Field(max_length=_MOST_SENSORS)] = Field(
        default_factory=dict
    )
    cameras: Annotated[dict[Name, CameraSettings], Field(max_length=_MOST_SENSORS)] = Field(
        default_factory=dict
    )
    nominal_extrinsics: tuple[NominalExtrinsic, ...] = ()
    sync: SyncSettings | None = None
    quality: QualitySettings = QualitySettings()
    calibration: CalibrationSettings = CalibrationSettings()

    def corrected(self, scan: Scan) -> Scan:
        """Subtract the LiDAR's constant range offset from a scan; a corrected one is returned unchanged."""
        return scan.corrected(self.lidars[scan.sensor].range_offset_m)

    def frame_of(self, sensor: str) -> str:
        """Return the frame of a LiDAR, or of a camera's body."""
        return (self.lidars.get(sensor) or self.cameras[sensor]).frame

    def lens_of(self, extrinsics: Calibration) -> Intrinsics:
        """Return the intrinsics that belong to extrinsics: their own, else the profile's."""
        own = extrinsics.intrinsics
        return self.cameras[extrinsics.camera].to_intrinsics() if own is None else own

    def with_lenses(self, extrinsics: Sequence[Calibration]) -> "Rig":
        """Replace the cameras' intrinsics by those used with extrinsics; the first of each camera counts."""
        cameras = dict(self.cameras)
        for each in reversed(extrinsics):
            if each.lidar in cameras and each.lidar_intrinsics is not None:
                cameras[each.lidar] = self.cameras[each.lidar].with_intrinsics(each.lidar_intrinsics)
            if each.camera in cameras:
                cameras[each.camera] = self.cameras[each.camera].with_intrinsics(self.lens_of(each))
        return self.model_copy(update={"cameras": cameras})

    @model_validator(mode="after")
    def _frames_are_unique(self) -> "Rig":
        used: dict[str, str] = {}
        for key, frame in self._frames():
            if frame in used:
                usual = key.split(".")[1] + ("_optical_frame" if key.endswith("optical_frame") else "_link")
                raise problem(
                    f"frame {frame} is used already by {used[frame]}; give it its own: {usual}", key
                )
            used[frame] = key
        roots = [frame for key, frame in self._frames() if not key.endswith("optical_frame")]
        mount = self.mount
        for key, root in (("base_frame", self.base_frame), ("mount.of", mount.of if mount else None)):
            what = f"no sensor has frame {root}; choose one of: {', '.join(roots)}"
            require(root in (None, *roots), what, key)
        if mount is not None:
            what = f"{mount.parent} is the frame of {used.get(mount.parent)}, not of the robot"
            require(mount.parent not in used, what, "mount.parent")
            what = f"differs from mount.of, {mount.of}, which would give it two parents; remove it"
            require(self.base_frame in (None, mount.of), what, "base_frame")
        return self

    def of_robot(self, name: str | None) -> "Rig":
        """Return the rig with the name of the robot that carries it; None changes nothing.

        Raises:
            UsageError: the profile names another robot, or the name is invalid.
        """
        if name is None or name == self.robot:
            return self
        if self.robot is not None:
            raise UsageError(
                f"this is a rig of robot {self.robot}, not of {name}",
                f"Omit --robot {name}, or use that robot's profile or session.",
            )
        try:
            TypeAdapter(RobotName).validate_python(name)
        except ValidationError:
            raise UsageError(
                f"{name!r} cannot name a robot", "Use letters, digits, dots, dashes and underscores."
            ) from None
        return self.model_copy(update={"robot": name})

    @property
    def root_frame(self) -> str:
        """The frame of a sensor from which others hang: `mount.of`, `base_frame` or the first sensor's."""
        first = next(iter([*self.lidars, *self.cameras]))
        return self.mount.of if self.mount is not None else self.base_frame or self.frame_of(first)

    @model_validator(mode="after")
    def _sensors_are_known(self) -> "Rig":
        for name in self.cameras:
            require(name not in self.lidars, f"{name} is the name of a LiDAR already", f"cameras.{name}")
        is_whole = (bool(self.lidars) and len(self.cameras) + len(self.lidars) >= 2) or len(self.cameras) >= 2
        require(is_whole, "a rig has a camera and a LiDAR, two LiDARs or two cameras", "cameras")
        if self.cameras and self.board.type == "plain":
            what = f"a plain plate has no pattern for {next(iter(self.cameras))}"
            raise problem(f"{what}; describe the pattern of your board, or remove the cameras", "board.type")
        used: set[tuple[str, str]] = set()
        for index, entry in enumerate(self.nominal_extrinsics):
            of_lidars = [name for name in self.lidars if name != entry.lidar]
            of_cameras = [name for name in self.cameras if name != entry.camera]
            seconds = list(self.lidars) if self.lidars else of_cameras
            for kind, name, names_of_rig in (
                ("camera", entry.camera, [*self.cameras, *of_lidars]),
                ("lidar" if self.lidars else "camera", entry.lidar, seconds),
            ):
                what = f"no {kind} is called {name}; there is {', '.join(names_of_rig)}"
                require(name in names_of_rig, what, f"nominal_extrinsics.{index}.{kind}")
            pair = entry.camera, entry.lidar
            what = f"a second entry for {entry.camera} and {entry.lidar}"
            require(pair not in used, what, f"nominal_extrinsics.{index}")
            used.add(pair)
        for name in self.sync.triggers if self.sync else ():
            what = f"no camera is called {name}; choose one of: {', '.join(self.cameras)}"
            require(name in self.cameras, what, f"sync.triggers.{name}")
        return self

    def _frames(self) -> Iterator[tuple[str, str]]:
        for name, lidar in self.lidars.items():
            yield f"lidars.{name}.frame", lidar.frame
        for name, camera in self.cameras.items():
            yield f"cameras.{name}.frame", camera.frame
            yield f"cameras.{name}.optical_frame", camera.optical_frame

    def warnings(self) -> Iterator[Finding]:
        """List valid but probably unintended settings; the subject is the key."""
        board = self.board.to_board()
        cols, rows, width_m, height_m = board.cols, board.rows, board.width_m, board.height_m
        if (cols - rows) * (width_m - height_m) < 0:
            yield SWAPPED_SIDES("board", n_cols=cols, n_rows=rows, width_m=width_m, height_m=height_m)
        streams: dict[str, LidarSettings | ChannelSettings] = {
            f"lidars.{name}": lidar for name, lidar in self.lidars.items()
        }
        for name, camera in self.cameras.items():
            streams |= {f"cameras.{name}.channels.{n}": channel for n, channel in camera.channels.items()}
        for key, stream in streams.items():
            if stream.timestamps.clock == "device" and stream.timestamps.sync == "none":
                yield DRIFTING_CLOCK(f"{key}.timestamps")
        for name, lidar in self.lidars.items():
            if lidar.data_sheet() is None:
                yield UNKNOWN_MODEL(f"lidars.{name}.model", value=lidar.model)

    def nominal(self, camera: str, lidar: str) -> NominalExtrinsic | None:
        """Find the CAD pose of a pair of sensors; None if the profile has none."""
        matches = (
            entry for entry in self.nominal_extrinsics if (entry.camera, entry.lidar) == (camera, lidar)
        )
        return next(matches, None)
