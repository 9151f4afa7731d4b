"""`lce-rig deploy`: put a result on a robot, show the deployed one, or roll back."""

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

import lce_rig as lce
from lce_rig.cli import show
from lce_rig.cli.options import json_option, path_option, result_option, session_argument
from lce_rig.core.errors import ResultRefusedError, UsageError
from lce_rig.core.phrasing import sizes
from lce_rig.fleet import deployment
from lce_rig.fleet.deployment import Deployed, Plan
from lce_rig.fleet.releases import ReleaseRecord, TargetState, differences_in_words, find_target
from lce_rig.fleet.target import TargetSettings
from lce_rig.pipeline.result_files import result_folder, with_profile_of


@click.command()
@session_argument
@click.option("--target", "target_name", required=True, metavar="NAME", help="Name the target.")
@path_option(
    "--targets",
    "FILE",
    "Read targets from this file [default: deploy.yaml beside SESSION].",
)
@result_option("Deploy")
@click.option("--robot", metavar="NAME", help="Name the robot, for a target shared by several robots.")
@click.option("--dry-run", is_flag=True, help="Print the changes; change nothing.")
@click.option("--diff", is_flag=True, help="With --dry-run: print the lines that would change.")
@click.option("--status", is_flag=True, help="Print the releases at the target; change nothing.")
@click.option("--rollback", is_flag=True, help="Restore the files of the previous release.")
@click.option("--release", metavar="NAME", help="With --rollback: restore this release (see --status).")
@click.option("--force", is_flag=True, help="Deploy against objections; requires --reason.")
@click.option("--reason", default="", metavar="TEXT", help="State the reason; it is logged at the target.")
@json_option
def deploy(
    session: Path,
    target_name: str,
    targets: Path | None,
    name: str | None,
    robot: str | None,
    dry_run: bool,
    diff: bool,
    status: bool,
    rollback: bool,
    release: str | None,
    force: bool,
    reason: str,
    as_json: bool,
) -> None:
    """Put the result of SESSION (default: session/) on a robot, all files at once.

    A target is a folder on this computer or USER@HOST:PATH, reached by OpenSSH without a prompt. Robot
    software reads PATH/current/. After the new files are read back, one rename makes them current; after any
    interruption, the robot has the earlier set or the new one. Earlier sets are kept.

    Refused with exit code 7: a failed result, another rig, another robot's name or serial numbers, captures
    older than those deployed, MARGINAL in place of PASS, and sensors that move by more than the tolerance of
    the profile's nominal extrinsics (default: 5 deg, 100 mm). Exits with 8 if the target was not
    reached or written and holds the earlier set, and with 9 if the command after it failed and the new set
    is in place.
    """
    if sum((dry_run, status, rollback)) > 1:
        raise UsageError("--dry-run, --status and --rollback exclude each other", "Give one of them.")
    if diff and not dry_run:
        raise UsageError("--diff applies to --dry-run only", "Add --dry-run.")
    if release is not None and not rollback:
        raise UsageError("--release applies to --rollback only", "Add --rollback.")
    if force and not reason.strip():
        raise UsageError("--force requires a reason", "Add --reason TEXT; it is written down at the target.")
    if reason and not (force or rollback):
        raise UsageError("--reason applies to --force and --rollback only", "Add one of them, or omit it.")

    again = show.command("deploy", session, f" --target {shlex.quote(target_name)}")
    again += "" if targets is None else f" --targets {shlex.quote(str(targets))}"
    again += "" if robot is None else f" --robot {shlex.quote(robot)}"
    target = find_target(target_name, targets, session, robot)
    if status or rollback:
        if status:
            _show_standing(deployment.standing(target), target, as_json=as_json)
        else:
            _show_done(deployment.rollback(target, release, reason=reason), target, again, as_json=as_json)
        return
    opened = with_profile_of(lce.Session.open(session), name)
    result = result_folder(opened.path, name)
    if dry_run:
        plan = deployment.plan(result, opened.rig, target, session=opened)
        _show_plan(plan, target, has_diff=diff, as_json=as_json)
        return
    if target.run is not None:
        show.note(f"afterwards there: {target.run}")

    def announce(plan: Plan) -> None:
        if plan.state.current is not None:
            _print_changes(plan, show.note)

    try:
        done = deployment.deploy(
            result, opened.rig, target, session=opened, reason=reason.strip(), announce=announce
        )
    except ResultRefusedError as error:
        forced = f"{again}{f' --name {name}' if name else ''} --force --reason TEXT"
        raise ResultRefusedError(
            error.what, f"{error.hint}\nTo deploy it nevertheless: `{forced}`"
        ) from error
    _show_done(done, target, again, as_json=as_json)


