"""Deployments: a whole set or the earlier one, refused where it must be, and back byte for byte."""

import contextlib
import os
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from lce_rig.core.errors import CommandError, ResultRefusedError, SessionError, TargetError
from lce_rig.fleet.deploy import deployment, shell
from lce_rig.fleet.deploy.deployment import deploy, plan, rollback, standing
from lce_rig.fleet.deploy.place import LocalPlace, Ran
from lce_rig.fleet.deploy.releases import content_of, set_sha256
from lce_rig.rig import Rig
from lce_rig.rig.target_settings import TargetSettings
from tests.fleet.deploy.conftest import ORIGIN, log_of

Result = Callable[..., Path]
FILES = {"camera_info_davis.yaml", "extrinsics.yaml", "result.json", "rles.urdf", "static_transforms.txt"}


def codes(planned: deployment.Plan) -> list[str]:
    return [finding.code for finding in planned.objections]


def with_settings(target: TargetSettings, **changes: object) -> TargetSettings:
    return TargetSettings.model_validate(target.model_dump() | changes)


def test_a_result_is_deployed_asked_for_replaced_and_restored_byte_for_byte(
    result: Result, rig: Rig, target: TargetSettings, robot: Path
) -> None:
    folder = result("a")
    first = deploy(folder, rig, target)
    assert first.is_new and first.replaces == "" and first.output is None
    deployed = content_of(robot / "current")
    assert set(deployed) >= FILES and deployed == first.release.files
    assert (robot / "current" / "result.json").read_bytes() == (folder / "result.json").read_bytes()
    second = deploy(result("b", 0.15), rig, target)
    assert second.replaces == first.release.name and content_of(robot / "current") != deployed
    found = standing(target)
    assert found.state.current == second.release and not found.changed
    assert [each.name for each in found.state.releases] == [second.release.name, first.release.name]
    back = rollback(target, reason="it was better")
    assert back.release == first.release and content_of(robot / "current") == deployed
    assert [(entry["action"], entry["release"]) for entry in log_of(robot)] == [
        ("deploy", first.release.name),
        ("deploy", second.release.name),
        ("rollback", first.release.name),
    ]
    assert log_of(robot)[-1]["reason"] == "it was better"
    with pytest.raises(TargetError, match="is the first"):
        rollback(target)
    assert rollback(target, second.release.name).release == second.release


def test_the_same_files_are_deployed_once(
    result: Result, rig: Rig, local: TargetSettings, robot: Path
) -> None:
    folder = result("a")
    first = deploy(folder, rig, local)
    again = deploy(folder, rig, local)
    assert not again.is_new and again.release == first.release
    assert len(list((robot / "releases").iterdir())) == 1
    # Also where somebody has changed a file there: then it is deployed anew.
    (robot / "current" / "extrinsics.yaml").write_text("mine")
    assert standing(local).changed == {"extrinsics.yaml": "changed"}
    assert plan(folder, rig, local).changed_there == {"extrinsics.yaml": "changed"}
    anew = deploy(folder, rig, local)
    assert anew.is_new and anew.changed_there == {"extrinsics.yaml": "changed"}
    assert standing(local).changed == {} and not deploy(folder, rig, local).changed_there
    with pytest.raises(TargetError, match=r"not as it was deployed: extrinsics\.yaml changed"):
        rollback(local)


