"""Results of many robots put onto them: canaries first, stopped by the first doubt, rolled back together."""

import json
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pytest

from lce_rig.cli.main import run
from lce_rig.core.calibration import Provenance
from lce_rig.core.errors import ProfileError, UsageError
from lce_rig.fleet.deployment import FleetDeployment, Rollout, newest_results, read_rollout
from lce_rig.fleet.registry import Registry, write_rows
from lce_rig.fleet.storage import Storage
from lce_rig.fleet.table import Row
from lce_rig.rig import dump_rig, load_rig
from tests.export.conftest import calibration, some_pose
from tests.saved_results import result_file

ROBOTS = tuple(f"r{k}" for k in range(1, 6))
Add = Callable[..., None]


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    return Registry(Storage.at(tmp_path / "registry"))


@pytest.fixture
def add(registry: Registry) -> Add:
    """Put a result of a robot into the registry."""

    def put(robot: str, date: str = "2026-01-05T10:00:00Z", x_m: float = 0.1, **changes: object) -> None:
        known: dict[str, object] = {"camera": "davis", "lidar": "lidar", "verdict": "pass"}
        known["source"] = f"/sessions/{robot}/{date[:10]}"
        row = Row(robot, date=date, folder=f"{robot}/{date[:10]}-0f", **(known | changes))  # type: ignore[arg-type]
        with registry.result(row.folder) as draft:
            rig = load_rig("rles")
            origin = Provenance(robot, {}, date, "0f" * 32)
            saved = result_file("rles", [calibration(some_pose(t=(x_m, 0, 0)))], provenance=origin)
            (draft / "result.json").write_text(saved.text())
            (draft / "rig.yaml").write_text(dump_rig(rig))
            written = write_rows(draft, [row])
        registry.consolidate(written)
        assert asdict(row)["robot"] == robot

    return put


@pytest.fixture
def targets(tmp_path: Path) -> Path:
    """Each robot's files lie in a folder of its name; r4's command fails where there is a file `broken`."""
    file = tmp_path / "deploy.yaml"
    run = f"! test -e {tmp_path}/robots/{{robot}}/broken"
    file.write_text(
        f'targets: {{nav: {{to: "robots/{{robot}}/calib", run: "{run}", formats: [extrinsics]}}}}'
    )
    for robot in ROBOTS:
        (tmp_path / "robots" / robot).mkdir(parents=True)
    return file


@pytest.fixture
def whole(add: Add) -> None:
    """A result of each robot."""
    for robot in ROBOTS:
        add(robot)


def deploy(
    registry: Registry, targets: Path, canaries: tuple[str, ...] = ROBOTS[:2], check: str = ""
) -> Rollout:
    return FleetDeployment(registry, "nav", targets, check).run(newest_results(registry), canaries, jobs=2)


def held(targets: Path, robot: str) -> bytes | None:
    file = targets.parent / "robots" / robot / "calib" / "current" / "result.json"
    return file.read_bytes() if file.exists() else None


def states(rollout: Rollout) -> dict[str, str]:
    return {robot: state.state for robot, state in rollout.robots.items()}


@pytest.mark.usefixtures("whole")
def test_every_robot_gets_its_own_newest_result(registry: Registry, targets: Path, add: Add) -> None:
    add("r2", "2026-02-01T10:00:00Z", 0.2)
    rollout = deploy(registry, targets)
    assert states(rollout) == dict.fromkeys(ROBOTS, "in_place") and not rollout.stopped_by
    for robot in ROBOTS:
        content = json.loads(held(targets, robot) or b"{}")
        assert content["provenance"]["robot"] == robot
        assert content["pairs"][0]["T_cam_lidar"][0][3] == (0.2 if robot == "r2" else 0.1)
    assert read_rollout(registry, "nav") == rollout
    assert [s.is_canary for s in rollout.robots.values()] == [True, True, False, False, False]


@pytest.mark.usefixtures("whole")
def test_a_robot_whose_newest_session_failed_is_left_out(registry: Registry, targets: Path, add: Add) -> None:
    add("r3", "2026-02-01T10:00:00Z", verdict="fail")
    add("r5", "2026-02-01T10:00:00Z", status="failed", cause="fleet.session", verdict=None)
    rollout = deploy(registry, targets)
    assert states(rollout) == dict.fromkeys(ROBOTS, "in_place") | {"r3": "left_out", "r5": "left_out"}
    assert held(targets, "r3") is None and held(targets, "r5") is None


@pytest.mark.usefixtures("whole")
@pytest.mark.parametrize(("robot", "reached"), [("r2", 2), ("r4", 5)])
def test_a_command_that_fails_stops_everything(
    registry: Registry, targets: Path, robot: str, reached: int
) -> None:
    (targets.parent / "robots" / robot / "broken").touch()
    rollout = deploy(registry, targets)
    assert rollout.stopped_by == robot and rollout.robots[robot].state == "command_failed"
    assert 2 <= len(rollout.robots) <= reached and rollout.robots[robot].release
    # Mended, the same call goes on; canaries that hold the result are not written again.
    before = (targets.parent / "robots" / "r1" / "calib" / "deployments.log").read_bytes()
    (targets.parent / "robots" / robot / "broken").unlink()
    assert states(deploy(registry, targets)) == dict.fromkeys(ROBOTS, "in_place")
    assert (targets.parent / "robots" / "r1" / "calib" / "deployments.log").read_bytes() == before


