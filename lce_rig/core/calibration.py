"""The result of a calibration: `Calibration`, one camera and one LiDAR, and `ResultFile`, result.json.

The fields of both are the keys of the file, in the order of the file. pydantic reads and writes them by their
annotations; records created by the program are not checked again. A further figure is one further field.
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np
from pydantic import (
    BeforeValidator,
    Field,
    PlainSerializer,
    PlainValidator,
    TypeAdapter,
    ValidationError,
    WrapSerializer,
    WrapValidator,
)

import lce_rig
from lce_rig.core.bounds import MAX_BYTES
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import ResultRefusedError, SessionError, reading
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.geometry import Array, parse_pose, sigma_sizes
from lce_rig.core.results import Observation

MADE_BY = f"lce-rig {lce_rig.__version__}"
_MOST = 1e100
"""Products of figures up to this one stay far from overflow."""


def _array(rows: Any) -> Array:
    array = np.array(rows, dtype=np.float64)
    if not (np.abs(array) <= _MOST).all():
        raise ValueError("contains values that are not numbers")
    return array


def _pose(rows: Any) -> Array:
    parse_pose(rows)  # only a check: the digits of the file are kept
    return _array(rows)


def _covariance(rows: Any) -> Array:
    cov = _array(rows)
    if cov.shape != (6, 6) or not np.allclose(cov, cov.T, rtol=1e-6, atol=1e-18):
        raise ValueError("is not a symmetric 6x6 matrix of numbers")
    if np.diag(cov).min() < 0:
        raise ValueError("a variance is negative")
    return cov


def _record(record: Any) -> Any:
    """Name a stored finding's keys like its fields."""
    if not isinstance(record, dict):
        return record
    words = record.get("cause", record.get("text")), record.get("action")
    return {**record, "action": record.get("action_code"), "stored": words}


# Adding 0.0 turns -0.0 into 0.0.
_LISTS = PlainSerializer(lambda array: (array.astype(np.float64) + 0.0).tolist())
_WITHOUT_NULL = BeforeValidator(lambda values: {key: v for key, v in values.items() if v is not None})
_NULL = PlainSerializer(lambda number: float(number) if math.isfinite(number) else None)
_OR_NAN = WrapValidator(lambda number, check: math.nan if number is None else check(number))
_OR_INF = WrapValidator(lambda number, check: math.inf if number is None else check(number))
Pose = Annotated[Array, PlainValidator(_pose), _LISTS]
"""(4, 4), a rigid transform."""
Covariance = Annotated[Array, PlainValidator(_covariance), _LISTS]
"""(6, 6), tangent (translation m, rotation rad), axes of the camera."""
Values = Annotated[Array, PlainValidator(_array), _LISTS]
"""Of any shape."""
Number = Annotated[float, Field(ge=-_MOST, le=_MOST), _OR_NAN, _NULL]
"""null in the file where it is not known."""
Size = Annotated[float, Field(ge=0, le=_MOST), _OR_NAN, _NULL]
"""A number that is not negative."""
Distance = Annotated[float, Field(ge=0, le=_MOST), _OR_INF, _NULL]
"""A size that may be infinite; null in the file."""
Count = Annotated[int, Field(ge=0)]
StoredFinding = Annotated[Finding, BeforeValidator(_record), PlainSerializer(Finding.as_json)]
StoredRefusal = Annotated[Refusal, BeforeValidator(_record), PlainSerializer(Refusal.as_json)]
_ANY, _IN_MEMORY = PlainValidator(lambda value: value), Field(exclude=True)
"""Of fields that the file does not keep."""


Method = Literal["ml", "paper"]
DEFAULT_METHOD: Method = "ml"
"""How extrinsics are estimated: the joint maximum likelihood, or Algorithm 1 of LCE-Calib."""

Verdict = Literal["pass", "marginal", "fail"]
BY_SCENE = "scene"
"""Method of extrinsics that a scene determined, without a board."""


