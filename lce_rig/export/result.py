"""result.json: the result of a calibration for machines; the same result gives the same bytes."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from lce_rig.core.diagnostics import Diagnostics
from lce_rig.core.documents import read_json
from lce_rig.core.errors import ResultRefusedError, SessionError, reading
from lce_rig.core.findings import Figure, Finding, Refusal, Severity
from lce_rig.core.geometry import FARTHEST_M
from lce_rig.core.limits import describe
from lce_rig.core.results import (
    Calibration,
    ChannelResult,
    Contribution,
    OtherCamera,
    PointUncertainty,
    SceneShare,
)
from lce_rig.core.scene_opinion import AxisOpinion, SceneOpinion
from lce_rig.export.files import MADE_BY
from lce_rig.session.durable import write_atomically
from lce_rig.session.provenance import Provenance
from lce_rig.words import as_json, is_renderable, refusal_as_json, sentence

# The schema of result.json; reading is strict.


def _check_pose(rows: list[list[float]]) -> list[list[float]]:
    T = np.array(rows)
    R = T[:3, :3]
    if not np.array_equal(T[3], [0, 0, 0, 1]):
        raise ValueError("the last row is not 0 0 0 1")
    if np.abs(R).max() > 2 or not (np.abs(R @ R.T - np.eye(3)).max() < 1e-6 and np.linalg.det(R) > 0):
        raise ValueError("not a rotation")
    if np.abs(T[:3, 3]).max() > FARTHEST_M:
        raise ValueError(f"a translation beyond {FARTHEST_M:g} m")
    return rows


def _check_cov(rows: list[list[float]]) -> list[list[float]]:
    cov = np.array(rows)
    if not np.allclose(cov, cov.T, rtol=1e-6, atol=1e-18):
        raise ValueError("not symmetric")
    if np.diag(cov).min() < 0:
        raise ValueError("a variance is negative")
    return rows


# Products of such figures stay far from overflow; an undetermined direction has a variance above 1e6.
_Figure = Annotated[float, Field(ge=-1e100, le=1e100)]
_Row4 = Annotated[list[_Figure], Field(min_length=4, max_length=4)]
_Row6 = Annotated[list[_Figure], Field(min_length=6, max_length=6)]
_Pose = Annotated[list[_Row4], Field(min_length=4, max_length=4), AfterValidator(_check_pose)]
_Cov = Annotated[list[_Row6], Field(min_length=6, max_length=6), AfterValidator(_check_cov)]
_NotNegative = Annotated[float, Field(ge=0, le=1e100)]
_Text = Annotated[str, Field(max_length=1000)]
_Count = Annotated[int, Field(ge=0, le=10**9)]


class _SavedRecord(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)


def _check_figures(figures: dict[str, Any]) -> dict[str, Figure]:
    return {name: _read_figure(value) for name, value in figures.items()}


def _read_figure(value: Any) -> Figure:
    if isinstance(value, dict):
        raise ValueError("a figure is not a mapping")
    return tuple(_read_figure(each) for each in value) if isinstance(value, list) else value


_Figures = Annotated[dict[str, Any], AfterValidator(_check_figures)]


class RefusalRecord(_SavedRecord):
    """The reason for refusing a capture; files of earlier versions hold stage, cause and action only."""

    stage: Literal["read", "image", "lidar", "pair", "calibrate"]
    cause: str
    action: str
    code: str = ""
    figures: _Figures = Field(default_factory=dict)
    action_code: str = ""

    @property
    def refusal(self) -> Refusal:
        """The refusal; as plain text if this version does not know its code."""
        if self.code.startswith(f"{self.stage}."):
            known = Refusal(self.code, figures=self.figures, action=self.action_code)
            if is_renderable(known):
                return known
        return Refusal(f"{self.stage}.text", figures={"text": self.cause, "advice": self.action})


class FindingRecord(_SavedRecord):
    """One reason of a verdict, or a note."""

    code: str
    severity: Literal["note", "warning", "error"]
    subject: str
    figures: _Figures
    action_code: str
    text: str
    action: str

    @property
    def finding(self) -> Finding:
        """The finding; as plain text if this version does not know its code."""
        known = Finding(self.code, self.severity, self.subject, self.figures, self.action_code)
        if is_renderable(known):
            return known
        return Finding("verdict.text", self.severity, figures={"text": self.text, "advice": self.action})


class CertificateRecord(_SavedRecord):
    """Proof of optimality; gap is null if there is no bound."""

    is_optimal: bool
    gap: float | None


class ChannelRecord(_SavedRecord):
    """The result of one channel alone; time offsets are null if nothing moved."""

    channel: str
    n_captures: _Count
    noise_px: _NotNegative
    T_cam_lidar: _Pose
    cov: _Cov
    depth_scatter_m: _NotNegative
    depth_scatter_still_m: _NotNegative
    time_offset_s: float | None = None
    time_offset_sigma_s: _NotNegative | None = None


class UncertaintyRecord(_SavedRecord):
    """The covariance as the error of a point at a distance, in the image's centre and worst corner."""

    distance_m: Annotated[float, Field(gt=0)]
    centre_px: _NotNegative
    centre_m: _NotNegative
    corner_px: _NotNegative
    corner_m: _NotNegative


