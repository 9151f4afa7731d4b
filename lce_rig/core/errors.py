"""Errors that the user can repair; each states the fault, its place and an action."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from lce_rig.core.bounds import require_file
from lce_rig.core.findings import Finding, Kind, Refusal, Stage
from lce_rig.core.phrasing import as_line

_MAX_REASON = 200


class LceRigError(Exception):
    """Base of every error the user can repair.

    Args:
        what: the fault and its place (file and key, sensor, capture), one line.
        hint: the action; empty if the first line already states it.
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
        what, hint: see `LceRigError`.
        finding: code and figures, if a calibration lacks captures.
    """

    exit_code = 6

    def __init__(self, what: str, hint: str = "", finding: Finding | None = None) -> None:
        super().__init__(what, hint)
        self.finding = finding

    @staticmethod
    def of(finding: Finding) -> "NotEnoughDataError":
        """Return the error that names the missing data and their sensor."""
        subject, advice = f"{finding.subject}: " if finding.subject else "", finding.advice
        # Several causes, a line each, do not form a sentence.
        return NotEnoughDataError(
            subject + finding.text, advice if "\n" in advice else as_line(advice), finding
        )


class ResultRefusedError(LceRigError):
    """A computed result that must not be used."""

    exit_code = 7


class TargetError(LceRigError):
    """A deployment target that cannot be reached or written; it still holds a complete set of files."""

    exit_code = 8


class CommandError(LceRigError):
    """The command run after a deployment failed; the new files are in place."""

    exit_code = 9


@contextmanager
def reading(
    path: Path | str, kind: type[LceRigError] = SourceError, hint: str = "", most_bytes: int | None = None
) -> Iterator[None]:
    """Convert any failure to read a file into one error that names the file.

    Devices, pipes and files that are too large are refused before they are opened.

    Libraries raise errors of many kinds for a damaged file: KeyError, struct.error, RuntimeError and errors
    of their own. An LceRigError passes, as it already names its cause. So do errors that only a bug in
    lce-rig can raise.

    Args:
        path: the file, or words for the message.
        kind: kind of the error.
        hint: an action against content that is damaged or of another kind.
        most_bytes: largest size of a file that is read at once.
    """
    try:
        if isinstance(path, Path):
            require_file(path, most_bytes)
        yield
    except LceRigError:
        raise
    except MemoryError as error:
        raise kind(f"{path}: needs more memory than one file may take", hint) from error
    except OSError as error:
        raise kind(f"{path}: cannot be read: {reason_of(error)}") from error
    except Exception as error:
        if _is_bug(error):
            raise
        raise kind(f"{path}: {reason_of(error)}", hint) from error


def _is_bug(error: Exception) -> bool:
    """Check whether an error comes from a bug in the program rather than from a file."""
    if isinstance(error, AttributeError):
        # Contents of files have types of Python and NumPy.
        owner = error.obj if isinstance(error.obj, ModuleType | type) else type(error.obj)
        home = owner.__name__ if isinstance(owner, ModuleType) else owner.__module__
        return home.partition(".")[0] == __package__.partition(".")[0]
    return isinstance(error, NameError | AssertionError) and _raised_here(error)


def _raised_here(error: Exception) -> bool:
    """Check whether this package, not a library, raised an error."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    name = "" if trace is None else str(trace.tb_frame.f_globals.get("__name__", ""))
    return name.partition(".")[0] == __package__.partition(".")[0]


def reason_of(error: Exception) -> str:
    """Describe a library's error in one short, printable line."""
    text = str(error.strerror or error) if isinstance(error, OSError) else str(error)
    text = " ".join(text.encode(errors="replace").decode().split())
    text = "".join(character for character in text if character.isprintable())
    if isinstance(error, KeyError):
        text = f"it lacks {text}"
    elif not isinstance(error, ValueError | OSError) or not text:
        text = f"it is damaged ({type(error).__name__}{': ' if text else ''}{text})"
    return text if len(text) <= _MAX_REASON else text[: _MAX_REASON - 3] + "..."


def join_shortages(errors: Sequence[NotEnoughDataError]) -> NotEnoughDataError:
    """Merge one or more errors: the first, with the others in its hint."""
    first, *others = errors
    hint = "\n".join([first.hint, *map(str, others)]).strip()
    return NotEnoughDataError(first.what, hint, first.finding)


_ERRORS: dict[Stage, Kind] = {
    stage: Kind(f"{stage}.error", "{what}", "{hint}") for stage in ("read", "image", "lidar")
}


def refusal_of(stage: Stage, error: LceRigError, otherwise: str = "collect this placement again") -> Refusal:
    """Return the refusal of a capture for an error raised about it.

    Args:
        stage: stage of the error.
        error: the cause.
        otherwise: the action for unreadable data, if the error names none.
    """
    return _ERRORS[stage].refusal(what=error.what, hint=error.hint or (otherwise if stage == "read" else ""))
