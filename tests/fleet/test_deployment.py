"""Deployments: a whole set or the earlier one, refused where it must be, and back byte for byte."""

import contextlib
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from lce_rig.core.errors import CommandError, ResultRefusedError, TargetError
from lce_rig.fleet.deployment import deploy, plan, rollback, standing
from lce_rig.fleet.place import RECORD, Place
from lce_rig.fleet.releases import content_of, set_sha256
from lce_rig.fleet.target import TargetSettings
from tests.fleet.conftest import ORIGIN, log_of

Result = Callable[..., Path]
FILES = {"camera_info_davis.yaml", "extrinsics.yaml", "result.json", "rles.urdf", "static_transforms.txt"}


def codes(planned):
    return [finding.code for finding in planned.objections]


def with_settings(target, **changes):
    return TargetSettings.model_validate(target.model_dump() | changes)


def test_deploy_and_rollback_are_exact(result, rig, target, robot):
    folder = result("a")
    first = deploy(folder, rig, target)
    assert first.is_new and first.replaces == "" and first.output is None
    deployed = content_of(robot / "current")
    assert set(deployed) >= FILES and deployed == first.release.files
    assert (robot / "current" / "result.json").read_bytes() == (folder / "result.json").read_bytes()
    second = deploy(result("b", 0.15), rig, target)
    assert second.replaces == first.release.name and content_of(robot / "current") != deployed
    found = standing(target)
    assert found.current == second.release and not found.changed
    assert [each.name for each in found.releases] == [second.release.name, first.release.name]
    back = rollback(target, reason="better")
    assert back.release == first.release and content_of(robot / "current") == deployed
    assert [(entry["action"], entry["release"]) for entry in log_of(robot)] == [
        ("deploy", first.release.name),
        ("deploy", second.release.name),
        ("rollback", first.release.name),
    ]
    assert log_of(robot)[-1]["reason"] == "better"
    with pytest.raises(TargetError):
        rollback(target)
    assert rollback(target, second.release.name).release == second.release


def test_the_same_files_are_deployed_once(result, rig, local, robot):
    folder = result("a")
    first = deploy(folder, rig, local)
    again = deploy(folder, rig, local)
    assert not again.is_new and again.release == first.release
    assert len(list((robot / "releases").iterdir())) == 1
    # Also if a file there was changed: then it is deployed again.
    (robot / "current" / "extrinsics.yaml").write_text("mine")
    assert standing(local).changed == {"extrinsics.yaml": "changed"}
    assert plan(folder, rig, local).state.changed == {"extrinsics.yaml": "changed"}
    anew = deploy(folder, rig, local)
    assert anew.is_new and anew.changed_there == {"extrinsics.yaml": "changed"}
    assert standing(local).changed == {} and not deploy(folder, rig, local).changed_there
    with pytest.raises(TargetError, match=r"extrinsics\.yaml"):
        rollback(local)


def test_deploy_dry_run_changes_nothing(result, rig, target, robot):
    planned = plan(result("a"), rig, target)
    assert planned.state.current is None and not robot.exists()
    (change,) = planned.sensors
    assert (change.rotation_deg, change.is_new) == (None, True)
    assert planned.changed == dict.fromkeys(planned.record.files, "added")
    deploy(result("b"), rig, target)
    before = {path: path.stat().st_mtime_ns for path in robot.rglob("*")}
    planned = plan(result("c", 0.15), rig, target)
    (change,) = planned.sensors
    assert (change.rotation_deg, change.translation_m) == pytest.approx((0, 0.03), abs=1e-9)
    assert set(planned.changed.values()) == {"changed"} and "result.json" in planned.changed
    assert {path: path.stat().st_mtime_ns for path in robot.rglob("*")} == before


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"verdict": "fail"}, "deploy.failed"),
        ({"origin": replace(ORIGIN, robot="heron")}, "deploy.other_robot"),
        ({"origin": replace(ORIGIN, robot="")}, "deploy.no_robot"),
        ({"verdict": "marginal"}, "deploy.worse"),
        ({"x_m": 0.12 + 0.061}, "deploy.moved"),
        ({"rig_name": "rlfs"}, "deploy.other_rig"),
        ({"origin": replace(ORIGIN, serials={"lidar": "AG2"})}, "deploy.other_serial"),
        ({"origin": replace(ORIGIN, date="2026-11-19T10:22:03Z")}, "deploy.older"),
    ],
)
def test_deploy_unfit_result_needs_a_reason(result, rig, local, robot, changes, code):
    deploy(result("a"), rig, local)
    before = content_of(robot / "current")
    folder = result("b", **changes)
    assert codes(plan(folder, rig, local)) == [code]
    with pytest.raises(ResultRefusedError):
        deploy(folder, rig, local)
    assert content_of(robot / "current") == before
    forced = deploy(folder, rig, local, reason="new LiDAR").release
    assert standing(local).current == forced
    assert (forced.forced, forced.reason) == ([code], "new LiDAR")
    assert (log_of(robot)[-1]["forced"], log_of(robot)[-1]["reason"]) == ([code], forced.reason)