class OtherCameraRecord(_SavedRecord):
    """The pose of a camera relative to another one; cov is null if they were not estimated together."""

    camera: str
    n_captures: _Count
    T_cam_other: _Pose
    cov: _Cov | None
    T_cam_other_pictures: _Pose | None
    apart_rotation_deg: _NotNegative | None
    apart_translation_m: _NotNegative | None
    board_rms_m: _NotNegative


class ContributionRecord(_SavedRecord):
    """One cause of the standard deviations; the squares of all add up."""

    source: str
    sigma_rotation_deg: _NotNegative | None
    sigma_translation_m: _NotNegative | None


class SceneShareRecord(_SavedRecord):
    """The boards' own extrinsics, and what the scene did to them."""

    state: Literal["used", "contradicts", "unknown"]
    n_captures: _Count
    n_edges: _Count
    T_cam_lidar: _Pose
    cov: _Cov
    T_cam_lidar_boards: _Pose
    cov_boards: _Cov
    change: _Row6
    change_sigma: _Row6
    surprise: _NotNegative
    n_directions: _Count


class AxisRecord(_SavedRecord):
    """The scene's opinion on one axis; figures in its unit."""

    axis: str
    state: Literal["agrees", "contradicts", "unknown"]
    unit: Literal["deg", "m"]
    change: _Figure
    sigma: _NotNegative
    smallest: _NotNegative | None


class SceneRecord(_SavedRecord):
    """The scene's opinion; no axes if there is too little to compare."""

    state: Literal["agrees", "contradicts", "unknown"]
    n_captures: _Count
    n_edges: _Count
    axes: list[AxisRecord]

    @property
    def opinion(self) -> SceneOpinion:
        """The opinion, whose state follows from its axes."""
        axes = tuple(AxisOpinion(**axis.model_dump()) for axis in self.axes)
        return SceneOpinion(self.n_captures, self.n_edges, axes)