def test_a_dry_run_gives_degrees_millimetres_and_lines_and_changes_nothing(
    result: Result, rig: Rig, target: TargetSettings, robot: Path
) -> None:
    planned = plan(result("a"), rig, target)
    assert planned.state.current is None and not robot.exists()
    (change,) = planned.sensors
    assert (change.moved, change.is_new) == (None, True)
    assert planned.text == tuple(f"{name}: new" for name in sorted(planned.record.files))
    deploy(result("b"), rig, target)
    before = {path: path.stat().st_mtime_ns for path in robot.rglob("*")}
    planned = plan(result("c", 0.15), rig, target)
    (change,) = planned.sensors
    assert change.moved == pytest.approx((0, 0.03), abs=1e-9)
    assert set(planned.changed.values()) == {"changed"} and "result.json" in planned.changed
    assert {"--- deployed/rles.urdf", "+++ new/rles.urdf"} <= set(planned.text)
    assert {path: path.stat().st_mtime_ns for path in robot.rglob("*")} == before


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"verdict": "fail"}, "deploy.failed"),
        ({"origin": replace(ORIGIN, robot="heron")}, "deploy.other_robot"),
        ({"origin": replace(ORIGIN, serials={"lidar": "AG2"})}, "deploy.other_serial"),
        ({"origin": replace(ORIGIN, date="2026-11-19T10:22:03Z")}, "deploy.older"),
    ],
)
def test_what_does_not_belong_there_is_refused_unless_a_reason_is_written_down(
    result: Result, rig: Rig, local: TargetSettings, robot: Path, changes: dict[str, object], code: str
) -> None:
    deploy(result("a"), rig, local)
    before = content_of(robot / "current")
    folder = result("b", **changes)
    assert codes(plan(folder, rig, local)) == [code]
    with pytest.raises(ResultRefusedError):
        deploy(folder, rig, local)
    assert content_of(robot / "current") == before
    forced = deploy(folder, rig, local, reason="the LiDAR was replaced").release
    assert standing(local).state.current == forced
    assert (forced.forced, forced.reason) == ([code], "the LiDAR was replaced")
    assert (log_of(robot)[-1]["forced"], log_of(robot)[-1]["reason"]) == ([code], forced.reason)


def test_the_target_may_name_its_robot_and_what_nothing_tells_is_no_objection(
    result: Result, rig: Rig, local: TargetSettings
) -> None:
    named = with_settings(local, robot="heron")
    assert codes(plan(result("a"), rig, named)) == ["deploy.other_robot"]
    unknown = result("b", origin=replace(ORIGIN, robot="", serials={}, date=""))
    assert codes(plan(unknown, rig, named)) == []
    deploy(unknown, rig, named)
    assert codes(plan(result("c"), rig, local)) == []


def test_formats_and_further_files_are_chosen(
    result: Result, rig: Rig, local: TargetSettings, robot: Path
) -> None:
    folder = result("a")
    (folder / "report.html").write_text("<html>")
    (folder / "plots").mkdir()
    (folder / "plots" / "a.svg").write_text("<svg/>")
    deploy(folder, rig, with_settings(local, formats=["urdf"], files=["report.*", "plots"]))
    assert set(content_of(robot / "current")) == {"result.json", "rles.urdf", "report.html", "plots/a.svg"}
    with pytest.raises(SessionError, match=r"no file none\.txt"):
        deploy(folder, rig, with_settings(local, files=["none.txt"]))
    (folder / "way-out").symlink_to("/etc/hostname")
    with pytest.raises(SessionError, match="no file way-out"):
        deploy(folder, rig, with_settings(local, files=["way-out"]))


def test_a_command_that_fails_is_told_with_output_and_code_and_runs_again(
    result: Result, rig: Rig, target: TargetSettings, robot: Path
) -> None:
    folder = result("a")
    failing = with_settings(target, run="ls rles.urdf; echo not today >&2; test -e ../../ready || exit 3")
    with pytest.raises(CommandError, match="ended with 3") as caught:
        deploy(folder, rig, failing)
    assert "rles.urdf" in caught.value.hint and "not today" in caught.value.hint
    found = standing(failing)
    assert found.state.is_pending and not found.changed
    (robot / "ready").touch()
    again = deploy(folder, rig, failing)
    assert not again.is_new and "not today" in (again.output or "")
    assert not standing(failing).state.is_pending
    assert deploy(folder, rig, failing).output is None
    assert [entry.get("exit") for entry in log_of(robot)] == [None, 3, 0]


