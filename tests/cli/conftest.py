"""One simulated session that the verbs share; every test that writes copies it."""

import shutil
from dataclasses import dataclass

import pytest

from lce_rig.cli.main import run
from lce_rig.core.findings import Finding
from tests.shared import make_once


@dataclass(frozen=True)
class Outcome:
    """What one command line did."""

    code: int
    out: str
    err: str


@pytest.fixture
def lce_rig(capsys):
    """Run a command line in this process."""

    def call(*words):
        capsys.readouterr()
        code = run([str(word) for word in words])
        captured = capsys.readouterr()
        return Outcome(code, captured.out, captured.err)

    return call


@pytest.fixture
def mute(monkeypatch):
    """Every rendered text is its code alone."""
    monkeypatch.setattr(Finding, "_render", lambda finding, template: finding.code)


@pytest.fixture(scope="session")
def simulated():
    """A session of the rig rles with sixteen captures, detected once."""

    def make(session):
        assert run(["simulate", "--rig", "rles", str(session), "--captures", "16", "--seed", "3"]) == 0
        assert run(["check", str(session)]) == 0

    return make_once("simulated", make)


@pytest.fixture(scope="session")
def calibrated_once(simulated):
    """The simulated session with its result; as `lce-rig calibrate` leaves it."""

    def make(session):
        shutil.copytree(simulated, session)
        assert run(["calibrate", str(session)]) == 0

    return make_once("calibrated", make)


@pytest.fixture
def calibrated(calibrated_once, tmp_path):
    """A copy of the calibrated session to write into."""
    copy = tmp_path / "session"
    shutil.copytree(calibrated_once, copy)
    return copy


@pytest.fixture
def calibrated_few(calibrated):
    """The same with its first four captures only, for what is quicker to see on few."""
    for path in sorted((calibrated / "captures").iterdir())[4:]:
        shutil.rmtree(path)
    return calibrated


@pytest.fixture
def session(simulated, tmp_path):
    """A copy of the simulated session to write into."""
    copy = tmp_path / "session"
    shutil.copytree(simulated, copy)
    return copy