def _print_json(target: TargetSettings, **content: Any) -> None:
    show.print_json({"format_version": 1, "to": target.to, **content})


def _show_plan(plan: Plan, target: TargetSettings, *, has_diff: bool, as_json: bool) -> None:
    if as_json:
        _print_json(
            target,
            current=plan.state.current,
            new=plan.record,
            changed=dict(plan.changed),
            changed_there=dict(plan.state.changed),
            sensors=plan.sensors,
            objections=plan.objections,
            remarks=plan.remarks,
            **({"diff": plan.diff} if has_diff else {}),
        )
        return
    current = plan.state.current
    show.say(f"{target.to}: {'nothing deployed yet' if current is None else _described(current)}")
    _print_changes(plan, show.say)
    _warn_of_changes(plan.state.changed)
    if plan.is_in_place:
        show.say("nothing to change: these files are already in place")
    for how in dict.fromkeys(plan.changed.values()):
        names = [name for name, change in plan.changed.items() if change == how]
        show.say(f"  {_CHANGES.get(how, how)} {', '.join(names)}")
    for each in plan.remarks:
        show.note(each.text)
    for each in plan.objections:
        show.warn(f"would be refused: {each.text}")
    for line in plan.diff if has_diff else ():
        click.echo(show.harmless(line))


def _print_changes(plan: Plan, say: Callable[[str], None]) -> None:
    """Print each sensor's movement on a line, and its verdict if that changes."""
    for change in () if plan.is_in_place else plan.sensors:
        how = "new" if change.is_new else "removed"
        if change.rotation_deg is not None and change.translation_m is not None:
            how = f"moves by {sizes(change.rotation_deg, change.translation_m)}"
        if change.verdict and change.verdict_there not in ("", change.verdict):
            how += f", {change.verdict_there} becomes {change.verdict}"
        say(f"  {change.camera} and {change.lidar}: {how}")


_CHANGES = {"added": "new:", "missing": "removed:", "changed": "changed:"}


def _show_standing(state: TargetState, target: TargetSettings, *, as_json: bool) -> None:
    current = state.current
    if as_json:
        _print_json(
            target,
            current=current,
            changed_there=dict(state.changed),
            is_pending=state.is_pending,
            releases=state.releases,
        )
        return
    if current is None:
        show.say(f"{target.to}: nothing deployed yet")
        return
    show.say(f"{target.to}: {_described(current)}")
    rows = []
    for kept in state.releases:
        mark = " *" if kept.name == current.name else ""
        cells = (f"{kept.name}{mark}", kept.time, kept.by, kept.robot or "-", kept.date[:10] or "-")
        rows.append(map(show.escape, cells))
    headings = ("release", "deployed", "by", "robot", "captures of")
    show.print_table(show.plain_table("", *headings, rows=rows))
    _warn_of_changes(state.changed)
    for kept in state.releases:
        if kept.reason:
            show.note(f"{kept.name} was forced: {kept.reason}")
    if state.is_pending:
        show.warn("the command after the deployment has not succeeded; the same deployment runs it again")


def _warn_of_changes(changed: Any) -> None:
    if changed:
        show.warn(f"not as it was deployed: {differences_in_words(changed)}")


def _described(release: ReleaseRecord) -> str:
    verdicts = ", ".join(f"{pair} {verdict}" for pair, verdict in release.verdicts.items())
    robot = f"robot {release.robot}, " if release.robot else ""
    dated = f"captures of {release.date}, " if release.date else ""
    return f"{release.name} ({robot}{dated}{verdicts})"


def _show_done(done: Deployed, target: TargetSettings, again: str, *, as_json: bool) -> None:
    if as_json:
        content = {"current" if name == "release" else name: value for name, value in vars(done).items()}
        _print_json(target, **content)
        return
    for each in done.remarks:
        show.note(each.text)
    state = "in place" if done.is_new else "in place already"
    show.say(f"{target.to}: {_described(done.release)} {state}")
    if done.is_new and done.replaces == done.release.replaces != "":
        show.note(f"replaces {done.replaces}; to restore it: {again} --rollback")
    if done.changed_there:
        _warn_of_changes(done.changed_there)
        show.note(f"the changed files stay there in releases/{done.replaces}/")
    if done.output:
        show.say(done.output.rstrip())
