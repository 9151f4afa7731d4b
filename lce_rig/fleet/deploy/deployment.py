"""Deploy a result to a target, ask what is there, and go back.

`plan` says what would change and what speaks against it, `deploy` does it, `standing` asks, `rollback` makes
an earlier release current again. Each opens its own connections; nothing is kept between calls.
"""

import getpass
import json
import secrets
import shutil
import socket
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from pathlib import Path
from tempfile import TemporaryDirectory

from lce_rig.core.calibration import MADE_BY, ResultFile, read_result
from lce_rig.core.errors import CommandError, LceRigError, ResultRefusedError, SessionError, TargetError
from lce_rig.core.findings import Finding
from lce_rig.export import export_formats
from lce_rig.fleet.deploy.changes import RESULT, SensorChange, sensor_changes, text_changes
from lce_rig.fleet.deploy.place import LostError, Place, open_place
from lce_rig.fleet.deploy.releases import (
    ReleaseRecord,
    Standing,
    TargetState,
    content_of,
    differences,
    read_state,
    set_sha256,
    succeed,
    to_state,
)
from lce_rig.fleet.deploy.shell import CHANGED, COMMIT, PREPARE, RECORD, RUN, SAYS
from lce_rig.fleet.findings import DEPLOY_FAILED, DEPLOY_OLDER, DEPLOY_OTHER_ROBOT, DEPLOY_OTHER_SERIAL
from lce_rig.rig import Rig
from lce_rig.rig.target_settings import TargetSettings
from lce_rig.session import Session
from lce_rig.session.replacing import copy_over

_OTHER = "Another deployment came first: look at `--status`, then run the same command again."


@dataclass(frozen=True)
class Plan:
    """What a deployment would change.

    Attributes:
        record: of the release that would be made.
        state: of the target now.
        changed: files that differ from the current release's: "changed", "missing", "added".
        changed_there: current files that are not as they were deployed.
        sensors: how far the extrinsics differ.
        text: the lines that differ, as `diff -u` gives them; new and removed files by name.
        objections: what speaks against it; a deployment is refused unless it is forced.
    """

    record: ReleaseRecord
    state: TargetState
    changed: Mapping[str, str]
    changed_there: Mapping[str, str]
    sensors: tuple[SensorChange, ...]
    text: tuple[str, ...]
    objections: tuple[Finding, ...]

    @property
    def is_in_place(self) -> bool:
        """Whether the target holds these very files already."""
        return self.state.current is not None and not self.changed and not self.changed_there


@dataclass(frozen=True)
class Deployed:
    """What a deployment or a rollback did.

    Attributes:
        release: that is current now.
        replaces: the release that was current before; "" for the first.
        is_new: whether something changed; False if these very files were in place already.
        output: of the command that ran afterwards; None if none ran.
        changed_there: files of the earlier release that were not as they were deployed.
    """

    release: ReleaseRecord
    replaces: str
    is_new: bool
    output: str | None = None
    changed_there: Mapping[str, str] = field(default_factory=dict)


def plan(result: Path, rig: Rig, target: TargetSettings, *, session: Session | None = None) -> Plan:
    """Compare a result with what is at a target; nothing is changed there.

    Args:
        result: folder with its result.json.
        rig: the profile of the session.
        target: where to.
        session: with images and scans, for formats that show them.

    Raises:
        SessionError: there is no result.
        TargetError: the target cannot be reached or read.
    """
    place = open_place(target)
    state = read_state(place)
    with TemporaryDirectory(prefix="lce-rig-") as folder:
        return _plan(result, rig, target, session, place, state, Path(folder))


