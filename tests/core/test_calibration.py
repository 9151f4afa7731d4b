"""result.json: exact, deterministic, and refused where it cannot be trusted."""

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lce_rig.core.calibration import (
    Certificate,
    ChannelResult,
    Contribution,
    Metrics,
    OtherCamera,
    PointUncertainty,
    Provenance,
    SceneOpinion,
    read_result,
)
from lce_rig.core.errors import ResultRefusedError, SessionError
from lce_rig.core.geometry import exp_so3, pose
from tests.damage import damaged
from tests.export.conftest import calibration, reason
from tests.saved_results import result_file

REASON = "the board was bent: use another"
FIELDS = [
    *("camera", "channel", "lidar", "T_cam_lidar", "cov", "sigma_rotation_deg", "sigma_translation_m"),
    *("n_captures", "n_detected", "captures_used", "captures_refused", "mpe_m", "mee_m", "mge_m"),
    *("reprojection_px", "certificate", "egt_rotation_deg", "egt_translation_m", "verdict", "reasons"),
    *("findings", "diagnostics", "channels", "method", "uncertainty", "estimated_with", "other_cameras"),
    *("cov_shared", "contributions", "intrinsics", "intrinsics_cov", "intrinsics_cross_cov", "square_m"),
    "board_shape",
    *("scene", "board_distances_m"),
]
REQUIRED = [
    *("camera", "channel", "lidar", "T_cam_lidar", "cov", "n_captures", "n_detected", "captures_used"),
    *("captures_refused", "mpe_m", "mee_m", "reprojection_px", "certificate", "verdict"),
]
Edit = Callable[[dict[str, Any]], Any]


def full():
    """Fill every field that the file keeps."""
    T, cov = calibration().T_cam_lidar, calibration().cov
    return calibration(
        channels=("events", "frames"),
        method="ml",
        channel_results=(
            ChannelResult("events", 3, 0.2, -0.003, 0.001),
            ChannelResult("frames", 2, 0.1),
        ),
        egt_rotation_deg=0.5,
        egt_translation_m=0.01,
        uncertainty=(PointUncertainty(5.0, 1.25, 0.0125, 1.5, 0.015),),
        estimated_with=("right",),
        other_cameras=(
            OtherCamera("right", 2, T, cov, 0.1, 0.001, 0.002),
            OtherCamera("left", 2, T, None, None, None, 0.002),
        ),
        cov_shared=0.1 * cov,
        contributions=(Contribution("captures", 0.1, 0.01), Contribution("lidar_ranges", np.nan, 0.01)),
        scene=SceneOpinion(2, 70, "agrees", np.full(6, 0.01), cov),
        board_distances_m=(1.5, 3.25),
    )


def as_text(*calibrations):
    return result_file("rles", calibrations).text()


def edited(path, edit):
    """Write a result after a change to its document."""
    document = result_file("rles", [full()]).document()
    edit(document)
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


def test_result_json_has_published_keys_in_order():
    document = result_file("rles", [full()]).document()
    assert list(document) == ["format_version", "rig", "made_by", "inputs_sha256", "pairs"]
    assert (document["format_version"], document["rig"]) == (1, "rles")
    pair = document["pairs"][0]
    assert list(pair) == FIELDS
    assert pair["channel"] == "events+frames" == "+".join(c["channel"] for c in pair["channels"])
    assert pair["mge_m"] == pair["mpe_m"] + pair["mee_m"]
    assert pair["reasons"] == [finding.sentence for finding in full().findings]
    refused = pair["captures_refused"]
    assert list(refused) == ["000001", "000003"]
    assert list(refused["000001"]) == ["stage", "code", "figures", "action_code", "cause", "action"]
    assert pair["scene"]["state"] == "agrees"


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=15)
@given(
    phi=st.tuples(*[st.floats(-3, 3)] * 3),
    t=st.tuples(*[st.floats(-20, 20)] * 3),
    scale=st.floats(1e-9, 1e-1),
    cause=st.text(max_size=20),
)
def test_every_field_is_read_back_to_the_last_digit(tmp_path, phi, t, scale, cause):
    T, cov = pose(exp_so3(np.array(phi)), np.array(t)) + 0.0, calibration().cov * scale
    written = replace(full(), T_cam_lidar=T, cov=cov, findings=(reason(cause),))
    path = tmp_path / "result.json"
    path.write_text(as_text(written, calibration()), encoding="utf-8")
    read = read_result(path)
    assert read.rig == "rles" and read.text() == path.read_text(encoding="utf-8")
    assert np.array_equal(read.pairs[0].T_cam_lidar, T) and np.array_equal(read.pairs[0].cov, cov)
    blank = {"captures_refused": {}, "findings": ()}
    assert repr(replace(read.pairs[0], **blank)) == repr(replace(written, **blank))
    assert read.pairs[0].findings == written.findings
    assert read.pairs[0].captures_refused == written.captures_refused