def test_so_many_releases_are_kept(result: Result, rig: Rig, local: TargetSettings, robot: Path) -> None:
    few = with_settings(local, keep=2)
    names = [deploy(result(f"{k}", 0.1 + 0.01 * k), rig, few).release.name for k in range(4)]
    assert [each.name for each in standing(few).state.releases] == [names[3], names[2]]
    rollback(few)
    deploy(result("new", 0.2), rig, few)
    # The one that it replaced stays, old as it is.
    assert names[2] in {each.name for each in standing(few).state.releases}


def test_releases_are_in_order_even_if_the_clock_was_set_back(
    result: Result, rig: Rig, local: TargetSettings, robot: Path
) -> None:
    first = deploy(result("a"), rig, local).release
    later = "20990101T000000Z" + first.name[16:]
    (robot / "releases" / first.name).rename(robot / "releases" / later)
    record = robot / "releases" / later / shell.RECORD
    record.write_text(record.read_text().replace(first.name, later))
    (robot / "current").unlink()
    (robot / "current").symlink_to(f"releases/{later}")
    second = deploy(result("b", 0.15), rig, local).release
    assert second.name[:16] == "20990101T000001Z" and standing(local).state.releases[0] == second


class Meanwhile(LocalPlace):
    """A place at which something happens once new files have been copied."""

    def __init__(self, path: str, happens: Callable[[Path], object]) -> None:
        super().__init__(path)
        self._happens = happens

    def put(self, folder: Path, name: str) -> None:
        super().put(folder, name)
        self._happens(Path(self.path) / name)


def test_of_two_deployments_at_once_one_is_refused(
    result: Result, rig: Rig, local: TargetSettings, robot: Path
) -> None:
    deploy(result("a"), rig, local)
    folder, other = result("b", 0.15), result("c", 0.2)

    with pytest.raises(TargetError):
        deploy(folder, rig, local, place=Meanwhile(str(robot), lambda _: deploy(other, rig, local)))
    assert (robot / "current" / "result.json").read_bytes() == (other / "result.json").read_bytes()
    assert sorted(entry.name for entry in robot.glob(".*")) == [".lock"]


def test_files_that_the_disk_does_not_give_back_are_not_made_current(
    result: Result, rig: Rig, local: TargetSettings, robot: Path
) -> None:
    first = deploy(result("a"), rig, local).release

    def damage(draft: Path) -> None:
        (draft / "rles.urdf").write_text("")

    with pytest.raises(TargetError, match=r"read back differently: rles\.urdf changed"):
        deploy(result("b", 0.15), rig, local, place=Meanwhile(str(robot), damage))
    assert standing(local).state.current == first
    deploy(result("c", 0.2), rig, local)
    assert sorted(entry.name for entry in robot.glob(".*")) == [".lock"]


def test_a_full_disk_leaves_the_earlier_set_and_the_next_deployment_clears_it(
    result: Result, rig: Rig, local: TargetSettings, robot: Path
) -> None:
    robot.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=160k", "none", str(robot)], check=False)
    if mounted.returncode:
        pytest.skip("no file system may be mounted here")
    try:
        first = deploy(result("a"), rig, local)
        large = result("b", 0.15)
        (large / "large.bin").write_bytes(os.urandom(400_000))
        with pytest.raises(TargetError, match="No space left"):
            deploy(large, rig, with_settings(local, files=["large.bin"]))
        assert standing(local).state.current == first.release and not standing(local).changed
        assert list(robot.glob(".new-*")), "nothing was left that could be cleared"
        deploy(result("c", 0.2), rig, local)
        assert not list(robot.glob(".new-*"))
    finally:
        subprocess.run(["umount", str(robot)], check=True)


def test_what_is_in_the_links_place_is_not_touched(
    result: Result, rig: Rig, local: TargetSettings, robot: Path
) -> None:
    (robot / "current").mkdir(parents=True)
    (robot / "current" / "mine.yaml").write_text("mine")
    with pytest.raises(TargetError, match="is no link"):
        deploy(result("a"), rig, local)
    assert (robot / "current" / "mine.yaml").read_text() == "mine"


