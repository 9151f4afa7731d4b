"""Deploy a result to a target, query its state, and restore an earlier release.

`plan` lists changes and objections, `deploy` makes the changes, `standing` queries the state, `rollback`
makes an earlier release current again. Each opens its own connections; nothing is kept between calls.
"""

import difflib
import json
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from tempfile import TemporaryDirectory

from lce_rig.core.calibration import Calibration, ResultFile, read_result
from lce_rig.core.errors import (
    CommandError,
    LceRigError,
    ResultRefusedError,
    TargetError,
)
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import difference, tangent_sizes
from lce_rig.export import write_exports
from lce_rig.fleet.findings import (
    DEPLOY_FAILED,
    DEPLOY_MOVED,
    DEPLOY_NO_ROBOT,
    DEPLOY_OLDER,
    DEPLOY_OTHER_RIG,
    DEPLOY_OTHER_ROBOT,
    DEPLOY_OTHER_SERIAL,
    DEPLOY_UNDATED,
    DEPLOY_WORSE,
)
from lce_rig.fleet.place import (
    CHANGED,
    COMMIT,
    DISCARD,
    RECORD,
    RUN,
    SAYS,
    STAGE,
    LostError,
    Place,
)
from lce_rig.fleet.releases import (
    ReleaseRecord,
    TargetState,
    content_of,
    differences,
    differences_in_words,
    fetch,
    read_state,
    user_name,
)
from lce_rig.fleet.target import TargetSettings
from lce_rig.pipeline.result_files import RESULT
from lce_rig.rig import Rig
from lce_rig.rig.profile import NominalExtrinsic
from lce_rig.session import Session

# Largest accepted movement of pairs without a tolerance in the profile: defaults of `nominal_extrinsics`.
_TOLERANCE_DEG, _TOLERANCE_M = (
    NominalExtrinsic.model_fields[name].default for name in ("tolerance_deg", "tolerance_m")
)
_OTHER = "Another deployment came first. Run the same command again."


@dataclass(frozen=True)
class SensorChange:
    """The change of the extrinsics of a camera and a LiDAR.

    Attributes:
        camera, lidar: the sensors.
        is_new: whether the new set has extrinsics of them.
        rotation_deg, translation_m: between both sets; None if only one of them has extrinsics.
        verdict, verdict_there: verdicts of the new and the deployed result, or "".
    """

    camera: str
    lidar: str
    is_new: bool
    rotation_deg: float | None = None
    translation_m: float | None = None
    verdict: str = ""
    verdict_there: str = ""


@dataclass(frozen=True)
class Plan:
    """The changes of a deployment.

    Attributes:
        record: record of the release that would be made.
        state: state of the target now.
        changed: files that differ from the current release's: "changed", "missing", "added".
        sensors: changes of the extrinsics.
        findings: objections, and notes on sets that could not be compared.
        diff: lines in which texts differ, as `diff -u` prints them.
    """

    record: ReleaseRecord
    state: TargetState
    changed: Mapping[str, str]
    sensors: tuple[SensorChange, ...]
    findings: tuple[Finding, ...]
    diff: tuple[str, ...]

    @property
    def objections(self) -> tuple[Finding, ...]:
        """Findings for which a deployment is refused unless it is forced."""
        return tuple(finding for finding in self.findings if finding.severity == "error")

    @property
    def remarks(self) -> tuple[Finding, ...]:
        """Findings that refuse nothing."""
        return tuple(finding for finding in self.findings if finding.severity == "note")

    @property
    def is_in_place(self) -> bool:
        """Whether the target already holds exactly these files."""
        return self.state.current is not None and not self.changed and not self.state.changed


@dataclass(frozen=True)
class Deployed:
    """The outcome of a deployment or a rollback.

    Attributes:
        release: the current release.
        replaces: the release that was current before; "" for the first.
        is_new: whether something changed; False if the same files were already in place.
        output: output of the command that ran afterwards; None if none ran.
        changed_there: files of the earlier release that had been changed at the target.
        remarks: see `Plan`.
    """

    release: ReleaseRecord
    replaces: str
    is_new: bool
    output: str | None = None
    changed_there: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[Finding, ...] = ()