class PairRecord(_SavedRecord):
    """One camera and one LiDAR; figures that could not be computed are null."""

    camera: str
    channel: str
    lidar: str
    T_cam_lidar: _Pose
    cov: _Cov
    sigma_rotation_deg: _NotNegative
    sigma_translation_m: _NotNegative
    n_captures: _Count
    n_detected: _Count
    captures_used: list[str]
    captures_refused: dict[str, RefusalRecord]
    mpe_m: _NotNegative | None
    mee_m: _NotNegative | None
    mge_m: _NotNegative | None
    reprojection_px: _NotNegative | None
    certificate: CertificateRecord
    egt_rotation_deg: _NotNegative | None
    egt_translation_m: _NotNegative | None
    verdict: Literal["pass", "marginal", "fail"]
    reasons: list[str]
    findings: list[FindingRecord] = Field(default_factory=list)
    diagnostics: dict[str, float | None] = Field(default_factory=dict)
    channels: list[ChannelRecord] = Field(default_factory=list)
    method: str = "paper"
    uncertainty: list[UncertaintyRecord] = Field(default_factory=list)
    estimated_with: list[str] = Field(default_factory=list)
    other_cameras: list[OtherCameraRecord] = Field(default_factory=list)
    cov_shared: _Cov = Field(default_factory=lambda: np.zeros((6, 6)).tolist())
    contributions: list[ContributionRecord] = Field(default_factory=list)
    scene_share: SceneShareRecord | None = None
    scene: SceneRecord | None = None

    @model_validator(mode="after")
    def _is_consistent(self) -> "PairRecord":
        variances = np.diag(np.array(self.cov))
        sigma_t, sigma_r = np.sqrt(variances[:3].sum()), np.degrees(np.sqrt(variances[3:].sum()))
        for name, value, wanted in (
            ("sigma_translation_m", self.sigma_translation_m, sigma_t),
            ("sigma_rotation_deg", self.sigma_rotation_deg, sigma_r),
        ):
            if not np.isclose(value, wanted, rtol=1e-6):
                raise ValueError(f"{name}: {value:g} contradicts cov, which gives {wanted:g}")
        if self.n_detected > self.n_captures:
            raise ValueError(f"n_detected: {self.n_detected} of {self.n_captures} captures")
        return self


class ProvenanceRecord(_SavedRecord):
    """Where the result comes from; absent in files of earlier versions."""

    robot: _Text = ""
    serials: dict[str, _Text] = Field(default_factory=dict)
    date: Annotated[str, Field(pattern=r"^([0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}Z)?$")] = ""
    session_sha256: Annotated[str, Field(pattern="^([0-9a-f]{64})?$")] = ""


class ResultRecord(_SavedRecord):
    """The whole file."""

    format_version: Literal[1]
    rig: str
    made_by: str
    provenance: ProvenanceRecord = ProvenanceRecord()
    inputs_sha256: dict[str, Annotated[str, Field(pattern="^[0-9a-f]{64}$")]] = Field(default_factory=dict)
    sessions: dict[str, str] = Field(default_factory=dict)
    pairs: list[PairRecord]

    @model_validator(mode="after")
    def _pairs_are_unique(self) -> "ResultRecord":
        names = [(pair.camera, pair.channel, pair.lidar) for pair in self.pairs]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"pairs: {name[0]}/{name[1]} and {name[2]} are given twice")
        return self


FORMAT_VERSION = 1


@dataclass(frozen=True)
class SavedResult:
    """A result file's content.

    Attributes:
        rig: its name.
        made_by: the program and its version.
        pairs: one for each camera and LiDAR.
        inputs_sha256: SHA-256 of the result's input files, by their path in the session.
        sessions: of an estimate from several, by name: their paths from the one that holds the result.
        provenance: robot, sensors and date; empty in files of earlier versions.
    """

    rig: str
    made_by: str
    pairs: tuple[Calibration, ...]
    inputs_sha256: Mapping[str, str]
    sessions: Mapping[str, str] = field(default_factory=dict)
    provenance: Provenance = field(default_factory=Provenance)


