"""Write the files of a result into its session in one step; keep the last usable earlier ones."""

import hashlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from lce_rig.core.calibration import Calibration, Provenance, ResultFile, RigPoses, read_result
from lce_rig.core.errors import LceRigError, NotEnoughDataError, SessionError, UsageError, reading
from lce_rig.core.findings import Finding
from lce_rig.core.rig_poses import find_rig_poses
from lce_rig.export import is_export, write_exports
from lce_rig.rig import load_rig
from lce_rig.session import Session
from lce_rig.session.capture import MANIFEST, SAFE_NAME
from lce_rig.session.durable import check_folder, copy_over, replacing, write_atomically
from lce_rig.session.provenance import provenance_of
from lce_rig.session.session import CALIBRATION, CAPTURES, PROFILE, RESULTS
from lce_rig.show.overlays.canvas import Thumbnails

RESULT, REPORT, OVERLAYS, PREVIOUS = "result.json", "report.html", "overlays", "previous"
CURRENT = "current"
"""How the result in calibration/ is called beside those with names."""
_LONGEST_NAME = 64


class WrittenResult(NamedTuple):
    """The written files of a result.

    Attributes:
        files: result.json and the exports.
        findings: content that exports omit or change.
        report: the page; None if not requested.
        previous: the folder with the earlier run's files; None if there was none.
    """

    files: tuple[Path, ...]
    findings: tuple[Finding, ...]
    report: Path | None
    previous: Path | None = None

    @property
    def has_usable_previous(self) -> bool:
        """Whether that run had a usable result."""
        return self.previous is not None and bool(_usable(self.previous))


@dataclass(frozen=True, eq=False)
class Result:
    """The extrinsics of a session's sensors.

    Attributes:
        session: the source of the captures.
        pairs: one for each calibrated camera and LiDAR.
        shortages: reason why each other camera and LiDAR with captures has no result.
        thumbnails: images that were decoded for the result; the report decodes the others.
    """

    session: Session
    pairs: tuple[Calibration, ...]
    shortages: tuple[Finding, ...] = ()
    thumbnails: Thumbnails = field(default_factory=Thumbnails)

    def of(self, camera: str, lidar: str | None = None) -> Calibration:
        """Return the extrinsics of a camera with a LiDAR, by default the first with a result.

        Raises:
            NotEnoughDataError: the sensors have no result.
        """
        for pair in self.pairs:
            if pair.camera == camera and lidar in (None, pair.lidar):
                return pair
        raise NotEnoughDataError(f"no extrinsic of camera {camera}", "Collect more captures.")

    @property
    def on_base(self) -> RigPoses | None:
        """The pose of each sensor on the first LiDAR; None for two sensors."""
        return find_rig_poses(self.pairs, self.session.rig.lidars)

    @property
    def provenance(self) -> Provenance:
        """Robot, sensors and date; raises like `provenance_of`."""
        return provenance_of(self.session)

    def file(self) -> ResultFile:
        """Build result.json.

        Raises:
            SessionError: a capture that was used is missing, or captures are of different units of a sensor.
        """
        return ResultFile(
            rig=self.session.rig.name,
            provenance=self.provenance,
            inputs_sha256=inputs_sha256(self.session, self.pairs, self.session.profile_content()),
            on_base=self.on_base,
            pairs=self.pairs,
        )

    def document(self) -> dict[str, Any]:
        """List the content of result.json as plain types; raises like `file` and `ResultFile.document`."""
        return self.file().document()

    def write(self, *, name: str | None = None, force: bool = False, report: bool = True) -> WrittenResult:
        """Write result.json and, unless a verdict is fail, exports into the session; then a report.

        result.json and exports appear together in calibration/, before the report is drawn. Files of the
        earlier run move to calibration/previous/, except that neither a failed run nor one without a camera's
        only usable result replaces a usable run there. If the result is identical byte for byte, report,
        overlays and calibration/previous/ stay. Files that lce-rig did not write stay, too.

        Args:
            name: writes the session's results/NAME/ instead, in the same way; calibration/ is untouched. The
                profile of `Session.with_profile` is written there, too.
            force: export failed results too; each file is then marked.
            report: also write report.html, see `write_report`; a report of another result is removed.

        Raises:
            UsageError: the name is not valid, or missing where the profile is not the session's own.
            SessionError: a capture that was used is missing, or the disk is full; the earlier files are
                unchanged.
            ResultRefusedError: a pose or covariance is not finite; the same.
        """
        place, profile = result_folder(self.session.path, name, is_new=True), self.session.other_profile
        if name is None and profile is not None:
            raise UsageError("a result with another profile than the session's needs a name", "Name it.")
        usable = [c for c in self.pairs if force or c.verdict != "fail"]
        findings: list[Finding] = []
        files = [place / RESULT]
        with replacing(self.session.path, place, _keep_earlier) as draft:
            write_atomically(draft / RESULT, self.file().text())
            if profile is not None:
                write_atomically(draft / PROFILE, profile)
            if usable:
                exported = write_exports(
                    usable, self.session.rig, draft, is_forced=force, session=self.session, findings=findings
                )
                files += [place / path.relative_to(draft) for path in exported]
        page = self.write_report(name=name) if report else None
        has_previous = (place / PREVIOUS / RESULT).exists()
        return WrittenResult(tuple(files), tuple(findings), page, place / PREVIOUS if has_previous else None)

    def write_report(self, *, name: str | None = None) -> Path:
        """Draw report.html beside the result.json that `write` has written.

        Args:
            name: see `write`.

        Raises:
            SessionError: another result has replaced this one meanwhile, or the disk is full; the files there
                are unchanged.
        """
        from lce_rig.show.report.calibration_page import report_page

        file = self.file()
        text = file.text()
        place = result_folder(self.session.path, name, is_new=True)
        has_previous = bool(_usable(place / PREVIOUS))
        page = report_page(self.session, file, OVERLAYS, self.thumbnails, has_previous=has_previous)

        def finish(earlier: Path, draft: Path) -> None:
            if result_content(earlier) != text.encode():
                raise SessionError(
                    f"{place} was calibrated again while its report was drawn", "Run the command again."
                )
            keep_foreign(earlier, draft, lambda path: path.name == REPORT)

        with replacing(self.session.path, place, finish) as draft:
            write_atomically(draft / REPORT, page)
        return place / REPORT