def plan(result: Path, rig: Rig, target: TargetSettings, *, session: Session | None = None) -> Plan:
    """Compare a result with the state of a target, without changing it.

    Args:
        result: folder with its result.json.
        rig: the profile of the session.
        target: where to.
        session: with images and scans, for formats that show them.

    Raises:
        SessionError: the result is missing.
        TargetError: the target cannot be reached or read.
    """
    with TemporaryDirectory(prefix="lce-rig-") as folder:
        return _plan(result, rig, target, session, Place(target), Path(folder))


def deploy(
    result: Path,
    rig: Rig,
    target: TargetSettings,
    *,
    session: Session | None = None,
    reason: str = "",
    place: Place | None = None,
    announce: Callable[[Plan], None] | None = None,
) -> Deployed:
    """Write the files of a result to a target, all at once, and run its command.

    If the same files are already in place, only a command that has not succeeded yet runs. After any
    interruption the target holds the earlier set or the new one.

    Args:
        result: folder with its result.json.
        rig: the profile of the session.
        target: where to.
        session: with images and scans, for formats that show them.
        reason: reason for deploying against objections; it is logged at the target.
        place: replaces the target's own access to its folder.
        announce: receives the changes before anything is refused or changed.

    Raises:
        SessionError: the result is missing.
        ResultRefusedError: there are objections and no reason.
        TargetError: the target cannot be reached or written, or another deployment came first.
        CommandError: the command failed; the new files are in place.
    """
    place = place or Place(target)
    with TemporaryDirectory(prefix="lce-rig-") as folder:
        planned = _plan(result, rig, target, session, place, Path(folder))
        if announce is not None:
            announce(planned)
        if planned.objections and not reason:
            causes = "; ".join(finding.text for finding in planned.objections)
            at = "SESSION" if session is None else str(session.path)
            advice = dict.fromkeys(finding.advice_at(at) for finding in planned.objections)
            raise ResultRefusedError(f"not deployed to {target.to}: {causes}", "\n".join(advice))
        record, current = planned.record, planned.state.current
        if planned.is_in_place and current is not None:
            output = _run(place, target, current.name) if planned.state.is_pending else None
            return Deployed(current, current.replaces, False, output)
        if planned.objections:
            forced = sorted({finding.code for finding in planned.objections})
            record = record.model_copy(update={"reason": reason, "forced": forced})
        try:
            content, back = record.line().encode(), Path(folder) / "back"
            place.must_run(STAGE, record.name, content=content)
            place.put(Path(folder) / "new", f"releases/{record.name}")
            wrong = fetch(place, record, back)
            if wrong or (back / RECORD).read_bytes() != content:
                raise TargetError(
                    f"{place.label}: files read back differently: {differences_in_words(wrong) or RECORD}",
                    "Check the disk there.",
                )
            _commit(place, target, record, record.replaces, "deploy")
        except TargetError:
            # Free the space and the name; if the connection is lost, the next deployment does it.
            with suppress(TargetError):
                place.must_run(DISCARD, record.name)
            raise
    output = _run(place, target, record.name)
    return Deployed(record, record.replaces, True, output, planned.state.changed, planned.remarks)


def standing(target: TargetSettings) -> TargetState:
    """Query the state of a target, and whether its current files are unchanged since deployment.

    Raises:
        TargetError: the target cannot be reached or read.
    """
    with TemporaryDirectory(prefix="lce-rig-") as folder:
        return _standing(Place(target), Path(folder) / "deployed")


def _standing(place: Place, folder: Path) -> TargetState:
    """Query the state, and copy the current files to a new folder."""
    state = read_state(place)
    if state.current is None:
        folder.mkdir()
        return state
    return replace(state, changed=fetch(place, state.current, folder))