@dataclass(frozen=True)
class Certificate:
    """Proof that a pose is the global minimum of its cost.

    Attributes:
        is_optimal: whether the gap is below the tolerance.
        gap: bound on (cost - global minimum) / cost.
    """

    is_optimal: bool
    gap: Distance


@dataclass(frozen=True)
class Metrics:
    """Errors of the extrinsics; docs/conventions.md defines them.

    Attributes:
        mpe_m: mean over captures of the mean distance of LiDAR board points from the camera's board plane.
        mee_m: mean over captures of the mean distance of ring ends from the board's edges.
        mge_m: mpe_m + mee_m.
        reprojection_px: rms corner residual of the board poses.
    """

    mpe_m: Size
    mee_m: Size
    reprojection_px: Size

    @property
    def mge_m(self) -> float:
        """Mean geometric error, the paper's summary figure."""
        return self.mpe_m + self.mee_m


@dataclass(frozen=True)
class Diagnostics:
    """Diagnostic figures of the method and of the checks on its result; NaN if missing.

    Keys of result.json have these names.
    """

    n_placements: float = math.nan  # number of different placements of the board among the captures used
    held_out_m: float = math.nan  # mean rms residual of the held-out captures
    # Algorithm 1's residuals, rms over captures.
    fit_plane_rms_m: float = math.nan
    fit_edge_rms_m: float = math.nan
    # Parts of the standard deviations: from the scatter between captures, and from errors common to all.
    sigma_scatter_rotation_deg: float = math.nan
    sigma_scatter_translation_m: float = math.nan
    sigma_systematic_rotation_deg: float = math.nan
    sigma_systematic_translation_m: float = math.nan
    edge_shift_m: float = math.nan  # distance of ring ends beyond the board's edges
    edge_shift_sigma_m: float = math.nan
    # Additional edge shift caused by the background behind the board.
    edge_shift_echo_m: float = math.nan
    edge_shift_blended_m: float = math.nan
    edge_shift_blended_echo_m: float = math.nan
    covariance_inflation: float = math.nan  # factor on the joint covariance, from leave-one-out results
    range_offset_m: float = math.nan  # mean range error of all lasers
    mpe_corrected_m: float = math.nan  # Metrics.mpe_m corrected for the LiDAR's estimated errors
    laser_spread_m: float = math.nan  # standard deviation of the lasers' range errors
    lens_vertical_m_per_rad: float = math.nan  # displacement of the LiDAR's lens
    camera_scale: float = math.nan  # scale of the camera's distances
    noise_range_m: float = math.nan  # of ranges
    # Noise of the board's pose from the camera, not covered by corner noise.
    noise_tilt_deg: float = math.nan
    noise_spin_deg: float = math.nan
    noise_depth_m: float = math.nan
    noise_across_m: float = math.nan

    def figures(self) -> dict[str, float]:
        """List the figures that are not NaN by name, sorted."""
        return {name: value for name, value in sorted(asdict(self).items()) if not math.isnan(value)}


@dataclass(frozen=True)
class ChannelResult:
    """One channel of a camera, with its time offset.

    Attributes:
        channel: the channel's name.
        n_captures: captures in which it shows the board and agrees with the others.
        noise_px: corner noise per coordinate, from the residuals of all its images.
        time_offset_s: correction to add to its timestamps, beyond the profile's expected offset, to reach the
            LiDAR's time; images without timestamps count from the scan's first firing. None if nothing moved.
        time_offset_sigma_s: standard deviation of that.
    """

    channel: str
    n_captures: Count
    noise_px: Size
    time_offset_s: Number | None = None
    time_offset_sigma_s: Size | None = None


@dataclass(frozen=True)
class PointUncertainty:
    """Standard deviations of the position error of LiDAR points transformed to the camera.

    Attributes:
        distance_m: distance of the point from the camera.
        centre_px, centre_m: in the middle of the image; in it, and in space.
        corner_px, corner_m: in the least certain corner.
    """

    distance_m: Size
    centre_px: Size
    centre_m: Size
    corner_px: Size
    corner_m: Size