def result_folder(session: Path, name: str | None = None, *, is_new: bool = False) -> Path:
    """Return the folder of a session's result; the one before a named result is `NAME/previous`.

    Args:
        session: the session's folder.
        name: name of the result; None for the main one, in calibration/.
        is_new: whether it is to be written.

    Raises:
        UsageError: the name is not valid for a result, or for a new one.
    """
    if is_new and name is not None and (name == CURRENT or name.rpartition("/")[2] == PREVIOUS):
        raise UsageError(f"a new result cannot be named {name!r}", "Choose another name.")
    if name is None or name == CURRENT:
        return session / CALIBRATION
    if name == PREVIOUS:
        return session / CALIBRATION / PREVIOUS
    folder, slash, rest = name.partition("/")
    if not SAFE_NAME.fullmatch(folder) or len(folder) > _LONGEST_NAME or (slash and rest != PREVIOUS):
        raise UsageError(
            f"{name!r} cannot name a result",
            f"Use up to {_LONGEST_NAME} letters, digits, dots, dashes and underscores, such as `events-ml`.",
        )
    return session / RESULTS / name


def with_profile_of(session: Session, name: str | None) -> Session:
    """Return a session with the profile stored beside one of its results, if there is one.

    Args:
        session: open for reading is enough.
        name: name of the result; None for the one in calibration/, whose profile is the session's.

    Raises:
        UsageError, ProfileError, SessionError: the name, or the profile there, cannot be used.
    """
    profile = _own_profile(session, name)
    return session if profile is None else session.with_profile(load_rig(profile))


def _own_profile(session: Session, name: str | None) -> Path | None:
    """Return the path of the profile stored beside a result; None if it uses the session's."""
    folder = result_folder(session.path, name)
    is_named = (session.path / RESULTS) in folder.parents
    return folder / PROFILE if is_named and (folder / PROFILE).is_file() else None


def inputs_sha256(session: Session, calibrations: Sequence[Calibration], profile: bytes) -> dict[str, str]:
    """Fingerprint the inputs of results: the profile, and the manifest of every capture used.

    A manifest holds the SHA-256 of the capture's files.

    Args:
        session: the session with the captures.
        calibrations: the results.
        profile: content of rig.yaml beside the result, else in the session.

    Returns:
        SHA-256 by path in the session; that of the profile by "rig.yaml", wherever it is.

    Raises:
        SessionError: a capture that was used is missing.
    """
    digests = {PROFILE: hashlib.sha256(profile).hexdigest()}
    held = {capture.name: capture for capture in session.captures}
    for name in sorted({name for calibration in calibrations for name in calibration.captures_used}):
        # `Session.capture` raises for a missing one; it lists the folder each time.
        capture = held.get(name) or session.capture(name)
        digests[f"{CAPTURES}/{name}/{MANIFEST}"] = capture.manifest_sha256
    return digests