def to_json_dict(
    rig_name: str,
    calibrations: Sequence[Calibration],
    inputs_sha256: Mapping[str, str] | None = None,
    sessions: Mapping[str, str] | None = None,
    provenance: Provenance | None = None,
) -> dict[str, Any]:
    """Build the content of result.json from plain types, keys in a fixed order.

    Figures that could not be computed are null.

    Args:
        rig_name: of the profile.
        calibrations: one for each camera and LiDAR.
        inputs_sha256: SHA-256 of the result's input files, by their path in the session.
        sessions: of an estimate from several, as in `SavedResult`; one session is not named.
        provenance: robot, sensors and date; None leaves them out.

    Raises:
        ResultRefusedError: a pose or covariance is not finite.
    """
    pairs = [_pair(calibration) for calibration in calibrations]
    return {
        "format_version": FORMAT_VERSION,
        "rig": rig_name,
        "made_by": MADE_BY,
        **({"provenance": _provenance(provenance)} if provenance else {}),
        "inputs_sha256": dict(sorted((inputs_sha256 or {}).items())),
        **({"sessions": dict(sessions)} if sessions else {}),
        "pairs": pairs,
    }


def _provenance(provenance: Provenance) -> dict[str, Any]:
    return {**vars(provenance), "serials": dict(sorted(provenance.serials.items()))}


def _pair(calibration: Calibration) -> dict[str, Any]:
    """List what `PairRecord` holds, in its order."""
    pair = f"{calibration.camera}/{calibration.channel} and {calibration.lidar}"
    calculated = {
        **vars(calibration.metrics),
        "mge_m": calibration.metrics.mge_m,
        "channels": calibration.channel_results,
    }
    written = {
        "captures_refused": {
            name: refusal_as_json(refusal) for name, refusal in sorted(calibration.captures_refused.items())
        },
        "findings": [as_json(finding) for finding in calibration.findings],
        "reasons": [sentence(finding) for finding in calibration.findings],
        "diagnostics": calibration.diagnostics.figures(),
        "scene": None if calibration.scene is None else calibration.scene.document(),
    }
    return {
        name: written[name]
        if name in written
        else _plain(calculated[name] if name in calculated else getattr(calibration, name), name, pair)
        for name in PairRecord.model_fields
    }


def _plain(value: Any, name: str, pair: str) -> Any:
    """Convert a value to plain types: records and mappings to dicts, arrays to rows, NaN to null."""
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, Mapping):
        return {key: _plain(each, f"{name}.{key}", pair) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each, f"{name}[{k}]", pair) for k, each in enumerate(value)]
    if isinstance(value, np.ndarray):
        if not np.isfinite(value).all():
            what = f"{name} of {pair} is not finite"
            raise ResultRefusedError(what, "Add captures: they leave a direction undetermined.")
        return (value.astype(np.float64) + 0.0).tolist()
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not np.isfinite(value) else value


def result_text(
    rig_name: str, calibrations: Sequence[Calibration], inputs_sha256: Mapping[str, str] | None = None
) -> str:
    """Write the content of result.json: deterministic, floats with all digits, one matrix row per line."""
    return layout(to_json_dict(rig_name, calibrations, inputs_sha256))


def layout(document: Mapping[str, Any]) -> str:
    """Format the content of result.json as text."""
    return _layout(document, "") + "\n"


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


def write_result(
    path: Path,
    rig_name: str,
    calibrations: Sequence[Calibration],
    inputs_sha256: Mapping[str, str] | None = None,
) -> None:
    """Write result.json in one step.

    Raises:
        ResultRefusedError: a pose or covariance is not finite.
        SessionError: the file cannot be written.
    """
    write_atomically(path, result_text(rig_name, calibrations, inputs_sha256))


