"""A foreign manifest: a fault refuses its capture, and no other."""

import json

import pytest

from lce_rig.core.errors import SessionError
from lce_rig.session import Session, check_capture


@pytest.fixture
def capture(tmp_path, rig, samples):
    with Session.create(tmp_path / "s", rig) as session:
        session.add_capture(*samples(0), {})
        return session.captures[0]


def change(capture, index=0, **changes):
    path = capture.path / "meta.json"
    manifest = json.loads(path.read_text())
    manifest["files"][index].update(changes)
    path.write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    "changes",
    [
        {"file": 3},
        {"bytes": True},
        {"file": "../../rig.yaml"},
        {"file": "/etc/passwd"},
        {"file": ""},
        {"kind": "film"},
        {"stamp_ns": 10**200},
        {"host_ns": 1.5},
        {"camera": "a b"},
        {"channel": "../x"},
    ],
)
def test_wrong_value_types_are_named_with_their_key(capture, changes):
    change(capture, **changes)
    with pytest.raises(SessionError, match=rf"meta\.json: .*{next(iter(changes))}"):
        capture.check()


@pytest.mark.parametrize(
    ("index", "field"), [(0, "camera"), (0, "channel"), (0, "stamp_ns"), (1, "lidar"), (1, "stamp_ns")]
)
def test_missing_field_of_entry_is_named(capture, index, field):
    path = capture.path / "meta.json"
    manifest = json.loads(path.read_text())
    del manifest["files"][index][field]
    path.write_text(json.dumps(manifest))
    with pytest.raises(SessionError, match=rf"meta\.json: files\.{index}: .*{field}"):
        capture.check()


def test_a_sensor_named_twice_is_refused(capture):
    path = capture.path / "meta.json"
    manifest = json.loads(path.read_text())
    manifest["files"].append(manifest["files"][1])
    path.write_text(json.dumps(manifest))
    with pytest.raises(SessionError, match="lidar"):
        capture.check()


@pytest.mark.parametrize(
    ("index", "changes"), [(0, {"camera": "other"}), (0, {"channel": "no"}), (1, {"lidar": "top"})]
)
def test_sensors_that_the_rig_lacks_are_named(capture, rig, index, changes):
    change(capture, index, **changes)
    with pytest.raises(SessionError, match="000000"):
        check_capture(rig, capture)
