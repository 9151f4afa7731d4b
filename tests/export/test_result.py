"""result.json: exact, deterministic, whole, and refused where it cannot be trusted."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lce_rig.core.errors import ResultRefusedError, SessionError
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import exp_so3, pose
from lce_rig.core.results import Calibration, Certificate, Metrics, PointUncertainty
from lce_rig.export.result import layout, read_result, result_text, to_json_dict, write_result
from lce_rig.session.provenance import Provenance
from tests.export.conftest import reason

Make = Callable[..., Calibration]

FIELDS = [
    *("camera", "channel", "lidar", "T_cam_lidar", "cov", "sigma_rotation_deg", "sigma_translation_m"),
    *("n_captures", "n_detected", "captures_used", "captures_refused", "mpe_m", "mee_m", "mge_m"),
    *("reprojection_px", "certificate", "egt_rotation_deg", "egt_translation_m", "verdict", "reasons"),
]


def same(a: Calibration, b: Calibration) -> bool:
    arrays = np.array_equal(a.T_cam_lidar, b.T_cam_lidar) and np.array_equal(a.cov, b.cov)
    blank = {"T_cam_lidar": np.eye(4), "cov": np.eye(6)}
    return arrays and repr(replace(a, **blank)) == repr(replace(b, **blank))


def test_the_published_fields_are_there_in_order(make: Make) -> None:
    document = to_json_dict("rles", [make()])
    assert list(document) == ["format_version", "rig", "made_by", "inputs_sha256", "pairs"]
    assert (document["format_version"], document["rig"]) == (1, "rles")
    assert document["made_by"].startswith("lce-rig ")
    assert list(document["pairs"][0])[: len(FIELDS)] == FIELDS
    assert document["pairs"][0]["certificate"] == {"is_optimal": True, "gap": 1.25e-9}
    refused = document["pairs"][0]["captures_refused"]
    assert list(refused) == ["000001", "000003"]
    assert list(refused["000001"]) == ["stage", "code", "figures", "action_code", "cause", "action"]
    assert (refused["000001"]["stage"], refused["000001"]["code"]) == ("lidar", "lidar.too_few_rings")
    assert refused["000001"]["figures"] == make().captures_refused["000001"].figures


def test_refusals_of_earlier_and_of_later_versions_are_kept_as_text(make: Make, tmp_path: Path) -> None:
    document = to_json_dict("rles", [make()])
    refused = document["pairs"][0]["captures_refused"]
    refused["000001"] = {"stage": "lidar", "cause": "2 rings", "action": "come closer"}
    refused["000003"] |= {"code": "calibrate.of_tomorrow"}
    path = tmp_path / "result.json"
    path.write_text(json.dumps(document))
    first, second = read_result(path).pairs[0].captures_refused.values()
    assert (first.code, first.figures) == ("lidar.text", {"text": "2 rings", "advice": "come closer"})
    assert (second.code, second.figures["text"]) == ("calibrate.text", refused["000003"]["cause"])


def test_the_method_is_told_and_read_back(make: Make, tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    write_result(path, "rles", [make(method="other")])
    assert json.loads(path.read_text())["pairs"][0]["method"] == "other"
    assert read_result(path).pairs[0].method == "other"


def test_hashes_of_inputs_are_read_back_and_what_is_no_hash_is_refused(make: Make, tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    inputs = {"rig.yaml": "0f" * 32, "captures/000000/meta.json": "a1" * 32}
    write_result(path, "rles", [make()], inputs)
    assert read_result(path).inputs_sha256 == inputs
    path.write_text(path.read_text().replace("0f" * 32, "0f"))
    with pytest.raises(SessionError, match=r"inputs_sha256\.rig\.yaml"):
        read_result(path)


def test_provenance_is_read_back_and_files_without_it_stay_readable(make: Make, tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    origin = Provenance("kestrel", {"lidar": "AG1", "cam": "7"}, "2026-11-20T10:22:03Z", "0f" * 32)
    path.write_text(layout(to_json_dict("rles", [make()], provenance=origin)))
    assert read_result(path).provenance == origin
    document = json.loads(path.read_text())
    path.write_text(json.dumps(document | {"provenance": {"date": "yesterday"}}))
    with pytest.raises(SessionError, match=r"provenance\.date"):
        read_result(path)
    del document["provenance"]
    path.write_text(json.dumps(document))
    assert read_result(path).provenance == Provenance()


def test_a_result_of_an_earlier_version_holds_no_hashes(make: Make, tmp_path: Path) -> None:
    document = to_json_dict("rles", [make()])
    del document["inputs_sha256"]
    path = tmp_path / "result.json"
    path.write_text(json.dumps(document))
    assert read_result(path).inputs_sha256 == {}


def test_figures_that_do_not_exist_are_null(make: Make) -> None:
    pair = to_json_dict(
        "rles", [make(metrics=Metrics(np.nan, 0.1, 0.2), certificate=Certificate(False, np.inf))]
    )["pairs"][0]
    assert (pair["mpe_m"], pair["mge_m"], pair["certificate"]["gap"], pair["egt_rotation_deg"]) == (None,) * 4


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_pose_that_is_not_finite_is_refused(make: Make, tmp_path: Path, bad: float) -> None:
    T, cov = np.eye(4), np.eye(6)
    T[0, 3], cov[2, 2] = bad, bad
    for changes in ({"T_cam_lidar": T}, {"cov": cov}):
        with pytest.raises(ResultRefusedError, match="not finite"):
            write_result(tmp_path / "result.json", "rles", [make(**changes)])
    assert list(tmp_path.iterdir()) == []


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    phi=st.tuples(*[st.floats(-3, 3)] * 3),
    t=st.tuples(*[st.floats(-20, 20)] * 3),
    scale=st.floats(1e-9, 1e-1),
    cause=st.text(max_size=20),
)
def test_what_is_read_equals_what_was_written_to_the_last_digit(
    make: Make, tmp_path: Path, phi: Any, t: Any, scale: float, cause: str
) -> None:
    T = pose(exp_so3(np.array(phi)), np.array(t)) + 0.0
    calibrations = [
        make(T, cov=make().cov * scale, findings=(reason(cause),)),
        make(channels=("events",), egt_rotation_deg=0.5, egt_translation_m=scale, verdict="marginal"),
    ]
    path = tmp_path / "result.json"
    write_result(path, "rles", calibrations)
    saved = read_result(path)
    assert saved.rig == "rles"
    written = [replace(c, captures_refused=dict(sorted(c.captures_refused.items()))) for c in calibrations]
    assert all(same(a, b) for a, b in zip(saved.pairs, written, strict=True))
    assert path.read_text(encoding="utf-8") == result_text("rles", saved.pairs)


def test_the_order_of_mappings_does_not_change_the_bytes(make: Make) -> None:
    turned = make(
        captures_refused=dict(reversed(make().captures_refused.items())),
    )
    assert result_text("rles", [turned]) == result_text("rles", [make()])


def set_in(document: Any, path: str, value: Any) -> None:
    *parents, last = path.split(".")
    for key in parents:
        document = document[int(key) if isinstance(document, list) else key]
    document[int(last) if isinstance(document, list) else last] = value


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        ("format_version", 2, "format_version is 2"),
        ("format_version", True, "format_version is True"),
        ("format_version", "1", "format_version"),
        ("rig", None, "rig"),
        ("pairs", {}, "pairs"),
        ("pairs.0.T_cam_lidar", [[1, 0, 0, 0]], "pairs.0.T_cam_lidar"),
        ("pairs.0.T_cam_lidar.3.3", 2.0, "last row"),
        ("pairs.0.T_cam_lidar.0.0", 5.0, "not a rotation"),
        ("pairs.0.T_cam_lidar.0.0", "1", "pairs.0.T_cam_lidar.0.0"),
        ("pairs.0.cov.0.1", 1.0, "not symmetric"),
        ("pairs.0.cov.0.0", -1.0, "negative"),
        ("pairs.0.sigma_rotation_deg", 3.0, "contradicts cov"),
        ("pairs.0.n_detected", 5, "5 of 4 captures"),
        ("pairs.0.verdict", "great", "pairs.0.verdict"),
        ("pairs.0.captures_refused.000001", {"stage": "moon"}, "pairs.0.captures_refused.000001.stage"),
        ("pairs.1.channel", "frames", "given twice"),
    ],
)
def test_a_tampered_result_is_refused_with_its_key(
    make: Make, tmp_path: Path, path: str, value: Any, says: str
) -> None:
    document = to_json_dict("rles", [make(), make(channels=("events",))])
    set_in(document, path, value)
    file = tmp_path / "result.json"
    file.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(SessionError) as caught:
        read_result(file)
    assert says in str(caught.value)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize("field", FIELDS)
def test_a_missing_field_is_named(make: Make, tmp_path: Path, field: str) -> None:
    document = to_json_dict("rles", [make()])
    del document["pairs"][0][field]
    path = tmp_path / "result.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(SessionError, match=field):
        read_result(path)


def test_fields_of_later_versions_are_ignored(make: Make, tmp_path: Path) -> None:
    document = to_json_dict("rles", [make()])
    document["later"] = document["pairs"][0]["later"] = {"x": 1}
    path = tmp_path / "result.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    assert len(read_result(path).pairs) == 1


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[1]", b"null", b"\xff\xfe", b'{"format_version": NaN}', b"[" * 100_000]
)
def test_what_is_no_result_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "result.json"
    path.write_bytes(content)
    with pytest.raises(SessionError, match=r"result\.json"):
        read_result(path)


def test_a_result_torn_anywhere_is_refused(make: Make, tmp_path: Path) -> None:
    whole = result_text("rles", [make()]).encode()
    path = tmp_path / "result.json"
    for length in range(0, len(whole) - 1, 97):
        path.write_bytes(whole[:length])
        with pytest.raises(SessionError):
            read_result(path)


def test_a_missing_result_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="no such file") as caught:
        read_result(tmp_path / "result.json")
    assert "lce-rig calibrate" in caught.value.hint


def test_a_folder_that_cannot_be_written_is_a_session_error(make: Make, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    with pytest.raises(SessionError, match="cannot be written"):
        write_result(tmp_path / "file" / "result.json", "rles", [make()])


WRITER = """
import sys
from pathlib import Path
from lce_rig.session.durable import write_atomically
print("ready", flush=True)
while True:
    for letter in "ab":
        write_atomically(Path(sys.argv[1]), letter * 200_000)