def deploy(
    result: Path,
    rig: Rig,
    target: TargetSettings,
    *,
    session: Session | None = None,
    reason: str = "",
    place: Place | None = None,
) -> Deployed:
    """Write the files of a result to a target, all at once, and run its command.

    If these very files are in place, only a command that has not succeeded yet runs. Whatever interrupts it,
    the target holds the earlier set or the new one.

    Args:
        result: folder with its result.json.
        rig: the profile of the session.
        target: where to.
        session: with images and scans, for formats that show them.
        reason: why it is deployed against objections; it is written down there.
        place: another way to the target's folder than the target's own.

    Raises:
        SessionError: there is no result.
        ResultRefusedError: there are objections and no reason.
        TargetError: the target cannot be reached or written, or another deployment came first.
        CommandError: the command failed; the new files are in place.
    """
    place = place or open_place(target)
    state = to_state(place, succeed(place, place.run(PREPARE)))
    with TemporaryDirectory(prefix="lce-rig-") as folder:
        planned = _plan(result, rig, target, session, place, state, Path(folder))
        if planned.objections and not reason:
            raise _refused(target, planned)
        record = planned.record
        if planned.is_in_place:
            assert state.current is not None
            output = _run(place, target, state.current.name) if state.is_pending else None
            return Deployed(state.current, state.current.replaces, False, output)
        if planned.objections:
            forced = sorted({each.code for each in planned.objections})
            record = record.model_copy(update={"reason": reason, "forced": forced})
        _write(place, target, record, Path(folder))
    output = _run(place, target, record.name)
    return Deployed(record, record.replaces, True, output, planned.changed_there)


def standing(target: TargetSettings) -> Standing:
    """Ask what is at a target, and whether its current files are as they were deployed.

    Raises:
        TargetError: it cannot be reached or read.
    """
    place = open_place(target)
    state = read_state(place)
    with TemporaryDirectory(prefix="lce-rig-") as folder:
        return Standing(state, _changed_there(place, state, Path(folder) / "deployed"))


def rollback(target: TargetSettings, name: str | None = None, *, reason: str = "") -> Deployed:
    """Make an earlier release current again, byte for byte, and run the target's command.

    Args:
        target: where.
        name: of the release; None takes the one that the current release replaced.
        reason: written down there.

    Raises:
        TargetError: there is none, its files are not as they were deployed, or the target cannot be reached.
        CommandError: the command failed; the earlier files are in place.
    """
    place = open_place(target)
    state = to_state(place, succeed(place, place.run(PREPARE)))
    if state.current is None:
        raise TargetError(f"{place.label}: nothing has been deployed", "Deploy a result first.")
    wanted = state.current.replaces if name is None else name
    release = state.named(wanted)
    if release is None:
        others = ", ".join(each.name for each in state.releases if each.name != state.current.name)
        hint = f"`--release NAME` restores another one: {others}" if others else "No other one is there."
        what = f"there is no release {wanted}" if wanted else "the current release is the first"
        raise TargetError(f"{place.label}: {what}", hint)
    with TemporaryDirectory(prefix="lce-rig-") as folder:
        place.get(f"releases/{release.name}", Path(folder) / "release")
        wrong = differences(content_of(Path(folder) / "release"), release.files)
    if wrong:
        told = ", ".join(f"{file} {how}" for file, how in wrong.items())
        raise TargetError(
            f"{place.label}: release {release.name} is not as it was deployed: {told}",
            "Name another release, or deploy its session again.",
        )
    replaces = state.current.name
    if release.name != replaces:
        _commit(place, target, release, "", replaces, _line("rollback", release, replaces, reason))
    return Deployed(release, replaces, release.name != replaces, _run(place, target, release.name))


def _plan(
    result: Path,
    rig: Rig,
    target: TargetSettings,
    session: Session | None,
    place: Place,
    state: TargetState,
    folder: Path,
) -> Plan:
    """Write the new files to folder/new, fetch the current ones to folder/deployed, and compare."""
    new, deployed = folder / "new", folder / "deployed"
    saved = _stage(result, rig, target, session, new)
    changed_there = _changed_there(place, state, deployed)
    files = content_of(new)
    changed = differences(files, {} if state.current is None else state.current.files)
    return Plan(
        _record(saved, files, state),
        state,
        changed,
        changed_there,
        tuple(sensor_changes(deployed, new)),
        tuple(text_changes(deployed, new, differences(files, content_of(deployed)))),
        tuple(_objections(saved, target, state.current)),
    )