def _usable(folder: Path) -> set[str]:
    """List the cameras and LiDARs with a usable result in a folder."""
    with suppress(LceRigError):
        pairs = read_result(folder / RESULT).pairs
        return {f"{c.camera} and {c.lidar}" for c in pairs if c.verdict != "fail"}
    return set()


def _keep_earlier(earlier: Path, draft: Path) -> None:
    """Copy the earlier result, or the one before it, and the user's files into the draft that replaces it.

    The earlier result becomes `previous/`, unless that would lose a usable one: if it failed and its own
    `previous/` did not, or if only that one has a usable result of some pair, `previous/` stays. If the new
    result is identical byte for byte, report, overlays and `previous/` stay.

    Args:
        earlier: the folder; need not exist.
        draft: folder with the new files.

    Raises:
        OSError: a full disk, no permission; or `previous` is a file, or a link.
    """
    if not earlier.is_dir():
        return
    check_folder(earlier / PREVIOUS)
    keep_foreign(earlier, draft, lambda path: path.name == PREVIOUS or _is_of_a_result(path))
    is_same = result_content(earlier) == result_content(draft)
    for drawn in (REPORT, OVERLAYS):
        if is_same and (earlier / drawn).exists():
            copy_over(earlier / drawn, draft / drawn)
    usable, before = _usable(earlier), _usable(earlier / PREVIOUS)
    deserves = (bool(usable) or not before) and before <= usable | _usable(draft)
    if deserves and not is_same and (earlier / RESULT).exists():
        (draft / PREVIOUS).mkdir()
        for entry in earlier.iterdir():
            if entry.name != PREVIOUS and _is_of_a_result(entry):
                copy_over(entry, draft / PREVIOUS / entry.name)
        keep_foreign(earlier / PREVIOUS, draft / PREVIOUS, _is_of_a_result)
    elif (earlier / PREVIOUS).is_dir():
        copy_over(earlier / PREVIOUS, draft / PREVIOUS)


def keep_foreign(earlier: Path, draft: Path, is_ours: Callable[[Path], bool]) -> None:
    """Copy the user's files from a folder into the draft that replaces it.

    Raises:
        OSError: a full disk, no permission.
    """
    for entry in earlier.iterdir() if earlier.is_dir() else ():
        if not is_ours(entry) and not (draft / entry.name).exists():
            draft.mkdir(exist_ok=True)
            copy_over(entry, draft / entry.name)


class StoredResult(NamedTuple):
    """A session's result on the disk.

    Attributes:
        name: "current" and "previous" for those in calibration/, else the name of `calibrate --name`.
        folder: folder of its result.json.
        file: the file's content; None if it cannot be read.
        problem: why it cannot be read; "" if it can.
        written_s: when it was written, seconds since 1970.
        is_outdated: whether the profile or a capture that it used has changed or is missing.
    """

    name: str
    folder: Path
    file: ResultFile | None
    problem: str
    written_s: float
    is_outdated: bool


def stored_results(session: Session) -> list[StoredResult]:
    """List a session's results: the current and the named ones, each followed by its predecessor.

    Raises:
        SessionError: their folders cannot be read.
    """
    root = session.path / RESULTS
    results = []
    with reading(root, SessionError):
        entries = sorted(entry.name for entry in root.iterdir()) if root.is_dir() else []
        named = [
            name for entry in entries if SAFE_NAME.fullmatch(entry) for name in (entry, f"{entry}/{PREVIOUS}")
        ]
        for name in (CURRENT, PREVIOUS, *named):
            folder = result_folder(session.path, name)
            if not (folder / RESULT).exists():
                continue
            file, problem, is_outdated = None, "", False
            try:
                file = read_result(folder / RESULT)
            except LceRigError as error:
                problem = error.what
            if file is not None:
                is_outdated = True
                profile = _own_profile(session, name) or session.path / PROFILE
                with suppress(LceRigError):
                    digests = inputs_sha256(session, file.pairs, profile.read_bytes())
                    is_outdated = dict(file.inputs_sha256) != digests
            written_s = (folder / RESULT).stat().st_mtime
            results.append(StoredResult(name, folder, file, problem, written_s, is_outdated))
    return results


def result_content(folder: Path) -> bytes | None:
    """Read the result.json of a folder; None without one.

    Raises:
        SessionError: it cannot be read.
    """
    with reading(folder / RESULT, SessionError):
        return (folder / RESULT).read_bytes() if (folder / RESULT).is_file() else None


def _is_of_a_result(path: Path) -> bool:
    return path.name in (RESULT, REPORT, OVERLAYS, PROFILE) or is_export(path)