@dataclass(frozen=True)
class Contribution:
    """One cause of the standard deviations of extrinsics; the squares of all causes add up.

    Attributes:
        source: "captures" (their scatter), "lidar_ranges", an error of the profile's lens or board such as
            "intrinsics" or "square_size", "algorithm_1" (its difference from the likelihood's estimate), or
            "contradiction_" with the check that contradicts.
        sigma_rotation_deg, sigma_translation_m: its contribution.
    """

    source: str
    sigma_rotation_deg: Size
    sigma_translation_m: Size


@dataclass(frozen=True, eq=False)
class OtherCamera:
    """The pose of a camera relative to another one that saw the same boards in the same scans.

    Attributes:
        camera: name of the other one.
        n_captures: number of captures used by both.
        T_cam_other: (4, 4) to which the extrinsics of both with the LiDAR compose, p_cam = R p_other + t.
        cov: (6, 6) of it, tangent (translation m, rotation rad), axes of the camera; None if the
            extrinsics were not estimated together.
        apart_rotation_deg, apart_translation_m: distance of the pose by the images of both alone from the
            composition of the extrinsics, each estimated separately; None with too few boards.
        board_rms_m: distance between their middles of the same board, rms.
    """

    camera: str
    n_captures: Count
    T_cam_other: Pose
    cov: Covariance | None
    apart_rotation_deg: Size | None
    apart_translation_m: Size | None
    board_rms_m: Size


class CaptureResidual(NamedTuple):
    """Residuals of one capture under given extrinsics.

    Attributes:
        capture: the capture's name.
        plane_mean_m, plane_rms_m: distance of the LiDAR's board points from the camera's board plane.
        edge_mean_m, edge_rms_m: distance in the board's plane of ring ends from the board's edges.
        held_out_m: rms of both where the capture was not fitted; of two LiDARs by Algorithm 1, their start.
        reprojection_px: rms corner residual of the board's pose.
    """

    capture: str
    plane_mean_m: float
    plane_rms_m: float
    edge_mean_m: float
    edge_rms_m: float
    held_out_m: float
    reprojection_px: float


Motion = Literal["translation_x", "translation_y", "translation_z", "rotation_x", "rotation_y", "rotation_z"]
MOTIONS: tuple[Motion, ...] = get_args(Motion)
"""Motions along and about the camera's axes, in the order of a tangent (6,)."""


State = Literal["unchanged", "changed", "unknown"]
Opinion = Literal["agrees", "contradicts", "unknown"]


@dataclass(frozen=True, eq=False)
class SceneOpinion:
    """The extrinsics of a camera and a LiDAR tested on the scene, without the edges at the board.

    Attributes:
        n_captures: number of compared captures, with an image of the camera's frames and a scan.
        n_edges: number of edges of the scans, in or near their images.
        state: whether the edges agree with the extrinsics or contradict them; unknown if undetermined.
        change: (6,) tangent from the extrinsics to those that fit best; None if there is no clear best.
        cov: (6, 6) of the change, that of the extrinsics included.
    """

    n_captures: Count
    n_edges: Count
    state: Opinion = "unknown"
    change: Values | None = None
    cov: Values | None = None


