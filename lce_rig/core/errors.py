"""Errors that the user can repair; each states what happened, where, and an action."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from lce_rig.core.findings import Finding, Kind, Refusal, Stage
from lce_rig.core.phrasing import as_line


class LceRigError(Exception):
    """Base of every error the user can repair.

    Args:
        what: what is wrong and where (file and key, sensor, capture), one line.
        hint: what to do about it; empty if `what` says it already.
    """

    exit_code = 1

    def __init__(self, what: str, hint: str = "") -> None:
        super().__init__(what)
        self.what = what
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.what}\n  {self.hint}" if self.hint else self.what


class UsageError(LceRigError):
    """An invalid command line."""

    exit_code = 2


class ProfileError(LceRigError):
    """A rig profile that cannot be used."""

    exit_code = 3


class SessionError(LceRigError):
    """A session folder that cannot be read, written or continued."""

    exit_code = 4


class SourceError(LceRigError):
    """A sensor, recording or dependency that cannot be read."""

    exit_code = 5


class NotEnoughDataError(LceRigError):
    """Too few captures, or captures that leave a direction undetermined.

    Args:
        what: as of every error.
        hint: as of every error.
        finding: the same as code and figures, where a calibration lacks captures.
    """

    exit_code = 6

    def __init__(self, what: str, hint: str = "", finding: Finding | None = None) -> None:
        super().__init__(what, hint)
        self.finding = finding

    @staticmethod
    def of(finding: Finding) -> "NotEnoughDataError":
        """Make the error that names the missing data and their sensor."""
        subject, advice = f"{finding.subject}: " if finding.subject else "", finding.advice
        # Several causes, a line each, are no sentence.
        return NotEnoughDataError(
            subject + finding.text, advice if "\n" in advice else as_line(advice), finding
        )


class ResultRefusedError(LceRigError):
    """A computed result that must not be used."""

    exit_code = 7


class TargetError(LceRigError):
    """A target of a deployment that cannot be reached or written; it holds a whole set of files."""

    exit_code = 8


class CommandError(LceRigError):
    """The command after a deployment failed; the new files are in place."""

    exit_code = 9


@contextmanager
def reading(path: Path, kind: type[LceRigError], hint: str = "") -> Iterator[None]:
    """Turn what prevents a block from reading a file into an error of one kind that names the file.

    Args:
        path: the file.
        kind: of the error raised for an OSError, and for a ValueError, whose words follow the file's name.
        hint: what to do about content that is not what it should be.
    """
    try:
        yield
    except OSError as error:
        raise kind(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise kind(f"{path}: {error}", hint) from error


def join_shortages(errors: Sequence[NotEnoughDataError]) -> NotEnoughDataError:
    """Make one error of at least one: the first, with the others in its hint."""
    first, *others = errors
    hint = "\n".join([first.hint, *map(str, others)]).strip()
    return NotEnoughDataError(first.what, hint, first.finding)


def _hint_or(otherwise: str) -> Callable[[Finding], str]:
    def hint(finding: Finding) -> str:
        return str(finding.figures["hint"] or otherwise)

    hint.__doc__ = f"{{hint}}, else: {otherwise}."
    return hint


_ERRORS: dict[Stage, Kind] = {
    "read": Kind(
        "read.error",
        "{what}",
        _hint_or("collect this placement again"),
        actions={"record": _hint_or("record it again")},
    ),
    "image": Kind("image.error", "{what}", "{hint}"),
    "lidar": Kind("lidar.error", "{what}", "{hint}"),
}


def refusal_of(stage: Stage, error: LceRigError, action: str = "") -> Refusal:
    """Refuse a capture for an error that was raised about it."""
    return _ERRORS[stage].refusal(what=error.what, hint=error.hint, action=action)
