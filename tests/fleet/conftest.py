"""Rows of a fleet's table, sessions and results in folders, and targets."""

import json
import shutil

import numpy as np
import pytest
from wire.sshd import NoServerError, Sshd

import lce_rig.collect.findings
import lce_rig.judge.findings  # noqa: F401  kinds of the findings in stored results
from lce_rig.core.calibration import Provenance
from lce_rig.fleet.registry import Registry
from lce_rig.fleet.storage import Storage
from lce_rig.fleet.target import TargetSettings
from lce_rig.rig import load_rig
from lce_rig.session import Session
from lce_rig.simulate import simulate_captures
from tests.export.conftest import calibration, some_pose
from tests.saved_results import result_file
from tests.shared import half_size, make_once

ORIGIN = Provenance("kestrel", {"lidar": "AG1", "davis": "499"}, "2026-11-20T10:22:03Z", "0f" * 32)


@pytest.fixture
def row():
    def make(robot="r1", date="2026-01-05T10:00:00Z", **changes):
        known = {
            "robot": robot,
            "date": date,
            "status": "ok",
            "source": f"/sessions/{robot}/{date}",
            "rig": "rlfs",
            "folder": f"{robot}/{str(date)[:10]}-0123456789ab",
            "camera": "cam",
            "lidar": "lidar",
            "verdict": "pass",
            "findings": ["verdict.may_be_off"],
            "severities": ["note"],
            "T_cam_lidar": np.eye(4).ravel().tolist(),
            "cov": [float(k) for k in range(21)],
            "n_used": 8,
        }
        return known | changes

    return make


@pytest.fixture
def registry(tmp_path):
    return Registry(Storage.at(tmp_path / "registry"))


@pytest.fixture(scope="session")
def small_rig():
    """Return the rig rlfs with images of half the size, which are searched in half the time."""
    return half_size(load_rig("rlfs"))


@pytest.fixture(scope="session")
def simulated(small_rig):
    """Simulate a session of eight captures."""

    def make(path):
        with Session.create(path, small_rig) as session:
            for capture in simulate_captures(small_rig, n_captures=8, seed=3):
                session.add_capture(capture.images, capture.scans, {"source": "simulated"})

    return make_once("fleet_session", make)


@pytest.fixture
def fleet_root(simulated, tmp_path):
    """Lay out three sessions of two robots, of them one without result and one that cannot be read."""
    root = tmp_path / "root"
    for name in ("r1/monday", "r2/monday", "r2/torn"):
        shutil.copytree(simulated, root / name)
    for name in ("000002", "000003", "000004", "000005", "000006", "000007"):
        shutil.rmtree(root / "r2/monday/captures" / name)
    (root / "r2/torn/session.json").write_text('{"format_ver')
    return root


@pytest.fixture(scope="session")
def rig():
    return load_rig("rles")


@pytest.fixture
def result(tmp_path):
    """Write the result of a calibration into a folder of its own."""

    def write(name="a", x_m=0.12, origin=ORIGIN, rig_name="rles", **changes):
        folder = tmp_path / f"result-{name}"
        folder.mkdir()
        pair = calibration(some_pose(t=(x_m, -0.07, -0.08)), **changes)
        (folder / "result.json").write_text(result_file(rig_name, [pair], provenance=origin).text())
        return folder

    return write


@pytest.fixture
def robot(tmp_path):
    """The folder that a robot's software reads from."""
    return tmp_path / "robot"


@pytest.fixture
def local(robot):
    return TargetSettings(to=str(robot))


@pytest.fixture(scope="session")
def server(tmp_path_factory):
    try:
        with Sshd(tmp_path_factory.mktemp("ssh")) as running:
            yield running
    except NoServerError as error:
        pytest.skip(f"no sshd: {error}")


@pytest.fixture
def far(robot, server):
    return TargetSettings(to=f"{server.to}:{robot}", ssh=server.options)


@pytest.fixture(params=["folder", pytest.param("ssh", marks=pytest.mark.long)])
def target(request):
    """A target in this computer's files, and the same by ssh."""
    name = {"folder": "local", "ssh": "far"}[request.param]
    return request.getfixturevalue(name)


def log_of(robot):
    return [json.loads(line) for line in (robot / "deployments.log").read_text().splitlines()]