def _stage(
    result: Path, rig: Rig, target: TargetSettings, session: Session | None, folder: Path
) -> ResultFile:
    """Write the files of the set: result.json, the exports, and what else the target names."""
    saved = read_result(result / RESULT)
    folder.mkdir()
    # Whether a failed result may be deployed is decided on with everything else that speaks against it.
    export_formats(saved.pairs, rig, folder, formats=target.formats, is_forced=True, session=session)
    shutil.copyfile(result / RESULT, folder / RESULT)
    for pattern in target.files:
        found = sorted(path for path in _matching(result, pattern) if not (folder / path.name).exists())
        if not found and not any(folder.glob(pattern)):
            raise SessionError(
                f"{result} has no file {pattern}", "Correct `files` of the target, or write the file first."
            )
        for path in found:
            copy_over(path, folder / path.name)
    return saved


def _matching(result: Path, pattern: str) -> list[Path]:
    with suppress(ValueError, NotImplementedError):
        # Of the folder itself, and nothing that a link leads to.
        return [path for path in result.glob(pattern) if path.parent == result and not path.is_symlink()]
    return []


def _record(saved: ResultFile, files: Mapping[str, str], state: TargetState) -> ReleaseRecord:
    time = datetime.now(timezone.utc).replace(microsecond=0)
    # In order of time, even if this computer's clock is behind that of who deployed before.
    newest = max((each.name[:16] for each in state.releases), default="")
    if f"{time:%Y%m%dT%H%M%SZ}" <= newest:
        time = datetime.strptime(newest, "%Y%m%dT%H%M%SZ").replace(tzinfo=timezone.utc) + timedelta(seconds=1)
    origin = saved.provenance
    return ReleaseRecord(
        name=f"{time:%Y%m%dT%H%M%SZ}-{set_sha256(files)[:8]}",
        time=f"{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%SZ}",
        by=_user(),
        made_by=MADE_BY,
        replaces="" if state.current is None else state.current.name,
        files=dict(files),
        robot=origin.robot,
        serials=dict(origin.serials),
        date=origin.date,
        session_sha256=origin.session_sha256,
        verdicts={f"{c.camera} and {c.lidar}": c.verdict for c in saved.pairs},
    )


def _user() -> str:
    with suppress(OSError, KeyError):
        return f"{getpass.getuser()}@{socket.gethostname()}"
    return ""


def _objections(saved: ResultFile, target: TargetSettings, current: ReleaseRecord | None) -> list[Finding]:
    """Find what speaks against a deployment."""
    origin = saved.provenance
    found = [DEPLOY_FAILED(f"{c.camera} and {c.lidar}") for c in saved.pairs if c.verdict == "fail"]
    robots = {robot for robot in (target.robot, None if current is None else current.robot) if robot}
    for robot in sorted(robots - {origin.robot}) if origin.robot else ():
        found.append(DEPLOY_OTHER_ROBOT(robot=origin.robot, there=robot))
    if current is None:
        return found
    for sensor, serial in sorted(origin.serials.items()):
        there = current.serials.get(sensor, serial)
        if there != serial:
            found.append(DEPLOY_OTHER_SERIAL(sensor, serial=serial, there=there))
    if origin.date and current.date and origin.date < current.date:
        found.append(DEPLOY_OLDER(date=origin.date, there=current.date))
    return found


def _refused(target: TargetSettings, planned: Plan) -> ResultRefusedError:
    told = "; ".join(each.text for each in planned.objections)
    advice = [text for each in planned.objections if (text := each.advice)]
    hint = "\n".join([*dict.fromkeys(advice), "To deploy it nevertheless: --force --reason TEXT"])
    return ResultRefusedError(f"not deployed to {target.to}: {told}", hint)


