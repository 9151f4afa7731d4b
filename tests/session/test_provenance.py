"""Provenance of results: robot, serial numbers, date, and a fingerprint that depends on inputs only."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from lce_rig.core.errors import SessionError, UsageError
from lce_rig.session import Session
from lce_rig.session.capture import SERIALS
from lce_rig.session.provenance import content_sha256, provenance_of
from tests.shared import changed

Samples = Callable[..., tuple[list[Any], list[Any]]]


@pytest.fixture
def fill(rig, samples):
    """Create a session of two captures with these reported serial numbers."""

    def make(folder, rig=rig, *told, seeds=(1, 2)):
        with Session.create(folder, rig) as session:
            for k, seed in enumerate(seeds):
                meta = {"source": {"label": folder.name}} | ({SERIALS: told[k]} if k < len(told) else {})
                session.add_capture(*samples(seed), meta)
        return Session.open(folder)

    return make


def test_provenance_joins_captures_and_rig(fill, rig, tmp_path):
    named = changed(rig.of_robot("kestrel"), cameras__cam__serial="C7")
    found = provenance_of(fill(tmp_path / "a", named, {}, {"lidar": "AG43510116"}))
    assert (found.robot, found.serials) == ("kestrel", {"cam": "C7", "lidar": "AG43510116"})
    # Of the last capture's scan, 10**18 ns and its seed.
    assert (found.date, found.imported) == ("2001-09-09T01:46:40Z", None)


def test_two_units_of_one_sensor_are_refused(fill, rig, tmp_path):
    with pytest.raises(SessionError):
        provenance_of(fill(tmp_path / "a", rig, {"lidar": "A"}, {"lidar": "B"}))
    one, other = (fill(tmp_path / s, rig, {"lidar": s}, seeds=(k,)) for k, s in enumerate("XY"))
    with Session.open(one.path, writable=True) as session:
        session.add_session(other)
    with pytest.raises(SessionError, match="X"):
        provenance_of(one)


def test_the_fingerprint_changes_with_inputs_only(fill, rig, samples, tmp_path):
    first = fill(tmp_path / "a")
    shutil.copytree(tmp_path / "a", tmp_path / "elsewhere")
    same = [
        Session.open(tmp_path / "elsewhere"),
        fill(tmp_path / "b", changed(rig.of_robot("r1"), lidars__lidar__serial="S"), {"cam": "C"}),
        fill(tmp_path / "c", changed(rig, description="other", lidars__lidar__driver__address="10.0.0.9")),
    ]
    assert {content_sha256(each) for each in same} == {content_sha256(first)}
    other = [
        fill(tmp_path / "d", changed(rig, board__square_m=rig.board.square_m * 1.001)),
        fill(tmp_path / "e", seeds=(2, 1)),
        fill(tmp_path / "f", seeds=(1,)),
    ]
    hashes = [content_sha256(each) for each in (first, *other)]
    assert len(set(hashes)) == 4
    with Session.open(tmp_path / "f", writable=True) as session:
        images, scans = samples(2)
        later = [replace(scan, stamp_ns=scan.stamp_ns + 1) for scan in scans]
        session.add_capture(images, later, {})
    assert content_sha256(Session.open(tmp_path / "f")) not in hashes


def test_provenance_without_times_has_import(rig, samples, tmp_path):
    with Session.create(tmp_path / "a", rig) as session:
        images, scans = samples(1)
        # A clock that counts from the sensor's start has no date.
        session.add_capture(
            [replace(image, stamp_ns=5 * 10**9) for image in images],
            [replace(scan, stamp_ns=5 * 10**9, host_ns=None) for scan in scans],
            {},
        )
    session = Session.open(tmp_path / "a")
    written = next(entry["time"] for entry in session.read_journal() if entry["event"] == "captured")
    origin = provenance_of(session)
    assert (origin.date, origin.imported) == (None, f"{written[:19]}Z")
    assert written[:10] in origin.date_words
    (tmp_path / "a" / "journal.jsonl").unlink()
    origin = provenance_of(session)
    assert (origin.date, origin.imported, origin.date_words) == (None, None, "")


def test_robot_can_be_named_later_but_not_renamed(rig, tmp_path, samples):
    with Session.create(tmp_path / "a", rig) as session:
        session.add_capture(*samples(0), {})
    Session.resume(tmp_path / "a", rig.of_robot("kestrel")).close()
    Session.resume(tmp_path / "a", rig).close()
    assert Session.open(tmp_path / "a").rig.robot == "kestrel"
    with pytest.raises(SessionError):
        Session.resume(tmp_path / "a", rig.of_robot("heron"))
    with pytest.raises(UsageError):
        rig.of_robot("kestrel").of_robot("heron")
    with pytest.raises(UsageError):
        rig.of_robot("../x")
