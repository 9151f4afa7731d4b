"""A session's journal, one event per line."""

from pathlib import Path
from typing import Any

from lce_rig.core.documents import parse_json
from lce_rig.core.limits import MAX_DOCUMENT_BYTES, MAX_FILE_BYTES, open_regular


def read_entries(path: Path) -> list[dict[str, Any]]:
    """List the entries of a journal; lines that are none, such as one torn by a crash, are skipped.

    Args:
        path: its file; one that is not there has no entries.

    Raises:
        OSError: it cannot be read.
        ValueError: it is not a regular file.
    """
    entries: list[dict[str, Any]] = []
    if not path.exists():
        return entries
    with open_regular(path) as file:
        n_left = MAX_FILE_BYTES
        while n_left > 0 and (line := file.readline(min(n_left, MAX_DOCUMENT_BYTES))):
            n_left -= len(line)
            try:
                entry = parse_json(line)
            except ValueError:
                continue
            if isinstance(entry, dict):
                entries.append(entry)
    return entries