def rollback(target: TargetSettings, name: str | None = None, *, reason: str = "") -> Deployed:
    """Make an earlier release current again, byte for byte, and run the target's command.

    Args:
        target: the target.
        name: name of the release; None takes the one that the current release replaced.
        reason: reason to log at the target.

    Raises:
        TargetError: there is no such release, its files were changed, or the target cannot be reached.
        CommandError: the command failed; the earlier files are in place.
    """
    place = Place(target)
    state = read_state(place)
    if state.current is None:
        raise TargetError(f"{place.label}: nothing has been deployed", "Deploy a result first.")
    wanted = state.current.replaces if name is None else name
    release = state.named(wanted)
    if release is None:
        others = ", ".join(kept.name for kept in state.releases if kept.name != state.current.name)
        again = "`lce-rig deploy SESSION --target TARGET --rollback --release NAME`"
        hint = f"{again} restores one of {others}." if others else "No other one is there."
        what = f"there is no release {wanted}" if wanted else "the current release is the first"
        raise TargetError(f"{place.label}: {what}", hint)
    with TemporaryDirectory(prefix="lce-rig-") as folder:
        wrong = fetch(place, release, Path(folder) / "release")
    if wrong:
        raise TargetError(
            f"{place.label}: release {release.name} is not as it was deployed: {differences_in_words(wrong)}",
            "Name another release, or deploy its session again.",
        )
    replaces = state.current.name
    if release.name != replaces:
        _commit(place, target, release, replaces, "rollback", reason)
    return Deployed(release, replaces, release.name != replaces, _run(place, target, release.name))


def _plan(
    result: Path, rig: Rig, target: TargetSettings, session: Session | None, place: Place, folder: Path
) -> Plan:
    """Write the new files to folder/new, fetch the current ones to folder/deployed, and compare."""
    new, deployed = folder / "new", folder / "deployed"
    saved = _stage(result, rig, target, session, new)
    state = _standing(place, deployed)
    files = content_of(new)
    rig_there, before = _pairs(deployed)
    after = {(pair.camera, pair.lidar): pair for pair in saved.pairs}
    sensors = [_change(key, after.get(key), before.get(key)) for key in dict.fromkeys([*after, *before])]
    changed = differences(files, {} if state.current is None else state.current.files)
    findings = _compare(saved, target, state.current)
    if rig_there not in ("", saved.rig):
        findings.append(DEPLOY_OTHER_RIG(rig=saved.rig, there=rig_there))
    findings += [finding for change in sensors for finding in _object(change, rig)]
    record = ReleaseRecord.of(saved, files, state)
    lines = [line for name in changed for line in _diff(name, deployed, new)]
    return Plan(record, state, changed, tuple(sensors), tuple(findings), tuple(lines))


def _diff(name: str, deployed: Path, new: Path) -> list[str]:
    """List the changed lines of a text; new and removed texts whole, other files not at all."""
    try:
        before, after = (
            path.read_text("utf-8").splitlines() if path.is_file() else []
            for path in (deployed / name, new / name)
        )
    except (OSError, ValueError):
        return []
    return list(difflib.unified_diff(before, after, f"deployed/{name}", f"new/{name}", lineterm=""))


def _stage(
    result: Path, rig: Rig, target: TargetSettings, session: Session | None, folder: Path
) -> ResultFile:
    """Write the files of the set: result.json and the exports."""
    saved = read_result(result / RESULT)
    folder.mkdir()
    # A failed result is one of the objections, which are judged together.
    write_exports(saved.pairs, rig, folder, formats=target.formats, is_forced=True, session=session)
    shutil.copyfile(result / RESULT, folder / RESULT)
    return saved


def _compare(saved: ResultFile, target: TargetSettings, current: ReleaseRecord | None) -> list[Finding]:
    """List objections to a deployment, and note missing dates, with which the older captures are unknown."""
    origin = saved.provenance
    findings = [DEPLOY_FAILED(f"{c.camera} and {c.lidar}") for c in saved.pairs if c.verdict == "fail"]
    robots = {robot for robot in (target.robot, None if current is None else current.robot) if robot}
    for robot in sorted(robots - {origin.robot}) if origin.robot else ():
        findings.append(DEPLOY_OTHER_ROBOT(robot=origin.robot, there=robot))
    if robots and not origin.robot:
        findings.append(DEPLOY_NO_ROBOT(there=", ".join(sorted(robots))))
    if current is None:
        return findings
    for sensor, serial in sorted(origin.serials.items()):
        there = current.serials.get(sensor, serial)
        if there != serial:
            findings.append(DEPLOY_OTHER_SERIAL(sensor, serial=serial, there=there))
    if origin.date and current.date:
        if origin.date < current.date:
            findings.append(DEPLOY_OLDER(date=origin.date, there=current.date))
    elif origin.session_sha256 != current.session_sha256:
        there = current.date or "unknown"
        findings.append(DEPLOY_UNDATED(date=origin.date_words or "unknown", there=there))
    return findings


