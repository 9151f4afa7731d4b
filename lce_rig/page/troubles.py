"""What goes wrong with the page: logged once for each kind, counted, and reported at the end."""

import logging
from collections import Counter
from types import TracebackType

from aiohttp.http_exceptions import HttpProcessingError

#: Kinds that are counted separately; clients may cause any number.
_MAX_KINDS = 20
_MAX_TEXT = 120
# asyncio reports by itself what its connections trip over.
_LOGS = ("lce_rig.preview", "asyncio")


class Troubles(logging.Filter):
    """Counts the page's troubles; while its `with` block lasts, each kind reaches the log once.

    What strangers send wrongly is not logged; connections refused or closed are only counted.
    """

    def __init__(self) -> None:
        super().__init__()
        self.log = logging.getLogger(_LOGS[0])
        self._failures: Counter[str] = Counter()
        self._counts: Counter[str] = Counter()

    def count(self, what: str) -> None:
        """Count one of `what`, the words with which the number is reported at the end."""
        self._counts[what] += 1

    def filter(self, record: logging.LogRecord) -> bool:
        """Let the first of each kind of failure through to the log."""
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, HttpProcessingError):
            return False
        text = record.getMessage() if error is None else f"{record.msg}: {error!r}"
        kind = text.partition("\n")[0][:_MAX_TEXT]
        if kind not in self._failures and len(self._failures) == _MAX_KINDS:
            kind = "other failures"
        self._failures[kind] += 1
        return self._failures[kind] == 1

    def notes(self) -> list[str]:
        """Report what happened and how often."""
        counted = [f"{n} {what}" for what, n in self._counts.items()]
        failed = [f"{kind} ({n} times)" if n > 1 else kind for kind, n in self._failures.items()]
        return [f"preview: {text}" for text in counted + failed]

    def __enter__(self) -> "Troubles":
        """Watch the logs."""
        for name in _LOGS:
            logging.getLogger(name).addFilter(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the logs alone again."""
        for name in _LOGS:
            logging.getLogger(name).removeFilter(self)
