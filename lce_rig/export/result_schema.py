"""The schema of result.json, strict where it is read."""

from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

_Row4 = Annotated[list[float], Field(min_length=4, max_length=4)]
_Row6 = Annotated[list[float], Field(min_length=6, max_length=6)]
_NotNegative = Annotated[float, Field(ge=0)]
_Count = Annotated[int, Field(ge=0)]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)


class RefusalRecord(_Record):
    """Why a capture is not used."""

    stage: Literal["read", "image", "lidar", "pair", "calibrate"]
    cause: str
    action: str


class CertificateRecord(_Record):
    """Proof of optimality; gap is null where there is no bound."""

    is_optimal: bool
    gap: float | None


class ChannelRecord(_Record):
    """What one channel says alone; time offsets are null where nothing moved."""

    channel: str
    n_captures: _Count
    noise_px: _NotNegative
    T_cam_lidar: Annotated[list[_Row4], Field(min_length=4, max_length=4)]
    cov: Annotated[list[_Row6], Field(min_length=6, max_length=6)]
    depth_scatter_m: _NotNegative
    depth_scatter_still_m: _NotNegative
    time_offset_s: float | None = None
    time_offset_sigma_s: _NotNegative | None = None


class UncertaintyRecord(_Record):
    """What the covariance means for a point at a distance, in the picture's centre and worst corner."""

    distance_m: Annotated[float, Field(gt=0)]
    centre_px: _NotNegative
    centre_m: _NotNegative
    corner_px: _NotNegative
    corner_m: _NotNegative


class OtherCameraRecord(_Record):
    """Where a camera sits to another one; cov is null where they were not estimated together."""

    camera: str
    n_captures: _Count
    T_cam_other: Annotated[list[_Row4], Field(min_length=4, max_length=4)]
    cov: Annotated[list[_Row6], Field(min_length=6, max_length=6)] | None
    T_cam_other_pictures: Annotated[list[_Row4], Field(min_length=4, max_length=4)] | None
    apart_rotation_deg: _NotNegative | None
    apart_translation_m: _NotNegative | None
    board_rms_m: _NotNegative


class PairRecord(_Record):
    """One camera and one LiDAR; figures that could not be computed are null."""

    camera: str
    channel: str
    lidar: str
    T_cam_lidar: Annotated[list[_Row4], Field(min_length=4, max_length=4)]
    cov: Annotated[list[_Row6], Field(min_length=6, max_length=6)]
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
    diagnostics: dict[str, float | None] = Field(default_factory=dict)
    channels: list[ChannelRecord] = Field(default_factory=list)
    method: str = "paper"
    uncertainty: list[UncertaintyRecord] = Field(default_factory=list)
    estimated_with: list[str] = Field(default_factory=list)
    other_cameras: list[OtherCameraRecord] = Field(default_factory=list)

    @model_validator(mode="after")
    def _is_consistent(self) -> "PairRecord":
        T, cov = np.array(self.T_cam_lidar), np.array(self.cov)
        R = T[:3, :3]
        if not np.array_equal(T[3], [0, 0, 0, 1]):
            raise ValueError("T_cam_lidar: the last row is not 0 0 0 1")
        if not (np.abs(R @ R.T - np.eye(3)).max() < 1e-6 and np.linalg.det(R) > 0):
            raise ValueError("T_cam_lidar: not a rotation")
        if not np.allclose(cov, cov.T, rtol=1e-6, atol=1e-18):
            raise ValueError("cov: not symmetric")
        variances = np.diag(cov)
        if variances.min() < 0:
            raise ValueError("cov: a variance is negative")
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