def test_a_release_that_never_was_current_is_removed(
    result: Result, rig: Rig, local: TargetSettings, robot: Path
) -> None:
    deploy(result("a"), rig, local)
    # As a computer leaves it that is switched off between the two last steps.
    lost = robot / "releases" / "20260101T000000Z-00000000"
    lost.mkdir()
    (lost / "rles.urdf").write_text("")
    assert len(standing(local).state.releases) == 1
    deploy(result("b", 0.15), rig, local)
    assert not lost.exists()


def run_without_flock(robot: Path, tools: Path, *arguments: str) -> Ran:
    """Run the last step as a system without flock would."""
    if not tools.exists():
        tools.mkdir()
        for name in ("sh", "cat", "ln", "ls", "mkdir", "mv", "rm", "sleep", "sync"):
            found = subprocess.run(["which", name], capture_output=True, text=True, check=True).stdout.strip()
            (tools / name).symlink_to(found)
    words = ["sh", "-c", shell.COMMIT, "sh", str(robot), *arguments]
    done = subprocess.run(words, capture_output=True, text=True, check=False, env={"PATH": str(tools)})
    return Ran(done.returncode, done.stdout, done.stderr)


def test_where_flock_is_missing_a_folder_is_the_lock_and_a_dead_holders_is_taken_over(
    result: Result, rig: Rig, local: TargetSettings, robot: Path, tmp_path: Path
) -> None:
    names = [deploy(result(f"{k}", 0.1 + 0.01 * k), rig, local).release.name for k in range(2)]
    again = ("", names[0], names[1], "10", "", "{}")
    tools = tmp_path / "tools"
    assert run_without_flock(robot, tools, *again).code == 0
    assert run_without_flock(robot, tools, *again).code == shell.CHANGED
    (robot / ".lock.d").mkdir()
    (robot / ".lock.d" / "owner").write_text("another-boot 1\n")
    back = ("", names[1], names[0], "10", "", "{}")
    assert run_without_flock(robot, tools, *back).code == 0
    assert not (robot / ".lock.d").exists()


TOOLS = ("cat", "flock", "ln", "ls", "mkdir", "mv", "rm", "sync")


class Failing(LocalPlace):
    """A place where the shell is killed before it starts its n-th program; flushing is left out."""

    def __init__(self, path: str, tools: Path, n: int) -> None:
        super().__init__(path)
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

    def command(self, script: str, *arguments: str) -> list[str]:
        return ["env", f"PATH={self._tools}:/usr/bin:/bin", *super().command(script, *arguments)]


@pytest.mark.long
def test_a_target_whose_shell_is_killed_at_any_step_has_one_whole_set(
    result: Result, rig: Rig, local: TargetSettings, robot: Path, tmp_path: Path
) -> None:
    settings = with_settings(local, keep=2, formats=["urdf"])
    folders = [result("a"), result("b", 0.15)]
    sound = Failing(str(robot), tmp_path / "sound", 0)
    for folder in (*folders, folders[0]):
        deploy(folder, rig, settings, place=sound)
    sets = {set_sha256(standing(settings).state.releases[k].files) for k in (0, 1)}
    n_new = n_old = 0
    for n in range(1, 100):
        before = content_of(robot / "current")
        place = Failing(str(robot), tmp_path / "tools", n)
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
        assert {entry.name for entry in robot.glob(".*")} <= {".lock"}, f"step {n}"
        assert len(list((robot / "releases").iterdir())) <= 3
    assert n > 15 and n_new > 2 and n_old > 2


def test_a_set_is_known_by_what_sha256sum_prints(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("1")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "c.txt").write_text("2")
    (tmp_path / shell.RECORD).write_text("{}")
    lines = subprocess.run(["sha256sum", "a.txt", "b/c.txt"], capture_output=True, check=True, cwd=tmp_path)
    printed = subprocess.run(["sha256sum"], input=lines.stdout, capture_output=True, check=True).stdout
    assert set_sha256(content_of(tmp_path)) == printed.decode().split()[0]