def _changed_there(place: Place, state: TargetState, folder: Path) -> dict[str, str]:
    """Fetch the current files, and find those that are not as they were deployed."""
    if state.current is None:
        folder.mkdir()
        return {}
    place.get(f"releases/{state.current.name}", folder)
    return differences(content_of(folder), state.current.files)


def _write(place: Place, target: TargetSettings, record: ReleaseRecord, folder: Path) -> None:
    """Copy the new files, read them back, and make them current."""
    number = secrets.token_hex(4)
    (folder / "new" / RECORD).write_text(record.line(), encoding="utf-8")
    place.put(folder / "new", f".new-{number}")
    try:
        place.get(f".new-{number}", folder / "back")
        wrong = differences(content_of(folder / "back"), record.files)
    except LostError:
        raise
    except TargetError as error:
        raise TargetError(f"{place.label}: new files cannot be read back: {error.what}", _OTHER) from error
    if wrong or (folder / "back" / RECORD).read_bytes() != (folder / "new" / RECORD).read_bytes():
        told = ", ".join(f"{file} {how}" for file, how in wrong.items()) or RECORD
        raise TargetError(f"{place.label}: files read back differently: {told}", "Check the disk there.")
    _commit(place, target, record, number, record.replaces, _line("deploy", record, record.replaces))


def _commit(
    place: Place, target: TargetSettings, record: ReleaseRecord, number: str, expected: str, line: str
) -> None:
    """Make a release current.

    Raises:
        TargetError: another one has become current since, or the target cannot be written or reached.
    """
    pending = "1" if target.run else ""
    try:
        ran = place.run(COMMIT, number, record.name, expected, str(target.keep), pending, line)
    except LostError as error:
        if not _is_current(place, record, error):
            raise
        return
    if ran.code == CHANGED:
        raise TargetError(f"{place.label}: {ran.err.strip()}, not {expected or 'nothing'}", _OTHER)
    succeed(place, ran)


def _is_current(place: Place, record: ReleaseRecord, lost: LostError) -> bool:
    """Ask once more after a lost connection whether the last step was taken."""
    try:
        current = read_state(place).current
    except LceRigError:
        raise TargetError(
            f"{lost.what}; whether {record.name} is in place is not known",
            "Run `lce-rig deploy --status`, or the same command again.",
        ) from lost
    return current is not None and current.name == record.name


def _line(action: str, record: ReleaseRecord, replaces: str, reason: str = "") -> str:
    """Write a line of deployments.log."""
    entry = {
        "time": f"{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%SZ}",
        "action": action,
        "release": record.name,
        "replaces": replaces,
        "by": _user(),
        "robot": record.robot,
        "session_sha256": record.session_sha256,
        "reason": reason or record.reason,
        "forced": record.forced if action == "deploy" else [],
    }
    return json.dumps(entry)


def _run(place: Place, target: TargetSettings, release: str) -> str | None:
    """Run the target's command; give its output, None if there is no command.

    Raises:
        CommandError: it failed, or whether it did is not known; the files are in place.
    """
    if target.run is None:
        return None
    again = "`--rollback` restores the earlier files; the same command again runs only what failed."
    try:
        ran = place.run(RUN, release, target.run, timeout_s=target.run_timeout_s)
    except TargetError as error:
        what = f"{release} is in place, but its command has no outcome: {error.what}"
        raise CommandError(what, f"{error.hint}\n{again}".strip()) from error
    output, _, code = ran.out.rpartition(f"{SAYS}exit ")
    if code.strip() != "0":
        said = (output + ran.err).strip()
        what = f"{release} is in place, but its command ended with {code.strip() or ran.code}: {target.run}"
        raise CommandError(what, f"{said[-4000:]}\n{again}".strip())
    return output
