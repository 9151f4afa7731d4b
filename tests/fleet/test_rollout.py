"""Results of many robots put onto them, one after the other, and rolled back together."""

import json
import re
from collections.abc import Callable

import pytest

import lce_rig.collect.findings
import lce_rig.judge.findings  # noqa: F401  kinds of the findings in stored results
from lce_rig.cli.main import run
from lce_rig.core.calibration import Provenance
from lce_rig.core.errors import ProfileError, UsageError
from lce_rig.fleet.registry import as_table, write_rows
from lce_rig.fleet.rollout import newest_results, roll_out
from lce_rig.rig import dump_rig, load_rig
from tests.export.conftest import calibration, some_pose
from tests.saved_results import result_file

PROFILE = dump_rig(load_rig("rles"))
ROBOTS = tuple(f"r{k}" for k in range(1, 4))
Add = Callable[..., None]
HOSTILE = "\x1b]0;x\x07\x1b[2J\r\u202e\x9b31m"
SHOWN = r"\x1b]0;x"


@pytest.fixture
def add(registry):
    """Put a result of a robot into the registry."""

    def put(robot, date="2026-01-05T10:00:00Z", x_m=0.1, verdict="pass", is_last=True, **changes):
        known = {"status": "ok", "source": f"/sessions/{robot}/{date[:10]}"}
        row = {"robot": robot, "date": date, "folder": f"{robot}/{date[:10]}-0f", **known, **changes}
        with registry.result(str(row["folder"])) as draft:
            origin = Provenance(robot, {}, date, "0f" * 32)
            pair = calibration(some_pose(t=(x_m, 0, 0)), verdict=verdict)
            saved = result_file("rles", [pair], provenance=origin)
            (draft / "result.json").write_text(saved.text())
            (draft / "rig.yaml").write_text(PROFILE)
            write_rows(draft, [row])
        if is_last:
            registry.consolidate()

    return put


@pytest.fixture
def targets(tmp_path):
    """Each robot's files lie in a folder of its name; its command fails where there is a file `broken`."""
    file = tmp_path / "deploy.yaml"
    run = f"! test -e {tmp_path}/robots/$1/broken"
    file.write_text(
        f'targets: {{nav: {{to: "robots/{{robot}}/calib", run: "{run}", formats: [extrinsics]}}}}'
    )
    for robot in ROBOTS:
        (tmp_path / "robots" / robot).mkdir(parents=True)
    return file


@pytest.fixture
def whole(add):
    """A result of each robot."""
    for robot in ROBOTS:
        add(robot, is_last=robot == ROBOTS[-1])


def deploy(registry, targets):
    return roll_out(registry, "nav", targets, newest_results(registry))


def held(targets, robot):
    file = targets.parent / "robots" / robot / "calib" / "current" / "result.json"
    return file.read_bytes() if file.exists() else None


def states(rollout):
    return {robot: state.state for robot, state in rollout.robots.items()}


@pytest.mark.usefixtures("whole")
def test_every_robot_gets_its_own_newest_result(registry, targets, add):
    add("r2", "2026-02-01T10:00:00Z", 0.2)
    rollout = deploy(registry, targets)
    assert states(rollout) == dict.fromkeys(ROBOTS, "in_place") and not rollout.stopped_by
    for robot in ROBOTS:
        content = json.loads(held(targets, robot) or b"{}")
        assert content["provenance"]["robot"] == robot
        assert content["pairs"][0]["T_cam_lidar"][0][3] == (0.2 if robot == "r2" else 0.1)


@pytest.mark.usefixtures("whole")
def test_rollout_skips_robot_with_failed_session(registry, targets, add):
    add("r2", "2026-02-01T10:00:00Z", verdict="fail")
    add("r3", "2026-02-01T10:00:00Z", status="failed", cause="fleet.session")
    rollout = deploy(registry, targets)
    assert states(rollout) == {"r1": "in_place", "r2": "left_out", "r3": "left_out"}
    assert held(targets, "r2") is None and held(targets, "r3") is None


@pytest.mark.usefixtures("whole")
def test_rollout_stops_at_failure_and_resumes(registry, targets):
    robots = targets.parent / "robots"
    (robots / "r2" / "broken").touch()
    rollout = deploy(registry, targets)
    assert states(rollout) == {"r1": "in_place", "r2": "failed"} and rollout.stopped_by == "r2"
    assert rollout.robots["r2"].release and held(targets, "r3") is None
    before = (robots / "r1" / "calib" / "deployments.log").read_bytes()
    (robots / "r2" / "broken").unlink()
    assert states(deploy(registry, targets)) == dict.fromkeys(ROBOTS, "in_place")
    assert (robots / "r1" / "calib" / "deployments.log").read_bytes() == before


@pytest.mark.usefixtures("whole")
def test_a_robot_that_refuses_its_result_stops_it(registry, targets, add):
    # The files at r3 come from later captures than its newest result in this registry.
    add("r3", "2026-03-01T10:00:00Z")
    deploy(registry, targets)
    registry.set_aside("r3/2026-03-01-0f")
    registry.consolidate()
    assert deploy(registry, targets).stopped_by == "r3"


