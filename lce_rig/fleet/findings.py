"""Findings about fleets: robots that moved, sessions without a result, objections to a deployment."""

from lce_rig.core.errors import (
    LceRigError,
    NotEnoughDataError,
    ProfileError,
    ResultRefusedError,
    SessionError,
    SourceError,
    UsageError,
)
from lce_rig.core.findings import Kind

MOVED = Kind(
    "fleet.moved",
    "{camera} and {lidar} moved between {before} and {after} by {rotation_deg:deg}, {translation_m:1mm} "
    "(chi-squared {chi2:.0f}, limit {limit_chi2:.0f})",
    "use no result from before; check how the sensors are fastened",
    severity="note",
)

_CODES: dict[type[LceRigError], str] = {
    ProfileError: "profile",
    SessionError: "session",
    SourceError: "source",
    NotEnoughDataError: "not_enough_data",
    ResultRefusedError: "refused",
    UsageError: "usage",
    LceRigError: "other_error",
}
OF_ERRORS = {error: Kind(f"fleet.{code}", "{what}", "{hint}") for error, code in _CODES.items()}
"""Errors that the user can repair; the first that an error is an instance of counts."""

DAMAGED = Kind(
    "fleet.damaged",
    "its files in the registry are damaged: {what}",
    "write it again: `lce-rig fleet run ROOT --registry FOLDER`",
)
BUG = Kind("fleet.bug", "a bug in lce-rig: {what}", "report it with the session")
TIMED_OUT = Kind(
    "fleet.timed_out",
    "not done after {limit_s:.0f} s (limit)",
    "`lce-rig fleet run ROOT --registry FOLDER --retry --time-limit SECONDS`",
)
OUT_OF_MEMORY = Kind(
    "fleet.out_of_memory",
    "needs more than {limit_mb:.0f} MB of memory (limit)",
    "`lce-rig fleet run ROOT --registry FOLDER --retry --memory-limit MB`",
)
SIGNAL = Kind(
    "fleet.signal", "its process was ended by signal {signal}: {what}", "calibrate the session alone"
)
WORKER_LOST = Kind(
    "fleet.worker_lost",
    "{n} workers were lost with it",
    "run it again; if it is lost again, calibrate the session alone",
)

DEPLOY_FAILED = Kind(
    "deploy.failed",
    "the calibration of {subject} failed",
    "Collect again, see `lce-rig calibrate {session}`.",
)
DEPLOY_OTHER_ROBOT = Kind(
    "deploy.other_robot",
    "the result is of robot {robot}, the target of {there}",
    "Name the target of the right robot.",
)
DEPLOY_NO_ROBOT = Kind(
    "deploy.no_robot",
    "the result names no robot, the target is of {there}",
    "Set `robot` in the profile and collect again.",
)
DEPLOY_OTHER_RIG = Kind(
    "deploy.other_rig",
    "the result is of rig {rig}, the deployed one of {there}",
    "Name the target of the right rig.",
)
DEPLOY_MOVED = Kind(
    "deploy.moved",
    "{subject} would move by {rotation_deg:deg}, {translation_m:mm} (limit {limit_deg:deg}, {limit_m:mm})",
    "Check the result, `lce-rig verify {session}`, or force it with a reason.",
)
DEPLOY_WORSE = Kind(
    "deploy.worse",
    "the verdict of {subject} is {verdict}, the deployed one {there}",
    "Improve the result, see `lce-rig calibrate {session}`.",
)
DEPLOY_OTHER_SERIAL = Kind(
    "deploy.other_serial",
    "{subject} has serial number {serial}, the deployed one {there}",
    "Name the right target. For a replaced sensor, force it with a reason.",
)
DEPLOY_OLDER = Kind(
    "deploy.older",
    "the result's captures are of {date}, the deployed ones of {there}",
    "To roll back: `lce-rig deploy {session} --target TARGET --rollback`",
)
DEPLOY_UNDATED = Kind(
    "deploy.undated",
    "not compared by age; date of the result's captures: {date}; of the deployed ones: {there}",
    severity="note",
)