def _pairs(folder: Path) -> tuple[str, dict[tuple[str, str], Calibration]]:
    """Read the rig's name and calibrations of an export set; empty without a readable result."""
    with suppress(LceRigError):
        saved = read_result(folder / RESULT)
        return saved.rig, {(pair.camera, pair.lidar): pair for pair in saved.pairs}
    return "", {}


def _change(key: tuple[str, str], new: Calibration | None, old: Calibration | None) -> SensorChange:
    change = SensorChange(
        *key,
        new is not None,
        verdict="" if new is None else new.verdict,
        verdict_there="" if old is None else old.verdict,
    )
    if new is None or old is None:
        return change
    rotation_deg, translation_m = tangent_sizes(difference(new.T_cam_lidar, old.T_cam_lidar))
    return replace(change, rotation_deg=rotation_deg, translation_m=translation_m)


def _object(change: SensorChange, rig: Rig) -> list[Finding]:
    """List objections to a sensor's change: moved beyond the profile's tolerance, or a worse verdict."""
    findings, subject = list[Finding](), f"{change.camera} and {change.lidar}"
    if change.rotation_deg is not None and change.translation_m is not None:
        nominal = rig.nominal(change.camera, change.lidar)
        limit_deg = _TOLERANCE_DEG if nominal is None else nominal.tolerance_deg
        limit_m = _TOLERANCE_M if nominal is None else nominal.tolerance_m
        if change.rotation_deg > limit_deg or change.translation_m > limit_m:
            moved = {"rotation_deg": change.rotation_deg, "translation_m": change.translation_m}
            findings.append(DEPLOY_MOVED(subject, **moved, limit_deg=limit_deg, limit_m=limit_m))
    if (change.verdict_there, change.verdict) == ("pass", "marginal"):
        findings.append(DEPLOY_WORSE(subject, verdict=change.verdict, there=change.verdict_there))
    return findings


def _commit(
    place: Place, target: TargetSettings, release: ReleaseRecord, expected: str, action: str, reason: str = ""
) -> None:
    """Make a release current.

    Raises:
        TargetError: another release has become current meanwhile, or the target cannot be written or reached.
    """
    entry = {
        "time": f"{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%SZ}",
        "action": action,
        "release": release.name,
        "replaces": expected,
        "by": user_name(),
        "robot": release.robot,
        "session_sha256": release.session_sha256,
        "reason": reason or release.reason,
        "forced": release.forced if action == "deploy" else [],
    }
    pending = "1" if target.run else ""
    try:
        ran = place.run(COMMIT, release.name, expected, str(target.keep), pending, json.dumps(entry))
    except LostError as lost:
        # After a lost connection, query whether the last step was done.
        try:
            current = read_state(place).current
        except LceRigError:
            raise TargetError(
                f"{lost.what}; whether {release.name} is in place is not known",
                "Run `lce-rig deploy --target TARGET --status`, or the same command again.",
            ) from lost
        if current is None or current.name != release.name:
            raise
        return
    if ran.code == CHANGED:
        raise TargetError(f"{place.label}: {ran.err.strip()}, not {expected or 'nothing'}", _OTHER)
    place.check(ran)


def _run(place: Place, target: TargetSettings, release: str) -> str | None:
    """Run the target's command; return its output, or None without a command.

    Raises:
        CommandError: the command failed, or its outcome is unknown; the files are in place.
    """
    if target.run is None:
        return None
    again = (
        "The same command again runs only what failed. "
        "`lce-rig deploy SESSION --target TARGET --rollback` restores the earlier files."
    )
    arguments = (release, f"{target.run_timeout_s:g}", target.run, target.robot or "")
    try:
        # The target ends the command at its time limit, if it has the program `timeout`.
        ran = place.run(RUN, *arguments, timeout_s=target.run_timeout_s + 5)
    except TargetError as error:
        what = f"{release} is in place, but its command has no outcome: {error.what}"
        raise CommandError(what, f"{error.hint}\n{again}".strip()) from error
    output, _, ending = ran.out.rpartition(f"{SAYS}exit ")
    # A command ended by the time limit may still have written after its exit code.
    code = ending.partition("\n")[0].strip()
    if code != "0":
        said = (output + ran.err).strip()
        what = f"{release} is in place, but its command ended with {code or ran.code}: {target.run}"
        raise CommandError(what, f"{said[-4000:]}\n{again}".strip())
    return output
