"""The profile of a rig: start reading the schema here."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import UsageError
from lce_rig.core.findings import Finding
from lce_rig.rig.board_settings import BoardSettings
from lce_rig.rig.findings import (
    DRIFTING_CLOCK,
    ODD_RATE,
    SHARED,
    SWAPPED_SIDES,
    UNKNOWN_MODEL,
)
from lce_rig.rig.poses import Mount, NominalExtrinsic
from lce_rig.rig.sensors import (
    CameraSettings,
    ChannelSettings,
    LidarSettings,
)
from lce_rig.rig.settings import FrameName, Name, RigName, RobotName, Settings, Text, problem
from lce_rig.rig.sync_settings import SyncSettings
from lce_rig.rig.target_settings import OutputFormat, TargetSettings
from lce_rig.rig.thresholds import CalibrationSettings, QualitySettings, VerdictSettings

_MOST_SENSORS, _MOST_TARGETS = 64, 256
_USUAL_RATE_HZ = 4.0, 40.0


class Rig(Settings):
    """A rig: its sensors and its board.

    Attributes:
        format_version: version of this schema.
        name: name of the rig; a session belongs to one rig by name.
        description: one line for `lce-rig rigs`.
        robot: name of the robot that carries this very rig; results name it.
        base_frame: a LiDAR's or camera's frame, root of the URDF; by default that of `mount`, or the first
            LiDAR's.
        mount: the pose of one sensor on the robot; the root is then a frame of the robot.
        exports: formats that `calibrate` and `export` write; empty for the usual ones.
        lidars: settings by the LiDAR's name.
        cameras: settings by the camera's name.
        nominal_extrinsics: the CAD model's values, a sanity check only.
        targets: where `lce-rig deploy` writes results, by name.
        sync: the board that makes the pulse per second and triggers cameras; None without one.
    """

    format_version: Literal[1]
    name: RigName
    description: Text = ""
    robot: RobotName | None = None
    base_frame: FrameName | None = None
    mount: Mount | None = None
    exports: tuple[OutputFormat, ...] = ()
    board: BoardSettings
    lidars: Annotated[dict[Name, LidarSettings], Field(min_length=1, max_length=_MOST_SENSORS)]
    cameras: Annotated[dict[Name, CameraSettings], Field(min_length=1, max_length=_MOST_SENSORS)]
    nominal_extrinsics: tuple[NominalExtrinsic, ...] = ()
    sync: SyncSettings | None = None
    targets: Annotated[dict[RobotName, TargetSettings], Field(max_length=_MOST_TARGETS)] = Field(
        default_factory=dict
    )
    quality: QualitySettings = QualitySettings()
    calibration: CalibrationSettings = CalibrationSettings()
    verdict: VerdictSettings = VerdictSettings()

    def lens_of(self, extrinsics: Calibration) -> Intrinsics:
        """Return the intrinsics that belong to extrinsics: their own, else the profile's."""
        own = extrinsics.intrinsics
        return self.cameras[extrinsics.camera].to_intrinsics() if own is None else own

    def with_lenses(self, extrinsics: Sequence[Calibration]) -> "Rig":
        """Replace the cameras' intrinsics by those that belong to extrinsics; the first of a camera count."""
        cameras = dict(self.cameras)
        for each in reversed(extrinsics):
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
        if self.base_frame is not None and self.base_frame not in roots:
            raise problem(f"no sensor has frame {self.base_frame}; there is {', '.join(roots)}", "base_frame")
        if self.mount is not None:
            if self.mount.of not in roots:
                raise problem(f"no sensor has frame {self.mount.of}; there is {', '.join(roots)}", "mount.of")
            if self.mount.parent in used:
                what = f"{self.mount.parent} is the frame of {used[self.mount.parent]}, not of the robot"
                raise problem(what, "mount.parent")
            if self.base_frame not in (None, self.mount.of):
                what = f"differs from mount.of, {self.mount.of}, which would give it two parents; remove it"
                raise problem(what, "base_frame")
        return self

    def of_robot(self, name: str | None) -> "Rig":
        """Name the robot that carries this very rig; None leaves it as it is.

        Raises:
            UsageError: the profile names another one, or it cannot be a name.
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
        """The frame of a sensor from which the others hang: `mount.of`, `base_frame` or the first LiDAR's."""
        first = next(iter(self.lidars.values())).frame
        return self.mount.of if self.mount is not None else self.base_frame or first

    @model_validator(mode="after")
    def _sensors_are_known(self) -> "Rig":
        for name in self.cameras:
            if name in self.lidars:
                raise problem(f"{name} is the name of a LiDAR already", f"cameras.{name}")
        used: set[tuple[str, str]] = set()
        for index, entry in enumerate(self.nominal_extrinsics):
            for kind, name, names_of_rig in (
                ("camera", entry.camera, list(self.cameras)),
                ("lidar", entry.lidar, list(self.lidars)),
            ):
                if name not in names_of_rig:
                    what = f"no {kind} is called {name}; there is {', '.join(names_of_rig)}"
                    raise problem(what, f"nominal_extrinsics.{index}.{kind}")
            if (entry.camera, entry.lidar) in used:
                what = f"a second entry for {entry.camera} and {entry.lidar}"
                raise problem(what, f"nominal_extrinsics.{index}")
            used.add((entry.camera, entry.lidar))
        for name in self.sync.triggers if self.sync else ():
            if name not in self.cameras:
                what = f"no camera is called {name}; there is {', '.join(self.cameras)}"
                raise problem(what, f"sync.triggers.{name}")
        return self

    def _frames(self) -> Iterator[tuple[str, str]]:
        for name, lidar in self.lidars.items():
            yield f"lidars.{name}.frame", lidar.frame
        for name, camera in self.cameras.items():
            yield f"cameras.{name}.frame", camera.frame
            yield f"cameras.{name}.optical_frame", camera.optical_frame

    def located(self, folder: Path) -> "Rig":
        """Make the paths in a profile absolute; relative ones start at the folder its file lies in."""
        cameras = {
            name: camera.model_copy(
                update={"channels": {key: each.located(folder) for key, each in camera.channels.items()}}
            )
            for name, camera in self.cameras.items()
        }
        targets = {name: target.located(folder) for name, target in self.targets.items()}
        return self.model_copy(update={"cameras": cameras, "targets": targets})

    def warnings(self) -> Iterator[Finding]:
        """List valid but probably unintended settings; the subject is the key."""
        board = self.board.to_board()
        cols, rows, width_m, height_m = board.cols, board.rows, board.width_m, board.height_m
        if (cols - rows) * (width_m - height_m) < 0:
            yield SWAPPED_SIDES("board", n_cols=cols, n_rows=rows, width_m=width_m, height_m=height_m)
        # Streams have timestamps and a topic of their own, cameras a device.
        streams: dict[str, LidarSettings | ChannelSettings] = {
            f"lidars.{name}": lidar for name, lidar in self.lidars.items()
        }
        for name, camera in self.cameras.items():
            streams |= {f"cameras.{name}.channels.{n}": channel for n, channel in camera.channels.items()}
        for key, stream in streams.items():
            if stream.timestamps.clock == "device" and stream.timestamps.sync == "none":
                yield DRIFTING_CLOCK(f"{key}.timestamps")
        # A copied block leaves settings that two sensors cannot share.
        unshared = [(f"{key}.topic", "topic", stream.topic) for key, stream in streams.items()]
        unshared += [
            (f"cameras.{n}.driver.device", "device", c.driver.device) for n, c in self.cameras.items()
        ]
        first: dict[tuple[str, str], str] = {}
        for key, kind, value in unshared:
            if value is not None and first.setdefault((kind, value), key) != key:
                yield SHARED(key, value=value, other=first[kind, value])
        for name, lidar in self.lidars.items():
            if lidar.has_rings and not _USUAL_RATE_HZ[0] <= lidar.rate_hz <= _USUAL_RATE_HZ[1]:
                yield ODD_RATE(f"lidars.{name}.rate_hz", rate_hz=lidar.rate_hz)
            if lidar.data_sheet() is None:
                yield UNKNOWN_MODEL(f"lidars.{name}.model", value=lidar.model)

    def nominal(self, camera: str, lidar: str) -> NominalExtrinsic | None:
        """Find the CAD pose of a pair of sensors; None if the profile has none."""
        matches = (
            entry for entry in self.nominal_extrinsics if (entry.camera, entry.lidar) == (camera, lidar)
        )
        return next(matches, None)