@pytest.mark.usefixtures("whole")
@pytest.mark.parametrize("name", ["a}]}, x: {to: /tmp", "$(touch x)", "../r1", "r 9", "-oProxyCommand=x"])
def test_rollout_hostile_names_do_nothing(registry, targets, name):
    row = {
        "robot": name,
        "date": "2026-01-05T10:00:00Z",
        "folder": f"{name}/a",
        "status": "ok",
        "verdict": "pass",
    }
    registry.write_table(as_table([row]))
    before = sorted(targets.parent.rglob("*"))
    rollout = deploy(registry, targets)
    assert [state.state for state in rollout.robots.values()] in (["left_out"], ["failed"])
    assert sorted(targets.parent.rglob("*")) == before


@pytest.mark.usefixtures("whole")
def test_the_verb_plans_and_deploys(targets, capsys):
    def call(*options):
        place = ["--registry", str(targets.parent / "registry"), "--targets", str(targets)]
        capsys.readouterr()
        code = run(["fleet", "deploy", *place, "--target", "nav", *options])
        return code, capsys.readouterr().out

    code, planned = call("--dry-run")
    assert code == 0 and all(robot in planned for robot in ROBOTS) and held(targets, "r1") is None
    (targets.parent / "robots" / "r2" / "broken").touch()
    assert call()[0] == 7
    assert held(targets, "r2") is not None and held(targets, "r3") is None
    (targets.parent / "robots" / "r2" / "broken").unlink()
    code, said = call("--json", "--where", "robot <> 'r3'")
    in_place = {name: each["state"] for name, each in json.loads(said)["robots"].items()}
    assert code == 0 and in_place == dict.fromkeys(ROBOTS[:-1], "in_place")
    of_robot = ["deploy", str(targets.parent), "--targets", str(targets), "--target", "nav", "--robot", "r2"]
    assert run([*of_robot, "--status"]) == 0 and "r2" in capsys.readouterr().out
    assert run([*of_robot[:-1], "../r2", "--status"]) == 2


@pytest.mark.parametrize(
    ("target", "text", "error"),
    [("base", None, UsageError), ("nav", "targets: {nav: {too: x}}", ProfileError)],
)
def test_a_mistake_is_an_error_before_anything_is_deployed(registry, targets, target, text, error):
    if text is not None:
        targets.write_text(text)
    with pytest.raises(error):
        roll_out(registry, target, targets, {})


@pytest.fixture
def said(capsys):
    """Run a command line: everything that it printed."""

    def call(*words):
        capsys.readouterr()
        run([str(word) for word in words])
        printed = "".join(capsys.readouterr())
        assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", printed), repr(printed)
        return printed.replace("\n", "")

    return call


def test_fleet_hostile_rows_are_shown_as_text(registry, row, targets, said):
    named = {name: f"{name}{HOSTILE}" for name in ("camera", "lidar", "status", "cause", "detail")}
    hostile = row(robot=f"r1{HOSTILE}", date=f"2026{HOSTILE}", verdict=None, **named)
    registry.write_table(as_table([hostile, row(robot=f"r2{HOSTILE}", verdict=f"pass{HOSTILE}")]))
    place = ("--registry", registry.place.url)
    assert SHOWN in said("fleet", "table", *place)
    assert SHOWN in said("fleet", "table", *place, "--columns", "robot,cause,detail")
    said("fleet", "table", *place, "--json")
    said("fleet", "table", *place, "--where", f"robot = '{HOSTILE}' and")
    said("fleet", "report", *place, "-o", targets.parent / "report.html")
    rollout = (*place, "--target", "nav", "--targets", targets)
    assert SHOWN in said("fleet", "deploy", *rollout, "--dry-run")
    assert SHOWN in said("fleet", "deploy", *rollout)


@pytest.mark.usefixtures("whole")
def test_deploy_hostile_record_is_shown_as_text(targets, said):
    printing = r"printf '\\033]0;x\\007\\033[2J\\r\\n'"
    targets.write_text(re.sub('run: ".*?"', f'run: "{printing}"', targets.read_text()))
    place = targets.parent
    rollout = ("--registry", place / "registry", "--target", "nav", "--targets", targets)
    said("fleet", "deploy", *rollout, "--where", "robot = 'r1'")
    status = ("deploy", place, "--target", "nav", "--targets", targets, "--robot", "r1", "--status")
    assert "r1" in said(*status)
    for file in (place / "robots/r1/calib").rglob(".deployed.json"):
        file.chmod(0o644)
        record = json.loads(file.read_text())
        record |= {name: f"{record[name]}{HOSTILE}" for name in ("by", "robot", "date", "reason")}
        file.write_text(json.dumps(record))
    assert SHOWN in said(*status)
    said(*status[:-1], "--dry-run")