def test_deploy_refuses_result_of_other_or_unnamed_robot(result, rig, local):
    named = with_settings(local, robot="heron")
    assert codes(plan(result("a"), rig, named)) == ["deploy.other_robot"]
    unknown = result("b", origin=replace(ORIGIN, robot="", serials={}, date=None, session_sha256=""))
    assert codes(plan(unknown, rig, named)) == ["deploy.no_robot"]
    assert codes(plan(unknown, rig, local)) == []
    deploy(unknown, rig, local)
    dated = plan(result("c"), rig, local)
    assert codes(dated) == []
    assert [finding.code for finding in dated.remarks] == ["deploy.undated"]
    assert deploy(result("e"), rig, local).remarks == dated.remarks
    assert plan(result("d", 0.1), rig, local).remarks == ()


def test_deploy_announces_movement_and_verdict_first(result, rig, local):
    deploy(result("a", verdict="marginal"), rig, local)
    announced = []
    with pytest.raises(ResultRefusedError, match=r"would move by .* 80 mm \(limit"):
        deploy(result("b", 0.2), rig, local, announce=announced.append)
    (change,) = announced[0].sensors
    assert (change.verdict_there, change.verdict) == ("marginal", "pass")
    assert change.translation_m == pytest.approx(0.08)


def test_formats_are_chosen(result, rig, local, robot):
    deploy(result("a"), rig, with_settings(local, formats=["urdf"]))
    assert set(content_of(robot / "current")) == {"result.json", "rles.urdf"}


def test_deploy_failed_command_runs_again(result, rig, target, robot):
    folder = result("a")
    failing = with_settings(target, run="ls rles.urdf; echo not today >&2; test -e ../../ready || exit 3")
    with pytest.raises(CommandError, match="3") as caught:
        deploy(folder, rig, failing)
    assert "rles.urdf" in caught.value.hint and "not today" in caught.value.hint
    found = standing(failing)
    assert found.is_pending and not found.changed
    (robot / "ready").touch()
    again = deploy(folder, rig, failing)
    assert not again.is_new and "not today" in (again.output or "")
    assert not standing(failing).is_pending
    assert deploy(folder, rig, failing).output is None
    assert [entry.get("exit") for entry in log_of(robot)] == [None, 3, 0]


class Meanwhile(Place):
    """A place at which something happens once new files have been copied."""

    def __init__(self, target, happens):
        super().__init__(target)
        self._happens = happens

    def put(self, folder, name):
        super().put(folder, name)
        self._happens(Path(self.path) / name)


def test_concurrent_deployment_is_refused(result, rig, local, robot):
    deploy(result("a"), rig, local)
    folder, other = result("b", 0.15), result("c", 0.16)

    with pytest.raises(TargetError):
        deploy(folder, rig, local, place=Meanwhile(local, lambda _: deploy(other, rig, local)))
    assert (robot / "current" / "result.json").read_bytes() == (other / "result.json").read_bytes()
    assert sorted(entry.name for entry in robot.glob(".*")) == [".lock"]