@dataclass(frozen=True, eq=False)
class Calibration:
    """The extrinsics of one camera and one LiDAR, with all figures needed to judge them.

    Of two LiDARs, `camera` names the first of the profile, which has no channel: T_cam_lidar takes points
    from the second one's frame to the first's, and all axes of the camera are those of the first LiDAR. Of
    two cameras, `lidar` names the second, which has a channel: T_cam_lidar takes points from its optical
    frame to the first one's.

    result.json keeps all of it but the last three attributes, which are empty if it is read back.

    Attributes:
        channels: channels of the camera, names.
        lidar_channel: channel of a second camera; "" for a LiDAR.
        channel_results: time offset and noise of each of these.
        T_cam_lidar: (4, 4), p_cam = R p_lidar + t.
        cov: (6, 6), tangent (translation m, rotation rad), axes of the camera, of extrinsics that are used
            with `intrinsics`, and with point clouds as the LiDAR's driver delivers them, less the profile's
            range offset.
        cov_shared: (6, 6) the part of it that all sessions of one board have in common, as the profile states
            this; zero if unknown.
        contributions: the causes of `cov`, the largest first.
        egt_rotation_deg, egt_translation_m: error from a reference given by the user; None without one.
        verdict: "pass", "marginal" or "fail".
        findings: the reasons for it, worst first, and notes.
        captures_used: names of the captures behind the estimate.
        captures_refused: the reason for refusing each other capture.
        diagnostics: further figures.
        method: method of the estimate, see `CalibrateOptions.method`.
        uncertainty: `cov` as errors of points at several distances; empty without a lens.
        estimated_with: cameras whose extrinsics were estimated together with this one.
        other_cameras: cameras that saw the same boards held still.
        intrinsics: camera intrinsics that belong to the extrinsics, estimated from the profile's and the
            session's images; None for the profile's.
        lidar_intrinsics: intrinsics of the second camera; None for a LiDAR.
        intrinsics_cov: (P, P) of fx, fy, cx, cy and the distortion's coefficients, px.
        intrinsics_cross_cov: (6, P) of the extrinsics, as in `cov`, with these.
        square_m: side of a square, estimated from the profile and the LiDAR.
        board_shape: (15,) deviation of the board's shape from the nominal one, `lens.fit.board_shapes`; None
            if unknown.
        scene: the opinion of the scene's edges; None if they were not compared.
        board_distances_m: 10 % and 90 % of the boards' distances from the camera; empty if unknown.
        residuals: residuals of each capture used.
        observations: capture -> the boards that were paired, as measured, for each capture used.
    """

    _: KW_ONLY
    camera: str
    channels: Annotated[
        tuple[str, ...],
        Field(alias="channel"),
        BeforeValidator(
            lambda names: list(filter(None, names.split("+"))) if isinstance(names, str) else names
        ),
        PlainSerializer("+".join),
    ]
    lidar: str
    T_cam_lidar: Pose
    cov: Covariance
    lidar_channel: str = ""
    n_captures: Count
    n_detected: Count
    captures_used: tuple[str, ...]
    captures_refused: Mapping[str, StoredRefusal]
    metrics: Metrics
    certificate: Certificate
    egt_rotation_deg: Size | None = None
    egt_translation_m: Size | None = None
    verdict: Verdict
    findings: tuple[StoredFinding, ...] = ()
    diagnostics: Annotated[Diagnostics, _WITHOUT_NULL, PlainSerializer(Diagnostics.figures)] = field(
        default_factory=Diagnostics
    )
    channel_results: Annotated[tuple[ChannelResult, ...], Field(alias="channels")] = ()
    method: str = "paper"
    uncertainty: tuple[PointUncertainty, ...] = ()
    estimated_with: tuple[str, ...] = ()
    other_cameras: tuple[OtherCamera, ...] = ()
    cov_shared: Covariance = field(default_factory=lambda: np.zeros((6, 6)))
    contributions: tuple[Contribution, ...] = ()
    intrinsics: Intrinsics | None = None
    lidar_intrinsics: Intrinsics | None = None
    intrinsics_cov: Values | None = None
    intrinsics_cross_cov: Values | None = None
    square_m: Size | None = None
    board_shape: Values | None = None
    scene: SceneOpinion | None = None
    board_distances_m: tuple[Size, ...] = ()
    residuals: Annotated[tuple[CaptureResidual, ...], _ANY, _IN_MEMORY] = ()
    observations: Annotated[Mapping[str, Observation], _ANY, _IN_MEMORY] = field(default_factory=dict)

    @property
    def is_with_board(self) -> bool:
        """Whether captures of a board determined the extrinsics, not a scene alone."""
        return self.method != BY_SCENE

    @property
    def is_of_lidars(self) -> bool:
        """Whether both sensors are LiDARs."""
        return not self.channels

    @property
    def is_of_cameras(self) -> bool:
        """Whether both sensors are cameras."""
        return bool(self.lidar_channel)

    @property
    def is_of_peers(self) -> bool:
        """Whether both sensors are of one kind."""
        return self.is_of_lidars or self.is_of_cameras

    @property
    def is_start_certified(self) -> bool:
        """Whether the certificate belongs to Algorithm 1's solution, the initial guess."""
        return self.method != "paper"

    @property
    def channel(self) -> str:
        """Display names of the channels, joined by "+"."""
        return "+".join(self.channels)

    @property
    def sigma_rotation_deg(self) -> float:
        """Root of the summed rotation variances, deg."""
        return sigma_sizes(self.cov)[0]

    @property
    def sigma_translation_m(self) -> float:
        """Root of the summed translation variances, m."""
        return sigma_sizes(self.cov)[1]