"""


def test_a_writer_killed_at_any_moment_leaves_a_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    for _ in range(3):
        with subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE) as writer:
            assert writer.stdout is not None
            assert writer.stdout.readline() == b"ready\n"
            while not path.exists():
                pass
            os.kill(writer.pid, signal.SIGKILL)
        assert path.read_text(encoding="utf-8") in ("a" * 200_000, "b" * 200_000)


def test_what_the_uncertainty_means_at_distances_is_read_back(make: Make, tmp_path: Path) -> None:
    stated = (PointUncertainty(5.0, 1.25, 0.0125, 1.5, 0.015), PointUncertainty(10.0, 1.0, 0.02, 1.2, 0.03))
    path = tmp_path / "result.json"
    write_result(path, "rles", [replace(make(), uncertainty=stated)])
    assert read_result(path).pairs[0].uncertainty == stated
    document = json.loads(path.read_text())
    assert document["pairs"][0]["uncertainty"][0]["corner_m"] == 0.015
    document["pairs"][0]["uncertainty"][0]["corner_m"] = -1.0
    path.write_text(json.dumps(document))
    with pytest.raises(SessionError, match="corner_m"):
        read_result(path)


def test_reasons_of_files_without_findings_are_read_as_findings(make: Make, tmp_path: Path) -> None:
    document = to_json_dict("rles", [make(verdict="fail")])
    del document["pairs"][0]["findings"]
    document["pairs"][0]["reasons"] = ["the board was bent: use another"]
    path = tmp_path / "result.json"
    path.write_text(layout(document), encoding="utf-8")
    (pair,) = read_result(path).pairs
    assert pair.findings == (reason("the board was bent: use another"),)
    assert to_json_dict("rles", [pair])["pairs"][0]["reasons"] == document["pairs"][0]["reasons"]


def test_findings_of_earlier_versions_keep_severity_and_words(make: Make, tmp_path: Path) -> None:
    document = to_json_dict("rles", [make()])
    old = document["pairs"][0]["findings"][1]
    old["figures"] = {"sigma_deg": 0.3, "weakest": "rotation about x, sigma 0.2 deg"}
    old |= {"text": "too uncertain", "action": "collect more"}
    path = tmp_path / "result.json"
    path.write_text(layout(document), encoding="utf-8")
    (pair,) = read_result(path).pairs
    figures = {"text": "too uncertain", "advice": "collect more"}
    assert pair.findings[1] == Finding("verdict.text", "warning", figures=figures)
