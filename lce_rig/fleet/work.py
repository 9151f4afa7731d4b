"""The work on one session: detect, calibrate, verify, write. Runs in a process of its own (`process.py`)."""

import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import lce_rig as lce
from lce_rig.core.calibration import DEFAULT_METHOD, MADE_BY, Method, Provenance
from lce_rig.core.errors import (
    LceRigError,
    NotEnoughDataError,
    ProfileError,
    ResultRefusedError,
    SessionError,
    SourceError,
    UsageError,
)
from lce_rig.core.findings import Finding
from lce_rig.detect.detection import Detections
from lce_rig.fleet import findings as _kinds  # noqa: F401
from lce_rig.fleet.jobs import Job, folder_name
from lce_rig.fleet.process import Ended
from lce_rig.fleet.registry import Registry, write_rows
from lce_rig.fleet.storage import Storage
from lce_rig.fleet.table import Row, Status, result_columns
from lce_rig.io.fingerprint import fingerprint
from lce_rig.pipeline.result_files import OVERLAYS, Result
from lce_rig.rig import Rig, dump_rig, load_rig
from lce_rig.session import Session
from lce_rig.session.durable import replace_file
from lce_rig.session.identity import MARKER
from lce_rig.session.provenance import provenance_of
from lce_rig.session.session import (
    CALIBRATION,
    DEBUG,
    INTRINSICS,
    LOCK,
    PROFILE,
    REJECTED,
    RESULTS,
)

# What no result depends on.
_NOT_NEEDED = frozenset({CALIBRATION, RESULTS, INTRINSICS, DEBUG, REJECTED, OVERLAYS, LOCK})
_CODES: tuple[tuple[type[LceRigError], str], ...] = (
    (ProfileError, "fleet.profile"),
    (SessionError, "fleet.session"),
    (SourceError, "fleet.source"),
    (NotEnoughDataError, "fleet.not_enough_data"),
    (ResultRefusedError, "fleet.refused"),
    (UsageError, "fleet.usage"),
)
_HASH_DIGITS = 12
Pictures = Literal["all", "sheets", "none"]


@dataclass(frozen=True)
class Settings:
    """What holds for all sessions of a run.

    Attributes:
        registry: its path or address.
        method: of the estimates.
        time_limit_s: that a session may take.
        memory_limit_mb: that its process may hold.
        retry: whether sessions without a result are run again.
        pictures: whether overlays of all captures are kept, contact sheets of them only, or nothing is drawn.
    """

    registry: str
    method: Method = DEFAULT_METHOD
    time_limit_s: float = 600.0
    memory_limit_mb: float = 4000.0
    retry: bool = False
    pictures: Pictures = "sheets"

    def opened(self) -> Registry:
        """The registry."""
        return Registry(Storage.at(self.registry))


def work(job: Job, settings: Settings, tell: Callable[[Mapping[str, Any]], None]) -> list[dict[str, Any]]:
    """Run one session, unless the registry holds its result already.

    Args:
        job: the session.
        settings: of the run.
        tell: called with what is known of the session before the work begins.

    Returns:
        Its rows, as `write_rows` gives them; status "failed" for what the user can repair.
    """
    start_s = time.monotonic()
    registry = settings.opened()
    row = first_row(job, settings)
    tell(asdict(row))
    with TemporaryDirectory(prefix="lce-rig-") as scratch:
        try:
            opened = _Opened.of(job, Path(scratch))
            row = opened.row(job, row)
            held = registry.found(row.robot, opened.ending)
            if held is not None:
                rows = registry.rows(held)
                if _is_done(rows, row, retry=settings.retry):
                    return [{**each, "is_new": False} for each in rows]
            tell(asdict(row))
            session = opened.session()
            row = _dated(row, provenance_of([session]), opened.ending)
            tell(asdict(row))
        except (LceRigError, OSError) as error:
            return publish(registry, [_failed(row, error, Path(scratch))], start_s)
        try:
            return _calibrate(registry, session, row, settings, start_s)
        except LceRigError as error:
            return publish(registry, [_failed(row, error, Path(scratch))], start_s)


