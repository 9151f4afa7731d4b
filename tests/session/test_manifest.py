"""A manifest from somebody else: what is wrong with it is a refusal of its capture, and of no other."""

import hashlib
import json

import cv2
import numpy as np
import pytest

from lce_rig.core.errors import SessionError
from lce_rig.core.pcd import decode_pcd, encode_pcd
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


def replace(capture, index, data):
    """Put other data in place of a file, checksum included."""
    name = ("cam.frames.png", "lidar.pcd")[index]
    (capture.path / name).write_bytes(data)
    change(capture, index, bytes=len(data), sha256=hashlib.sha256(data).hexdigest())


@pytest.mark.parametrize(
    "changes",
    [
        {"file": True},
        {"file": 3},
        {"file": ["a"]},
        {"bytes": True},
        {"bytes": -1},
        {"bytes": 10**18},
        {"sha256": "x"},
        {"stamp_ns": True},
        {"stamp_ns": 10**200},
        {"host_ns": 1.5},
        {"camera": "a b"},
        {"channel": "../x"},
        {"channel": {}},
    ],
)
def test_values_of_the_wrong_kind_are_named_with_their_key(capture, changes):
    change(capture, **changes)
    with pytest.raises(
        SessionError, match=rf"capture 000000 is damaged: meta\.json: .*{next(iter(changes))}"
    ):
        capture.check()


def test_a_sensor_named_twice_is_refused(capture):
    path = capture.path / "meta.json"
    manifest = json.loads(path.read_text())
    manifest["files"].append(manifest["files"][1])
    path.write_text(json.dumps(manifest))
    with pytest.raises(SessionError, match="scan of lidar is named twice"):
        capture.check()


@pytest.mark.parametrize(
    ("index", "changes"), [(0, {"camera": "other"}), (0, {"channel": "no"}), (1, {"lidar": "top"})]
)
def test_sensors_that_the_rig_lacks_are_named(capture, rig, index, changes):
    change(capture, index, **changes)
    with pytest.raises(SessionError, match="capture 000000 belongs to another rig"):
        check_capture(rig, capture)


@pytest.mark.parametrize(
    ("pixels", "cause"),
    [
        (np.zeros((4, 4), np.uint16), "uint16"),
        (np.zeros((4, 4, 4), np.uint8), r"\(4, 4, 4\)"),
        (None, "it is empty"),
    ],
)
def test_an_image_of_another_kind_is_no_image_of_a_capture(capture, pixels, cause):
    replace(capture, 0, b"" if pixels is None else cv2.imencode(".png", pixels)[1].tobytes())
    with pytest.raises(SessionError, match=rf"cam\.frames\.png.*{cause}"):
        capture.image("cam", "frames")


@pytest.mark.parametrize(
    ("field", "kind", "value", "cause"),
    [
        ("ring", "f4", 1, "ring is of type float32"),
        ("ring", "i2", -1, "ring runs from -1"),
        ("ring", "u4", 2**32 - 1, "ring runs from 4294967295"),
        ("x", "f4", np.nan, "x is not finite"),
        ("x", "f8", 1e300, "x is not finite"),
        ("x", "i4", 1, "x is of type int32"),
        ("time", "i8", 2**62, "time runs from"),
        ("ring", None, None, "no field ring"),
    ],
)
def test_a_scan_with_other_fields_is_no_scan_of_a_capture(capture, field, kind, value, cause):
    cloud = decode_pcd((capture.path / "lidar.pcd").read_bytes())
    kinds = [(n, kind if n == field else cloud.dtype[n]) for n in cloud.dtype.names if n != field or kind]
    changed = np.zeros(len(cloud), kinds)
    if kind:
        changed[field] = value
    replace(capture, 1, encode_pcd(changed))
    with pytest.raises(SessionError, match=rf"lidar\.pcd: .*{cause}"):
        capture.scan("lidar")