def test_deploy_damaged_files_are_refused(result, rig, local, robot):
    """The earlier release stays current."""
    first = deploy(result("a"), rig, local).release

    def damage(draft):
        (draft / "rles.urdf").write_text("")

    with pytest.raises(TargetError, match=r"rles\.urdf"):
        deploy(result("b", 0.15), rig, local, place=Meanwhile(local, damage))
    assert standing(local).current == first
    deploy(result("c", 0.16), rig, local)
    assert sorted(entry.name for entry in robot.glob(".*")) == [".lock"]


LOST = "releases/20260101T000000Z-00000000"


def tree(folder):
    """List everything below a folder, with contents and targets of links."""
    return {
        str(path): str(path.readlink())
        if path.is_symlink()
        else path.read_bytes()
        if path.is_file()
        else None
        for path in sorted(folder.rglob("*"))
    }


@pytest.mark.parametrize(
    "way",
    [
        "mkdir -p robot/current && echo mine >robot/current/mine.yaml",
        "mkdir -p robot/theirs && ln -s theirs robot/current",
        "mkdir -p robot elsewhere && ln -s ../elsewhere robot/releases",
        "mkdir -p robot && echo mine >robot/releases",
        "mkdir -p robot/releases/v1 robot/releases/v2 && ln -s releases/v2 robot/current",
        "mkdir -p robot/releases/v1 && echo mine >robot/releases/v1/mine.yaml",
        f"mkdir -p robot/{LOST} && ln -s {LOST} robot/current",
        "mkdir -p robot && ln -s /dev/zero robot/.pending",
        "mkdir -p robot && mkfifo robot/deployments.log",
    ],
)
def test_deploy_foreign_folder_is_refused(result, rig, local, tmp_path, way):
    folder = result("a")
    subprocess.run(["sh", "-c", way], cwd=tmp_path, check=True)
    before = tree(tmp_path)
    for call in (lambda: deploy(folder, rig, local), lambda: standing(local), lambda: rollback(local)):
        with pytest.raises(TargetError):
            call()
    assert tree(tmp_path) == before


def test_deploy_removes_own_releases_only(result, rig, local, robot):
    """Only after the switch."""
    few = with_settings(local, keep=2)
    first = deploy(result("a"), rig, few).release
    others = ["golden", "20260101T000000Z-00000000", "20260101T000000Z-0000000", "notes.txt"]
    for name in others:
        (robot / "releases" / name).mkdir()
        (robot / "releases" / name / "mine.yaml").write_text("mine")
    # As an interrupted deployment leaves it: named and recorded, and never current.
    lost = robot / "releases" / "20260101T000000Z-11111111"
    shutil.copytree(robot / "releases" / first.name, lost, ignore=shutil.ignore_patterns(".used"))
    before = tree(robot)
    with pytest.raises(ResultRefusedError):
        deploy(result("failed", 0.13, verdict="fail"), rig, few)
    assert tree(robot) == before
    assert [release.name for release in standing(few).releases] == [first.name]
    names = [deploy(result(f"{k}", 0.16 + 0.01 * k), rig, few).release.name for k in range(3)]
    assert sorted(path.name for path in (robot / "releases").iterdir()) == sorted([*others, *names[1:]])


def test_deploy_rollback_keeps_previous(result, rig, local, robot):
    few = with_settings(local, keep=2)
    first, _ = (deploy(result(name, x_m), rig, few).release for name, x_m in (("a", 0.1), ("b", 0.12)))
    rollback(few)
    third = deploy(result("c", 0.14), rig, few).release
    assert [release.name for release in standing(few).releases] == [third.name, first.name]
    assert rollback(few).release == first


def test_deploy_clock_set_back_keeps_order(result, rig, local, robot):
    early = deploy(result("a"), rig, local).release
    late = early.model_copy(update={"name": f"20990101T000000Z-{early.name[-8:]}"})
    (robot / "releases" / early.name).rename(robot / "releases" / late.name)
    (robot / "releases" / late.name / RECORD).write_text(late.line())
    (robot / "current").unlink()
    (robot / "current").symlink_to(f"releases/{late.name}")
    new = deploy(result("b", 0.15), rig, local).release
    assert new.name > late.name and new.replaces == late.name
    assert standing(local).releases == (new, late)


TOOLS = ("cat", "flock", "head", "ln", "mkdir", "mv", "readlink", "rm", "sync")


