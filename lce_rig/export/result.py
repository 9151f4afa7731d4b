"""result.json: the result of a calibration for machines; the same result gives the same bytes."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from lce_rig.core.documents import read_json
from lce_rig.core.errors import ResultRefusedError, SessionError
from lce_rig.core.geometry import Array
from lce_rig.core.limits import describe
from lce_rig.core.results import Calibration, ChannelResult, OtherCamera, PointUncertainty
from lce_rig.export.result_schema import ChannelRecord, OtherCameraRecord, PairRecord, ResultRecord
from lce_rig.export.writing import MADE_BY, write_atomically
from lce_rig.words import as_json, refusal_as_json

FORMAT_VERSION = 1


@dataclass(frozen=True)
class SavedResult:
    """A result file's content.

    Attributes:
        rig: its name.
        made_by: the program and its version.
        pairs: one for each camera and LiDAR.
        inputs_sha256: SHA-256 of the session's files that the result was made from, by their path in it.
    """

    rig: str
    made_by: str
    pairs: tuple[Calibration, ...]
    inputs_sha256: Mapping[str, str]


def to_json_dict(
    rig_name: str, calibrations: Sequence[Calibration], inputs_sha256: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Build the content of result.json from plain types, keys in a fixed order.

    Figures that could not be computed are null.

    Args:
        rig_name: of the profile.
        calibrations: one for each camera and LiDAR.
        inputs_sha256: SHA-256 of the session's files behind the result, by their path in it.

    Raises:
        ResultRefusedError: a pose or covariance is not finite.
    """
    pairs = [_pair(calibration) for calibration in calibrations]
    return {
        "format_version": FORMAT_VERSION,
        "rig": rig_name,
        "made_by": MADE_BY,
        "inputs_sha256": dict(sorted((inputs_sha256 or {}).items())),
        "pairs": pairs,
    }


def _pair(calibration: Calibration) -> dict[str, Any]:
    metrics, certificate = calibration.metrics, calibration.certificate
    refused = {
        name: refusal_as_json(refusal) for name, refusal in sorted(calibration.captures_refused.items())
    }
    return {
        "camera": calibration.camera,
        "channel": calibration.channel,
        "lidar": calibration.lidar,
        "T_cam_lidar": _matrix(calibration.T_cam_lidar, "T_cam_lidar", calibration),
        "cov": _matrix(calibration.cov, "cov", calibration),
        "sigma_rotation_deg": calibration.sigma_rotation_deg,
        "sigma_translation_m": calibration.sigma_translation_m,
        "n_captures": int(calibration.n_captures),
        "n_detected": int(calibration.n_detected),
        "captures_used": list(calibration.captures_used),
        "captures_refused": refused,
        "mpe_m": _figure(metrics.mpe_m),
        "mee_m": _figure(metrics.mee_m),
        "mge_m": _figure(metrics.mge_m),
        "reprojection_px": _figure(metrics.reprojection_px),
        "certificate": {"is_optimal": bool(certificate.is_optimal), "gap": _figure(certificate.gap)},
        "egt_rotation_deg": _figure(calibration.egt_rotation_deg),
        "egt_translation_m": _figure(calibration.egt_translation_m),
        "verdict": calibration.verdict,
        "reasons": list(calibration.reasons),
        "findings": [as_json(finding) for finding in calibration.findings],
        "diagnostics": {name: _figure(value) for name, value in sorted(calibration.diagnostics.items())},
        "channels": [_channel(result, calibration) for result in calibration.channel_results],
        "method": calibration.method,
        "uncertainty": [asdict(each) for each in calibration.uncertainty],
        "estimated_with": list(calibration.estimated_with),
        "other_cameras": [_other_camera(other, calibration) for other in calibration.other_cameras],
    }


def _channel(result: ChannelResult, calibration: Calibration) -> dict[str, Any]:
    return {
        "channel": result.channel,
        "n_captures": int(result.n_captures),
        "noise_px": float(result.noise_px),
        "T_cam_lidar": _matrix(result.T_cam_lidar, f"T_cam_lidar of {result.channel}", calibration),
        "cov": _matrix(result.cov, f"cov of {result.channel}", calibration),
        "depth_scatter_m": float(result.depth_scatter_m),
        "depth_scatter_still_m": float(result.depth_scatter_still_m),
        "time_offset_s": _figure(result.time_offset_s),
        "time_offset_sigma_s": _figure(result.time_offset_sigma_s),
    }