def _from_pair(pair: Any) -> Any:
    """Read a pair of result.json, which stores the metrics beside the other keys."""
    return {**pair, "metrics": pair} if isinstance(pair, dict) else pair


def _as_pair(calibration: Calibration, write: Callable[[Calibration], dict[str, Any]]) -> dict[str, Any]:
    """Write a pair of result.json: the fields, and the derived figures for scripts."""
    pair: dict[str, Any] = {}
    for name, value in write(calibration).items():
        if name == "metrics":
            mpe_m, mee_m = value["mpe_m"], value["mee_m"]
            mge_m = None if None in (mpe_m, mee_m) else calibration.metrics.mge_m
            pair |= {"mpe_m": mpe_m, "mee_m": mee_m, "mge_m": mge_m, **value}
        elif value or not name.startswith("lidar_"):
            pair[name] = dict(sorted(value.items())) if name == "captures_refused" else value
        if name == "cov":
            pair["sigma_rotation_deg"] = calibration.sigma_rotation_deg
            pair["sigma_translation_m"] = calibration.sigma_translation_m
        elif name == "verdict":
            pair["reasons"] = [finding.sentence for finding in calibration.findings]
    return pair


_Time = Annotated[str, Field(pattern="^[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}Z$")] | None


@dataclass(frozen=True)
class Provenance:
    """Origin of a result; unknown fields are empty.

    Attributes:
        robot: the robot's name, from the profile or `--robot`.
        serials: serial numbers by sensor, reported by the devices during the collection, else the profile's.
        date: date of the last capture, UTC, such as "2026-11-20T10:22:03Z": the time of this mounting; None
            without times in the recording.
        session_sha256: fingerprint of captures and profile, see `content_sha256`.
        imported: time at which the last capture entered the session, in the same form; only if `date` is
            None.
    """

    robot: str = ""
    serials: Mapping[str, str] = field(default_factory=dict)
    date: _Time = None
    session_sha256: Annotated[str, Field(pattern="^([0-9a-f]{64})?$")] = ""
    imported: _Time = None

    @property
    def date_words(self) -> str:
        """The date, or "unknown, imported on 2026-11-23" for a recording without times; "" without both."""
        return self.date or (f"unknown, imported on {self.imported[:10]}" if self.imported else "")


@dataclass(frozen=True, eq=False)
class SensorPose:
    """The pose of a sensor on the rig's base sensor.

    Attributes:
        sensor: the sensor's name.
        T_base_sensor: (4, 4) p_base = R p_sensor + t; of a camera, of its optical frame.
        sigma_rotation_deg, sigma_translation_m: roots of the summed variances.
        verdict: the worst of the pairs that the pose is composed of; never "fail".
    """

    sensor: str
    T_base_sensor: Pose
    sigma_rotation_deg: Size
    sigma_translation_m: Size
    verdict: Verdict


