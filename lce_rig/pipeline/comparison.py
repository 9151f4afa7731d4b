"""Compare the calibrations of one rig in several sessions."""

import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from lce_rig.core.calibration import Calibration, ResultFile, read_result
from lce_rig.core.errors import SessionError, UsageError
from lce_rig.core.findings import Finding
from lce_rig.judge.repeatability import Repeatability, compare_calibrations
from lce_rig.pipeline.findings import FAILED, ONLY_ONE, OTHER_BOARD, OUTDATED
from lce_rig.pipeline.result_files import PREVIOUS, RESULT, result_folder, stored_results
from lce_rig.session import Session
from lce_rig.session.identity import differing_keys


@dataclass(frozen=True, eq=False)
class Repeat:
    """Sessions of one rig, or results of one session, and their comparison.

    Attributes:
        rig: the rig's name.
        comparisons: one for each camera and LiDAR that at least two sessions calibrate.
        findings: errors name sessions whose own calibration has failed; warnings state limits.
    """

    rig: str
    comparisons: tuple[Repeatability, ...]
    findings: tuple[Finding, ...]

    @property
    def failed(self) -> tuple[Finding, ...]:
        """Failed calibrations, by session and sensors."""
        return tuple(finding for finding in self.findings if finding.severity == "error")


def compare_results(folder: Path | str, names: Sequence[str] = ()) -> Repeat:
    """Compare the results in one session, such as those of frames and of events.

    Args:
        folder: folder of the session.
        names: names of the results; if empty, all but the previous one.

    Raises:
        UsageError: fewer than two results; or a name is given twice, or cannot be one.
        SessionError: a named result is missing, or one cannot be read.
    """
    session = Session.open(folder)
    stored = {each.name: each for each in stored_results(session)}
    listed = f"Its results: {', '.join(stored) or 'none'}."
    for name in names:
        result_folder(session.path, name)
        if list(names).count(name) > 1:
            raise UsageError(f"result {name} is given twice")
        if name not in stored:
            raise SessionError(f"{session.path} has no result {name!r}", listed)
    chosen = list(names) or [name for name in stored if name.rpartition("/")[2] != PREVIOUS]
    if len(chosen) < 2:
        raise UsageError(
            f"{session.path} has no two results to compare",
            f"{listed} Add one: lce-rig calibrate {session.path} --name NAME, or name a second session.",
        )
    results = {name: list(_read(session, stored[name].folder).pairs) for name in chosen}
    comparisons, findings = _compare_sensors(results, "results", are_independent=False)
    path = shlex.quote(str(session.path))
    outdated = [OUTDATED(name, session=path) for name in chosen if stored[name].is_outdated]
    return Repeat(session.rig.name, comparisons, (*outdated, *findings))


def repeat(folders: Sequence[Path | str], *, name: str | None = None) -> Repeat:
    """Compare the results of independent sessions of one rig.

    Args:
        folders: folders of the sessions.
        name: name of the result to take from each; None for the one in calibration/.

    Raises:
        UsageError: fewer than two sessions, or one given twice.
        SessionError: sessions of different rigs, without a result or with that of another rig, captures in
            two sessions, or no camera and LiDAR in two of them.
    """
    paths = [Path(folder) for folder in folders]
    if len(paths) < 2:
        raise UsageError("a comparison requires two sessions or more, 1 given", "Give two sessions or more.")
    sessions = name_sessions([Session.open(path) for path in paths])
    require_same(sessions)
    require_independent(sessions)
    results = {label: _read(each, result_folder(each.path, name)).pairs for label, each in sessions.items()}
    first_name, first = next(iter(sessions.items()))
    other_boards = [
        OTHER_BOARD(label, first=first_name)
        for label, session in sessions.items()
        if session.rig.board != first.rig.board
    ]
    comparisons, findings = _compare_sensors(results, "sessions")
    return Repeat(first.rig.name, comparisons, (*other_boards, *findings))