def _other_camera(other: OtherCamera, calibration: Calibration) -> dict[str, Any]:
    def matrix(value: Array | None, name: str) -> list[list[float]] | None:
        return None if value is None else _matrix(value, f"{name} to {other.camera}", calibration)

    return {
        "camera": other.camera,
        "n_captures": int(other.n_captures),
        "T_cam_other": matrix(other.T_cam_other, "T_cam_other"),
        "cov": matrix(other.cov, "cov"),
        "T_cam_other_pictures": matrix(other.T_cam_other_pictures, "T_cam_other_pictures"),
        "apart_rotation_deg": _figure(other.apart_rotation_deg),
        "apart_translation_m": _figure(other.apart_translation_m),
        "board_rms_m": float(other.board_rms_m),
    }


def _matrix(matrix: Array, name: str, calibration: Calibration) -> list[list[float]]:
    if not np.isfinite(matrix).all():
        pair = f"{calibration.camera}/{calibration.channel} and {calibration.lidar}"
        raise ResultRefusedError(
            f"{name} of {pair} is not finite", "the captures leave a direction undetermined: add captures"
        )
    return [[float(value) for value in row] for row in np.asarray(matrix) + 0.0]


def _figure(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)


def result_text(
    rig_name: str, calibrations: Sequence[Calibration], inputs_sha256: Mapping[str, str] | None = None
) -> str:
    """Write the content of result.json: deterministic, floats to the last digit, a matrix row a line."""
    return layout(to_json_dict(rig_name, calibrations, inputs_sha256))


def layout(document: Mapping[str, Any]) -> str:
    """Lay the content of result.json out as its text."""
    return _layout(document, "") + "\n"


def _layout(value: Any, indent: str) -> str:
    """Lay JSON out as json.dumps(indent=2) does, but lists of plain values on one line."""
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
    """Write result.json, whole or not at all.

    Raises:
        ResultRefusedError: a pose or covariance is not finite.
        SessionError: the file cannot be written.
    """
    write_atomically(path, result_text(rig_name, calibrations, inputs_sha256))


def read_result(path: Path | str) -> SavedResult:
    """Read result.json back, exactly as it was written; keys that later versions may add are ignored.

    Raises:
        SessionError: no such file, or not a result that can be trusted; with the key at fault.
    """
    path = Path(path)
    try:
        data = read_json(path)
    except FileNotFoundError as error:
        raise SessionError(
            f"{path}: there is no such file", "`lce-rig calibrate SESSION` writes it"
        ) from error
    except OSError as error:
        raise SessionError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise SessionError(f"{path}: {error}", "run `lce-rig calibrate SESSION` again") from error
    version = data.get("format_version") if isinstance(data, dict) else None
    if version != FORMAT_VERSION or isinstance(version, bool):
        raise SessionError(
            f"{path}: format_version is {describe(version)}, this lce-rig reads {FORMAT_VERSION}",
            "run `lce-rig calibrate SESSION` again",
        )
    try:
        record = ResultRecord.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        what = (
            f"{path}: {describe(key)[1:-1] + ': ' if key else ''}{first['msg'].removeprefix('Value error, ')}"
        )
        raise SessionError(what, "run `lce-rig calibrate SESSION` again") from error
    calibrations = tuple(_calibration(pair) for pair in record.pairs)
    return SavedResult(record.rig, record.made_by, calibrations, record.inputs_sha256)


def _calibration(pair: PairRecord) -> Calibration:
    from lce_rig.core.results import Certificate, Metrics

    def figure(value: float | None) -> float:
        return np.nan if value is None else value

    return Calibration(
        camera=pair.camera,
        channel=pair.channel,
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
        reasons=tuple(pair.reasons),
        findings=tuple(record.finding for record in pair.findings),
        egt_rotation_deg=pair.egt_rotation_deg,
        egt_translation_m=pair.egt_translation_m,
        diagnostics={name: figure(value) for name, value in pair.diagnostics.items()},
        channel_results=tuple(_channel_result(record) for record in pair.channels),
        method=pair.method,
        uncertainty=tuple(PointUncertainty(**each.model_dump()) for each in pair.uncertainty),
        estimated_with=tuple(pair.estimated_with),
        other_cameras=tuple(_other(record) for record in pair.other_cameras),
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