def first_row(job: Job, settings: Settings) -> Row:
    """Describe a session of which nothing is known but where it lies."""
    robot = folder_name(job.robot or job.fallback_robot or "unnamed")
    return Row(
        robot,
        folder=f"{robot}/unread-{folder_name(job.source)[-40:]}",
        source=job.source,
        program=MADE_BY,
        method=settings.method,
        collector=job.collector or None,
        site=job.site or None,
    )


@dataclass(frozen=True)
class _Opened:
    """A session or recording as far as it has to be read to be recognised.

    Attributes:
        ending: the fingerprint of captures and profile, as at the end of its folder's name.
        rig: the profile.
        profile_sha256: of the session's rig.yaml.
        provenance: of the session; None for a recording.
        session: copies the rest, and opens it as a session.
    """

    ending: str
    rig: Rig
    provenance: Provenance | None
    session: Callable[[], Session]

    @classmethod
    def of(cls, job: Job, scratch: Path) -> "_Opened":
        source, copy = Storage.at(job.source), scratch / "session"
        rig = None if not job.rig else _profile(job.rig, scratch)
        if (source / MARKER).exists():
            source.fetch(copy, without=_NOT_NEEDED)
            if rig is not None:
                _check_same_rig(copy, rig)
                replace_file(copy / PROFILE, dump_rig(rig).encode())
            opened = Session.open(copy)
            provenance = provenance_of([opened])
            ending = provenance.session_sha256[:_HASH_DIGITS]
            return cls(ending, opened.rig, provenance, lambda: opened)
        if rig is None:
            raise ProfileError(
                f"{job.source} is not a session, and the manifest names no profile for it",
                "Add `rig:` with a shipped name or a file to its entry.",
            )
        if not source.exists():
            raise SourceError(f"{job.source} does not exist")
        recording = scratch / source.name
        source.fetch(recording)
        files = sorted(path for path in recording.rglob("*") if path.is_file()) or [recording]
        profile = scratch / PROFILE
        profile.write_bytes(dump_rig(rig).encode())
        return cls(
            fingerprint([*files, profile])[:_HASH_DIGITS],
            rig,
            None,
            lambda: lce.collect_from(rig, recording, copy),
        )

    def row(self, job: Job, row: Row) -> Row:
        """Add what is known now."""
        told = job.robot or (self.provenance.robot if self.provenance is not None else self.rig.robot or "")
        robot = folder_name(told or job.fallback_robot or self.rig.name)
        row = replace(row, robot=robot, rig=self.rig.name, folder=f"{robot}/undated-{self.ending}")
        return row if self.provenance is None else _dated(row, self.provenance, self.ending)


def _profile(name: str, scratch: Path) -> Rig:
    """Load a profile by its name, path or address."""
    if "://" not in name:
        return load_rig(name)
    file = scratch / "profile.yaml"
    Storage(name).fetch(file)
    return load_rig(file)


def _check_same_rig(session: Path, rig: Rig) -> None:
    own = load_rig(session / PROFILE)
    if own.name != rig.name:
        raise ProfileError(
            f"the manifest's profile is of rig {rig.name!r}, the session's of rig {own.name!r}",
            "Name the profile of the session's rig, or none.",
        )


def _dated(row: Row, provenance: Provenance, ending: str) -> Row:
    date = provenance.date
    compact = date.replace("-", "").replace(":", "") or "undated"
    return replace(
        row,
        date=date or None,
        session_sha256=provenance.session_sha256,
        folder=f"{row.robot}/{compact}-{ending}",
    )


def _is_done(rows: list[dict[str, Any]], row: Row, *, retry: bool) -> bool:
    """Return whether rows are of this version and method; `retry` counts only results."""
    return bool(rows) and all(
        (each.get("program"), each.get("method")) == (row.program, row.method)
        and (not retry or each.get("status") == "ok")
        for each in rows
    )