@pytest.mark.usefixtures("whole")
def test_a_check_that_contradicts_a_canary_stops_before_the_others(registry: Registry, targets: Path) -> None:
    script = "import sys; sys.exit(7 * (sys.argv[1] == 'r2'))"
    rollout = deploy(registry, targets, check=f'{sys.executable} -c "{script}" {{robot}} {{result}} {{to}}')
    assert states(rollout) == {"r1": "in_place", "r2": "contradicted"} and rollout.stopped_by == "r2"
    assert held(targets, "r3") is None
    unsure = f"{sys.executable} -c 'import sys; sys.exit(6)'"
    assert states(deploy(registry, targets, check=unsure)) == dict.fromkeys(ROBOTS, "in_place")


@pytest.mark.usefixtures("whole")
def test_a_robot_that_refuses_is_passed_over_but_not_as_a_canary(
    registry: Registry, targets: Path, add: Add
) -> None:
    deploy(registry, targets)
    # r4's files come from later captures than its newest result in this registry.
    add("r4", "2026-03-01T10:00:00Z")
    deploy(registry, targets)
    registry.set_aside("r4/2026-03-01-0f")
    registry.consolidate()
    rollout = deploy(registry, targets)
    assert rollout.robots["r4"].state == "refused" and not rollout.stopped_by
    assert deploy(registry, targets, ("r4",)).stopped_by == "r4"


@pytest.mark.usefixtures("whole")
def test_all_robots_are_rolled_back_byte_for_byte(registry: Registry, targets: Path, add: Add) -> None:
    deploy(registry, targets)
    first = {robot: held(targets, robot) for robot in ROBOTS}
    for robot in ROBOTS[:-1]:
        add(robot, "2026-02-01T10:00:00Z", 0.3)
    (targets.parent / "robots" / "r4" / "broken").touch()
    assert deploy(registry, targets).stopped_by == "r4"
    assert held(targets, "r1") != first["r1"] and held(targets, "r4") != first["r4"]
    (targets.parent / "robots" / "r4" / "broken").unlink()
    rollout = FleetDeployment(registry, "nav", targets).roll_back("sensor recall")
    assert {robot: held(targets, robot) for robot in ROBOTS} == first
    # The last one's release is its first: nothing came before.
    assert states(rollout) == dict.fromkeys(ROBOTS[:-1], "rolled_back") | {"r5": "not_rolled_back"}


@pytest.mark.usefixtures("whole")
def test_what_was_deployed_by_others_since_is_not_rolled_back(
    registry: Registry, targets: Path, add: Add
) -> None:
    deploy(registry, targets)
    other = Registry(Storage.at(targets.parent / "registry"))
    rolling = FleetDeployment(other, "nav", targets)
    add("r1", "2026-04-01T10:00:00Z", 0.4)
    deploy(registry, targets)
    newest = held(targets, "r1")
    assert states(rolling.roll_back())["r1"] == "not_rolled_back" and held(targets, "r1") == newest


@pytest.mark.usefixtures("whole")
def test_an_unknown_canary_or_target_is_refused(registry: Registry, targets: Path) -> None:
    with pytest.raises(UsageError, match="r9"):
        deploy(registry, targets, ("r9",))
    with pytest.raises(UsageError, match="base"):
        FleetDeployment(registry, "base", targets).run(newest_results(registry), ("r1",))
    assert read_rollout(registry, "base").robots == {} and held(targets, "r1") is None


@pytest.mark.usefixtures("whole")
def test_the_verb_plans_deploys_shows_and_rolls_back(
    targets: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def call(*options: str) -> tuple[int, str]:
        place = ["--registry", str(targets.parent / "registry"), "--targets", str(targets)]
        capsys.readouterr()
        code = run(["fleet", "deploy", *place, "--target", "nav", *options])
        return code, capsys.readouterr().out

    code, planned = call("--dry-run", "--canary", "2")
    assert code == 0 and planned.count("canary") == 2 and held(targets, "r1") is None
    (targets.parent / "robots" / "r2" / "broken").touch()
    assert call("--canary", "2")[0] == 7
    assert held(targets, "r2") is not None and held(targets, "r3") is None
    (targets.parent / "robots" / "r2" / "broken").unlink()
    code, said = call("--canary", "r2,r5", "--json")
    found = {name: each["state"] for name, each in json.loads(said)["robots"].items()}
    assert code == 0 and found == dict.fromkeys(ROBOTS, "in_place")
    code, shown = call("--status")
    assert code == 0 and all(robot in shown for robot in ROBOTS)
    assert call("--rollback", "--reason", "test")[0] == 0
    assert call("--status", "--rollback")[0] == 2


@pytest.mark.parametrize(
    "check", ["see 'this", "see {robots}", "see {robot", "see {0}", "see {robot.wheels}"]
)
def test_a_check_that_cannot_be_filled_in_is_refused_before_anything_is_deployed(registry, targets, check):
    with pytest.raises(UsageError, match="--check"):
        FleetDeployment(registry, "nav", targets, check)


def test_a_name_of_a_target_does_not_lead_out_of_the_registry(registry, targets):
    with pytest.raises(UsageError):
        FleetDeployment(registry, "../nav", targets)


@pytest.mark.usefixtures("whole")
def test_a_mistake_in_the_targets_is_an_error_and_not_a_refusal(registry, targets):
    targets.write_text("targets: {nav: {too: x}}")
    with pytest.raises(ProfileError):
        FleetDeployment(registry, "nav", targets).run(newest_results(registry), ["r1"])
    assert read_rollout(registry, "nav").robots == {}