def test_unknown_figures_are_null(tmp_path):
    unknown = calibration(metrics=Metrics(np.nan, 0.1, 0.2), certificate=Certificate(False, np.inf))
    path = tmp_path / "result.json"
    path.write_text(as_text(unknown))
    pair = json.loads(path.read_text())["pairs"][0]
    assert (pair["mpe_m"], pair["mge_m"], pair["certificate"]["gap"], pair["egt_rotation_deg"]) == (None,) * 4
    read = read_result(path).pairs[0]
    assert np.isnan(read.metrics.mpe_m) and read.certificate.gap == np.inf and read.egt_rotation_deg is None


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["T_cam_lidar", "cov", "cov_shared"])
def test_non_finite_array_is_refused(name, bad):
    array = np.array(getattr(calibration(), name))
    array[0, 3] = bad
    with pytest.raises(ResultRefusedError):
        as_text(calibration(**{name: array}))


@pytest.mark.parametrize("times", [("2026-11-20T10:22:03Z", None), (None, "2026-11-20T10:22:03Z")])
def test_provenance_and_hashes_of_inputs_are_read_back(tmp_path, times):
    path = tmp_path / "result.json"
    origin = Provenance("kestrel", {"lidar": "AG1", "cam": "7"}, times[0], "0f" * 32, times[1])
    inputs = {"rig.yaml": "0f" * 32, "captures/000000/meta.json": "a1" * 32}
    path.write_text(result_file("rles", [calibration()], inputs, origin).text())
    read = read_result(path)
    assert read.provenance == origin and read.inputs_sha256 == inputs
    assert list(json.loads(path.read_text())["inputs_sha256"]) == sorted(inputs)


def pair_edit(**changes):
    return lambda document: document["pairs"][0].update(changes)


@pytest.mark.parametrize(
    ("edit", "key"),
    [
        (lambda d: d.update(format_version=2), "format_version"),
        (lambda d: d.update(rig=None), "rig"),
        (lambda d: d.update(pairs={}), "pairs"),
        (lambda d: d.update(inputs_sha256={"rig.yaml": "0f"}), "inputs_sha256.rig.yaml"),
        (lambda d: d.update(provenance={"date": "yesterday"}), "provenance.date"),
        (pair_edit(T_cam_lidar=[[1, 0, 0, 0]]), "pairs.0.T_cam_lidar"),
        (pair_edit(T_cam_lidar=(2 * np.eye(4)).tolist()), "pairs.0.T_cam_lidar"),
        (pair_edit(cov=np.triu(np.ones((6, 6))).tolist()), "pairs.0.cov"),
        (pair_edit(cov=(-np.eye(6)).tolist()), "pairs.0.cov"),
        (pair_edit(cov=np.eye(3).tolist()), "pairs.0.cov"),
        (pair_edit(mpe_m=-1.0), "pairs.0.mpe_m"),
        (pair_edit(verdict="great"), "pairs.0.verdict"),
        (pair_edit(captures_refused={"1": {"stage": "moon"}}), "pairs.0.captures_refused.1"),
        *(
            (lambda d, k=k: d["pairs"][0].pop(k), f"pairs.0.{k}")
            for k in REQUIRED
            if k[-2:] not in ("_m", "px")
        ),
    ],
)
def test_a_tampered_result_is_refused_with_its_key(tmp_path, edit, key):
    path = edited(tmp_path / "result.json", edit)
    with pytest.raises(SessionError) as caught:
        read_result(path)
    assert caught.value.what.startswith(f"{path}: {key}")


def test_keys_of_later_versions_are_ignored(tmp_path):
    def of_tomorrow(document):
        document["later"] = document["pairs"][0]["later"] = {"x": 1}

    assert len(read_result(edited(tmp_path / "result.json", of_tomorrow)).pairs) == 1


def test_findings_of_another_version_keep_their_words(tmp_path):
    def of_tomorrow(document):
        finding = document["pairs"][0]["findings"][1]
        finding |= {"code": "verdict.of_tomorrow", "text": "too uncertain", "action": "collect more"}
        document["pairs"][0]["captures_refused"]["000003"]["code"] = "calibrate.of_tomorrow"

    path = edited(tmp_path / "result.json", of_tomorrow)
    (pair,) = read_result(path).pairs
    kept = pair.findings[1]
    assert (kept.code, kept.text, kept.advice) == ("verdict.of_tomorrow", "too uncertain", "collect more")
    assert pair.captures_refused["000003"].text == full().captures_refused["000003"].text


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_result_damaged_gives_session_error(tmp_path, data):
    """Any truncation and any flipped bit: a result or a SessionError."""
    path = tmp_path / "result.json"
    path.write_bytes(data.draw(damaged(as_text(full()).encode())))
    try:
        read_result(path).text()
    except SessionError as error:
        assert str(path) in error.what


@pytest.mark.parametrize("content", [b"", b"[1]", b"null", b"\xff\xfe", b"[" * 100_000])
def test_file_without_result_is_refused(tmp_path, content):
    path = tmp_path / "result.json"
    path.write_bytes(content)
    with pytest.raises(SessionError):
        read_result(path)