def _failed(row: Row, error: LceRigError | OSError, scratch: Path) -> Row:
    """Say why there is no result, by the names that files have where the session lies."""
    if isinstance(error, OSError):
        error = SourceError(f"{row.source} cannot be read: {error.strerror or error}")
    own = error.finding if isinstance(error, NotEnoughDataError) else None
    code = next((code for kind, code in _CODES if isinstance(error, kind)), "fleet.other_error")
    cause = own or Finding(code, figures={"what": error.what, "hint": error.hint})
    failed = without_result(row, "failed", cause)
    return replace(failed, detail=(failed.detail or "").replace(str(scratch / "session"), row.source))


def without_result(row: Row, status: Status, cause: Finding) -> Row:
    """Describe a session, or one pair of its sensors, that has no result."""
    return replace(row, status=status, cause=cause.code, detail=cause.text)


def _calibrate(
    registry: Registry, session: Session, row: Row, settings: Settings, start_s: float
) -> list[dict[str, Any]]:
    detections = lce.detect(session, n_threads=1)
    options = lce.CalibrateOptions(settings.method)
    result = lce.calibrate(session, detections, options=options)
    verification = lce.verify(session, result, detections)
    serials = provenance_of([session]).serials
    profile = result.document()["inputs_sha256"][PROFILE]
    row = replace(row, profile_sha256=profile)
    doubts: dict[tuple[str, str], list[Finding]] = {}
    for check in verification.checks:
        doubts.setdefault((check.pair.camera, check.pair.lidar), []).extend(check.findings)
    rows = []
    for c in result.pairs:
        own = doubts.get((c.camera, c.lidar), [])
        known = replace(c, findings=(*c.findings, *own))
        rows.append(replace(row, **result_columns(known, session.rig, serials)))
    rows += _lacking(result, detections, row)

    def fill(folder: Path) -> None:
        result.write(folder)
        replace_file(folder / PROFILE, dump_rig(session.rig).encode())
        if settings.pictures != "none":
            checks = verification.write(folder / OVERLAYS)
            for path in (path for check in checks for path in check.pictures):
                if settings.pictures == "sheets":
                    path.unlink()

    return publish(registry, rows, start_s, fill)


def _lacking(result: Result, detections: Detections, row: Row) -> list[Row]:
    """Give a row to each camera and LiDAR of the session without a result."""
    solved = {(c.camera, c.lidar) for c in result.pairs}
    pairs = dict.fromkeys((pair.camera, pair.lidar) for pair in detections.pairs)
    # Shortages stand in the order of the pairs they belong to.
    lacking = [pair for pair in pairs if pair not in solved]
    return [
        without_result(replace(row, camera=camera, lidar=lidar), "failed", why)
        for (camera, lidar), why in zip(lacking, result.shortages, strict=False)
    ]


def publish(
    registry: Registry,
    rows: list[Row],
    start_s: float,
    fill: Callable[[Path], None] = lambda _folder: None,
    used: Ended | None = None,
) -> list[dict[str, Any]]:
    """Write a result's folder and return its rows.

    Args:
        registry: where.
        rows: of one folder.
        start_s: when the work began, on the monotonic clock.
        fill: writes the other files into the folder.
        used: how another process ended that did the work; None for this one.
    """
    with registry.result(rows[0].folder) as draft:
        fill(draft)
        own = resource.getrusage(resource.RUSAGE_SELF)
        cpu_s = own.ru_utime + own.ru_stime if used is None else used.cpu_s
        peak_mb = own.ru_maxrss / 1024 if used is None else used.peak_memory_mb
        spent: dict[str, Any] = {
            "duration_s": round(time.monotonic() - start_s, 3),
            "cpu_s": round(cpu_s, 3),
            "peak_memory_mb": round(peak_mb, 1),
            "finished": datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%S.%fZ"),
        }
        written = write_rows(draft, [replace(row, **spent) for row in rows])
    return [{**row, "is_new": True} for row in written]