@dataclass(frozen=True, eq=False)
class RigPoses:
    """The poses of the sensors of a rig on one of them.

    Attributes:
        base: that sensor, the first LiDAR of the profile with a result.
        sensors: the other sensors, if connected with it by results that have not failed.
    """

    base: str
    sensors: tuple[SensorPose, ...]


@dataclass(frozen=True, eq=False)
class ResultFile:
    """result.json.

    Attributes:
        rig: the rig's name.
        made_by: the program and its version.
        provenance: robot, sensors and date.
        inputs_sha256: SHA-256 of the result's input files, by their path in the session.
        on_base: the pose of each sensor; None for two sensors.
        pairs: one for each camera and LiDAR.
    """

    _: KW_ONLY
    format_version: Literal[1] = 1
    rig: str
    made_by: str = MADE_BY
    provenance: Provenance = field(default_factory=Provenance)
    inputs_sha256: Mapping[str, Annotated[str, Field(pattern="^[0-9a-f]{64}$")]] = field(default_factory=dict)
    on_base: RigPoses | None = None
    pairs: tuple[Annotated[Calibration, BeforeValidator(_from_pair), WrapSerializer(_as_pair)], ...]

    def document(self) -> dict[str, Any]:
        """Return the content as plain types with keys in a fixed order; unknown figures are null.

        Raises:
            ResultRefusedError: a pose or covariance is not finite.
        """
        for pair in self.pairs:
            evidence = (pair, *pair.other_cameras)
            values = [value for record in evidence for value in vars(record).values()]
            if not all(np.isfinite(value).all() for value in values if isinstance(value, np.ndarray)):
                raise ResultRefusedError(
                    f"a pose or covariance of {pair.camera} and {pair.lidar} is not finite",
                    "Add captures: the present ones leave a direction undetermined.",
                )
        document: dict[str, Any] = _file().dump_python(self, mode="json", by_alias=True)
        document["inputs_sha256"] = dict(sorted(document["inputs_sha256"].items()))
        if self.provenance == Provenance():
            del document["provenance"]
        else:
            document["provenance"]["serials"] = dict(sorted(document["provenance"]["serials"].items()))
        if self.on_base is None:
            del document["on_base"]
        return document

    def text(self) -> str:
        """Return the content as text, reproducible byte for byte: floats with all digits, one row per line.

        Raises:
            ResultRefusedError: a pose or covariance is not finite.
        """
        return _layout(self.document(), "") + "\n"


@cache
def _file() -> TypeAdapter[ResultFile]:
    return TypeAdapter(ResultFile)


def _layout(value: Any, indent: str) -> str:
    """Format JSON like json.dumps(indent=2), but lists of plain values on one line."""
    deeper = indent + "  "
    if isinstance(value, dict) and value:
        items = (
            f"{deeper}{json.dumps(key, ensure_ascii=False)}: {_layout(item, deeper)}"
            for key, item in value.items()
        )
        return "{\n" + ",\n".join(items) + f"\n{indent}}}"
    if isinstance(value, list) and any(isinstance(item, list | dict) for item in value):
        return "[\n" + ",\n".join(deeper + _layout(item, deeper) for item in value) + f"\n{indent}]"
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def read_result(path: Path | str) -> ResultFile:
    """Read result.json exactly as written; keys added by later versions are ignored.

    Raises:
        SessionError: no such file, or not a valid result; with the key at fault.
    """
    path = Path(path)
    if not path.exists():
        raise SessionError(f"{path}: there is no such file", "`lce-rig calibrate SESSION` writes it")
    again = "Run `lce-rig calibrate SESSION` again."
    with reading(path, SessionError, again, MAX_BYTES):
        try:
            return _file().validate_json(path.read_bytes())
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            key = ".".join(str(part) for part in first["loc"] if part != "metrics")
            message = first["msg"].removeprefix("Value error, ")
            raise SessionError(f"{path}: {key + ': ' if key else ''}{message}", again) from error