def read_result(path: Path | str) -> SavedResult:
    """Read result.json back, exactly as it was written; keys that later versions may add are ignored.

    Raises:
        SessionError: no such file, or not a valid result; with the key at fault.
    """
    path = Path(path)
    if not path.exists():
        raise SessionError(f"{path}: there is no such file", "`lce-rig calibrate SESSION` writes it")
    with reading(path, SessionError, "run `lce-rig calibrate SESSION` again"):
        data = read_json(path)
    version = data.get("format_version") if isinstance(data, dict) else None
    if version != FORMAT_VERSION or isinstance(version, bool):
        raise SessionError(
            f"{path}: format_version is {describe(version)}, but this lce-rig reads {FORMAT_VERSION}",
            "Run `lce-rig calibrate SESSION` again.",
        )
    try:
        record = ResultRecord.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        what = (
            f"{path}: {describe(key)[1:-1] + ': ' if key else ''}{first['msg'].removeprefix('Value error, ')}"
        )
        raise SessionError(what, "Run `lce-rig calibrate SESSION` again.") from error
    calibrations = tuple(_calibration(pair) for pair in record.pairs)
    return SavedResult(
        record.rig,
        record.made_by,
        calibrations,
        record.inputs_sha256,
        record.sessions,
        Provenance(**record.provenance.model_dump()),
    )


def _calibration(pair: PairRecord) -> Calibration:
    from lce_rig.core.results import Certificate, Metrics

    def figure(value: float | None) -> float:
        return np.nan if value is None else value

    return Calibration(
        camera=pair.camera,
        channels=tuple(record.channel for record in pair.channels) or tuple(pair.channel.split("+")),
        lidar=pair.lidar,
        T_cam_lidar=np.array(pair.T_cam_lidar, dtype=np.float64),
        cov=np.array(pair.cov, dtype=np.float64),
        certificate=Certificate(
            pair.certificate.is_optimal, np.inf if pair.certificate.gap is None else pair.certificate.gap
        ),
        metrics=Metrics(figure(pair.mpe_m), figure(pair.mee_m), figure(pair.reprojection_px)),
        n_captures=pair.n_captures,
        n_detected=pair.n_detected,
        captures_used=tuple(pair.captures_used),
        captures_refused={name: record.refusal for name, record in pair.captures_refused.items()},
        verdict=pair.verdict,
        findings=_findings(pair),
        egt_rotation_deg=pair.egt_rotation_deg,
        egt_translation_m=pair.egt_translation_m,
        diagnostics=Diagnostics.of(pair.diagnostics),
        channel_results=tuple(_channel_result(record) for record in pair.channels),
        method=pair.method,
        uncertainty=tuple(PointUncertainty(**each.model_dump()) for each in pair.uncertainty),
        estimated_with=tuple(pair.estimated_with),
        other_cameras=tuple(_other(record) for record in pair.other_cameras),
        cov_shared=np.array(pair.cov_shared, dtype=np.float64),
        contributions=tuple(
            Contribution(each.source, figure(each.sigma_rotation_deg), figure(each.sigma_translation_m))
            for each in pair.contributions
        ),
        scene_share=None if pair.scene_share is None else _share(pair.scene_share),
        scene=None if pair.scene is None else pair.scene.opinion,
    )


def _findings(pair: PairRecord) -> tuple[Finding, ...]:
    """Read the findings; files of earlier versions hold their sentences only."""
    if pair.findings:
        return tuple(record.finding for record in pair.findings)
    severity: Severity = "error" if pair.verdict == "fail" else "warning"
    return tuple(
        Finding("verdict.text", severity, figures={"text": reason, "advice": ""}) for reason in pair.reasons
    )


def _channel_result(record: ChannelRecord) -> ChannelResult:
    figures = record.model_dump()
    figures |= {name: np.array(figures[name], dtype=np.float64) for name in ("T_cam_lidar", "cov")}
    return ChannelResult(**figures)


def _other(record: OtherCameraRecord) -> OtherCamera:
    figures = record.model_dump()
    for name in ("T_cam_other", "cov", "T_cam_other_pictures"):
        figures[name] = None if figures[name] is None else np.array(figures[name], dtype=np.float64)
    return OtherCamera(**figures)


def _share(record: SceneShareRecord) -> SceneShare:
    figures = record.model_dump()
    for name, value in figures.items():
        figures[name] = np.array(value, dtype=np.float64) if isinstance(value, list) else value
    return SceneShare(**figures)