def name_sessions(sessions: Sequence[Session]) -> dict[str, Session]:
    """Name sessions by their folder, or by their path if two folders have the same name.

    Raises:
        UsageError: a session is given twice.
    """
    paths = [session.path for session in sessions]
    resolved = [path.resolve() for path in paths]
    for path, where in zip(paths, resolved, strict=True):
        if resolved.count(where) > 1:
            raise UsageError(f"{path} is given twice", "Give independent sessions.")
    short = [path.name for path in resolved]
    names = short if len(set(short)) == len(short) else [str(path) for path in paths]
    return dict(zip(names, sessions, strict=True))


def require_same(sessions: Mapping[str, Session]) -> None:
    """Refuse sessions of different rigs, or with other intrinsics.

    Raises:
        SessionError: the rigs or some keys differ; the message names them.
    """
    (first_name, first), *others = sessions.items()
    for name, session in others:
        if session.rig.name != first.rig.name:
            raise SessionError(
                f"{first_name} belongs to rig {first.rig.name!r}, {name} to rig {session.rig.name!r}",
                "Give sessions of one rig.",
            )
        keys = [str(key) for key in differing_keys(first.rig, session.rig) if key.is_of_lens_or_model]
        if keys:
            raise SessionError(
                f"the profiles of {first_name} and {name} differ: {'; '.join(keys[:4])}",
                "Put the same intrinsics into both (rig.yaml of the session) and calibrate again.",
            )


def require_one_board(sessions: Mapping[str, Session]) -> None:
    """Refuse sessions of different boards.

    Raises:
        SessionError: the boards differ.
    """
    (first_name, first), *others = sessions.items()
    for name, session in others:
        if session.rig.board != first.rig.board:
            raise SessionError(f"{name} has another board than {first_name}", "Give sessions of one board.")


def require_independent(sessions: Mapping[str, Session]) -> None:
    """Refuse sessions that share images or scans: a copy always agrees with its original."""
    hashes: dict[str, set[str]] = {name: set() for name in sessions}
    for name, session in sessions.items():
        for capture in session.captures:
            # A damaged capture is reported when it is read.
            with suppress(SessionError):
                hashes[name] |= capture.file_hashes
    for one, other in combinations(hashes, 2):
        if n_shared := len(hashes[one] & hashes[other]):
            raise SessionError(
                f"{one} and {other} share {n_shared} samples: they are not independent",
                "Collect each session separately, with the board mounted again.",
            )


def _compare_sensors(
    results: Mapping[str, Sequence[Calibration]], kind: str, *, are_independent: bool = True
) -> tuple[tuple[Repeatability, ...], list[Finding]]:
    """Compare each camera and LiDAR.

    Returns:
        The comparisons; and those that only one session calibrates, and failed results.

    Raises:
        SessionError: there is nothing to compare.
    """
    groups: dict[tuple[str, str], dict[str, Calibration]] = {}
    for name, calibrations in results.items():
        for c in calibrations:
            groups.setdefault((c.camera, c.lidar), {})[name] = c
    comparisons, findings = [], []
    for (camera, lidar), group in sorted(groups.items()):
        if len(group) > 1:
            comparisons.append(compare_calibrations(group, are_independent=are_independent))
        else:
            findings.append(ONLY_ONE(next(iter(group)), camera=camera, lidar=lidar))
    if not comparisons:
        sensors = {name: ", ".join(f"{c.camera} and {c.lidar}" for c in own) for name, own in results.items()}
        raise SessionError(
            f"no camera and LiDAR are calibrated in two of the {kind}",
            "\n".join(f"{name}: {own or 'its result holds no sensors'}" for name, own in sensors.items()),
        )
    findings += [
        FAILED(name, camera=c.camera, lidar=c.lidar)
        for name, own in results.items()
        for c in own
        if c.verdict == "fail"
    ]
    return tuple(comparisons), findings


def _read(session: Session, folder: Path) -> ResultFile:
    path = folder / RESULT
    saved = read_result(path)
    if saved.rig != session.rig.name:
        raise SessionError(
            f"{path} belongs to rig {saved.rig!r}, its session to rig {session.rig.name!r}",
            "Run `lce-rig calibrate SESSION` again.",
        )
    if any(np.linalg.eigvalsh(c.cov).min() <= 0 for c in saved.pairs):
        raise SessionError(f"{path}: a covariance has no inverse", "Run `lce-rig calibrate SESSION` again.")
    return saved