class Toolless(Place):
    """A robot without flock and timeout."""

    tools: Path

    def command(self, script, *arguments):
        return ["env", f"PATH={self.tools}", *super().command(script, *arguments)]


def test_a_robot_without_flock_is_deployed_to(result, rig, local, robot, tmp_path):
    place = Toolless(with_settings(local, run="true"))
    place.tools = tmp_path / "tools"
    place.tools.mkdir()
    for name in ("sh", *TOOLS, "cut", "du", "find", "tail", "true"):
        if name != "flock":
            (place.tools / name).symlink_to(str(shutil.which(name)))
    for name, x_m in (("a", 0.1), ("b", 0.12)):
        assert deploy(result(name, x_m), rig, with_settings(local, run="true"), place=place).is_new
    assert not (robot / ".lock").exists() and not standing(local).changed


def test_deploy_link_to_device_is_replaced(result, rig, target, robot):
    deploy(result("a"), rig, target)
    (robot / "current" / "extrinsics.yaml").unlink()
    (robot / "current" / "extrinsics.yaml").symlink_to("/dev/zero")
    assert list(standing(target).changed) == ["extrinsics.yaml"]
    assert deploy(result("b", 0.15), rig, target).is_new and not standing(target).changed
    with pytest.raises(TargetError):
        rollback(target)


@pytest.mark.realtime
@pytest.mark.long
def test_deploy_command_output_and_time_are_limited(result, rig, target):
    endless = with_settings(target, run="yes", run_timeout_s=2)
    with pytest.raises(CommandError) as caught:
        deploy(result("a"), rig, endless)
    assert len(str(caught.value)) < 10_000
    assert standing(endless).is_pending


def test_the_command_gets_the_robot_as_an_argument(result, rig, local):
    named = with_settings(local, robot="kestrel", run='echo "for $1"')
    assert deploy(result("a"), rig, named).output == "for kestrel\n"


class Failing(Place):
    """A place where the shell is killed before it starts its n-th program; nothing is flushed."""

    def __init__(self, target, tools, n):
        super().__init__(target)
        self._tools = tools
        shutil.rmtree(tools, ignore_errors=True)
        tools.mkdir()
        for name in TOOLS:
            wrapper = tools / name
            wrapper.write_text(
                f"#!/bin/sh\necho >>{tools}/count\n"
                f'[ "$(/usr/bin/wc -l <{tools}/count)" -eq {n} ] && kill -9 $PPID && exit 1\n'
                + ("exit 0\n" if name == "sync" else f'exec {shutil.which(name)} "$@"\n')
            )
            wrapper.chmod(0o755)

    def command(self, script, *arguments):
        return ["env", f"PATH={self._tools}:/usr/bin:/bin", *super().command(script, *arguments)]


@pytest.mark.long
def test_deploy_killed_shell_leaves_one_set(result, rig, local, robot, tmp_path):
    settings = with_settings(local, keep=2, formats=["urdf"])
    folders = [result("a"), result("b", 0.15)]
    sound = Failing(settings, tmp_path / "sound", 0)
    for folder in (*folders, folders[0]):
        deploy(folder, rig, settings, place=sound)
    sets = {set_sha256(standing(settings).releases[k].files) for k in (0, 1)}
    n_new = n_old = 0
    for n in range(1, 100):
        before = content_of(robot / "current")
        place = Failing(settings, tmp_path / "tools", n)
        with contextlib.suppress(TargetError):
            deploy(folders[1], rig, settings, place=place)
        found = content_of(robot / "current")
        assert set_sha256(found) in sets, f"step {n}"
        n_new, n_old = n_new + (found != before), n_old + (found == before)
        assert not standing(settings).changed
        if len((tmp_path / "tools" / "count").read_text()) < n:
            break
        deploy(folders[0], rig, settings, place=sound)
        assert content_of(robot / "current") == before
        assert {entry.name for entry in robot.glob(".*")} <= {".lock", ".current.new"}, f"step {n}"
    assert n > 15 and n_new > 2 and n_old > 2
    deploy(result("c", 0.16), rig, settings, place=sound)
    assert len(list((robot / "releases").glob(f"*/{RECORD}"))) == 2
