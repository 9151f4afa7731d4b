"""The schema of result.json, strict where it is read."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from lce_rig.core.findings import Figure, Finding
from lce_rig.core.geometry import FARTHEST_M
from lce_rig.core.results import Refusal
from lce_rig.words import is_renderable


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


# Products of such figures stay far from overflow; a direction that is open has a variance beyond a million.
_Figure = Annotated[float, Field(ge=-1e100, le=1e100)]
_Row4 = Annotated[list[_Figure], Field(min_length=4, max_length=4)]
_Row6 = Annotated[list[_Figure], Field(min_length=6, max_length=6)]
_Pose = Annotated[list[_Row4], Field(min_length=4, max_length=4), AfterValidator(_check_pose)]
_Cov = Annotated[list[_Row6], Field(min_length=6, max_length=6), AfterValidator(_check_cov)]
_NotNegative = Annotated[float, Field(ge=0, le=1e100)]
_Count = Annotated[int, Field(ge=0, le=10**9)]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)


def _check_figures(figures: dict[str, Any]) -> dict[str, Figure]:
    return {name: _figure(value) for name, value in figures.items()}


def _figure(value: Any) -> Figure:
    if isinstance(value, dict):
        raise ValueError("a figure is no mapping")
    return tuple(_figure(each) for each in value) if isinstance(value, list) else value


_Figures = Annotated[dict[str, Any], AfterValidator(_check_figures)]


class RefusalRecord(_Record):
    """The reason for refusing a capture; files of earlier versions hold stage, cause and action only."""

    stage: Literal["read", "image", "lidar", "pair", "calibrate"]
    cause: str
    action: str
    code: str = ""
    figures: _Figures = Field(default_factory=dict)
    action_code: str = ""

    @property
    def refusal(self) -> Refusal:
        """The refusal; as plain text where this version has no words for its code."""
        if self.code.startswith(f"{self.stage}."):
            known = Refusal(self.code, figures=self.figures, action=self.action_code)
            if is_renderable(known):
                return known
        return Refusal(f"{self.stage}.text", figures={"text": self.cause, "advice": self.action})


class FindingRecord(_Record):
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
        """The finding; as plain text where this version has no words for its code."""
        known = Finding(self.code, self.severity, self.subject, self.figures, self.action_code)
        if is_renderable(known):
            return known
        return Finding("verdict.text", self.severity, figures={"text": self.text})


class CertificateRecord(_Record):
    """Proof of optimality; gap is null where there is no bound."""

    is_optimal: bool
    gap: float | None


class ChannelRecord(_Record):
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


class UncertaintyRecord(_Record):
    """The covariance as the error of a point at a distance, in the image's centre and worst corner."""

    distance_m: Annotated[float, Field(gt=0)]
    centre_px: _NotNegative
    centre_m: _NotNegative
    corner_px: _NotNegative
    corner_m: _NotNegative


class OtherCameraRecord(_Record):
    """The pose of a camera relative to another one; cov is null if they were not estimated together."""

    camera: str
    n_captures: _Count
    T_cam_other: _Pose
    cov: _Cov | None
    T_cam_other_pictures: _Pose | None
    apart_rotation_deg: _NotNegative | None
    apart_translation_m: _NotNegative | None
    board_rms_m: _NotNegative


class PairRecord(_Record):
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

    @model_validator(mode="after")
    def _is_consistent(self) -> "PairRecord":
        variances = np.diag(np.array(self.cov))
        sigma_t, sigma_r = np.sqrt(variances[:3].sum()), np.degrees(np.sqrt(variances[3:].sum()))
        for name, value, wanted in (
            ("sigma_translation_m", self.sigma_translation_m, sigma_t),
            ("sigma_rotation_deg", self.sigma_rotation_deg, sigma_r),
        ):
            if not np.isclose(value, wanted, rtol=1e-6):
                raise ValueError(f"{name}: {value:g} does not belong to cov, which gives {wanted:g}")
        if self.n_detected > self.n_captures:
            raise ValueError(f"n_detected: {self.n_detected} of {self.n_captures} captures")
        return self


class ResultRecord(_Record):
    """The whole file."""

    format_version: Literal[1]
    rig: str
    made_by: str
    inputs_sha256: dict[str, Annotated[str, Field(pattern="^[0-9a-f]{64}$")]] = Field(default_factory=dict)
    pairs: list[PairRecord]

    @model_validator(mode="after")
    def _pairs_are_unique(self) -> "ResultRecord":
        names = [(pair.camera, pair.channel, pair.lidar) for pair in self.pairs]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"pairs: {name[0]}/{name[1]} and {name[2]} are given twice")
        return self
