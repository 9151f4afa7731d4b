"""Results in folders, and targets."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from wire.sshd import NoServerError, Sshd

import lce_rig.collect.findings
import lce_rig.judge.findings  # noqa: F401  kinds of the findings in stored results
from lce_rig.core.calibration import Provenance
from lce_rig.rig import Rig, load_rig
from lce_rig.rig.target_settings import TargetSettings
from tests.export.conftest import calibration, some_pose
from tests.saved_results import result_file

ORIGIN = Provenance("kestrel", {"lidar": "AG1", "davis": "499"}, "2026-11-20T10:22:03Z", "0f" * 32)


@pytest.fixture(scope="session")
def rig() -> Rig:
    return load_rig("rles")


@pytest.fixture
def result(tmp_path: Path) -> Callable[..., Path]:
    """Write the result of a calibration into a folder of its own."""

    def write(name: str = "a", x_m: float = 0.12, origin: Provenance = ORIGIN, **changes: Any) -> Path:
        folder = tmp_path / f"result-{name}"
        folder.mkdir()
        pair = calibration(some_pose(t=(x_m, -0.07, -0.08)), **changes)
        (folder / "result.json").write_text(result_file("rles", [pair], provenance=origin).text())
        return folder

    return write


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """The folder that a robot's software reads from."""
    return tmp_path / "robot"


@pytest.fixture
def local(robot: Path) -> TargetSettings:
    return TargetSettings(to=str(robot))


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sshd]:
    try:
        with Sshd(tmp_path_factory.mktemp("ssh")) as running:
            yield running
    except NoServerError as error:
        pytest.skip(f"no sshd: {error}")


@pytest.fixture
def far(robot: Path, server: Sshd) -> TargetSettings:
    return TargetSettings(to=f"{server.to}:{robot}", ssh=server.options)


@pytest.fixture(params=["folder", pytest.param("ssh", marks=pytest.mark.long)])
def target(request: pytest.FixtureRequest) -> TargetSettings:
    """A target in this computer's files, and the same by ssh."""
    name = {"folder": "local", "ssh": "far"}[request.param]
    found: TargetSettings = request.getfixturevalue(name)
    return found


def log_of(robot: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (robot / "deployments.log").read_text().splitlines()]
