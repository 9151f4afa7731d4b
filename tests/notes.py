"""Facts in what was noted: figures, names of files and topics, the one word that tells causes apart."""

import re


def has_note(notes, *facts):
    """Tell whether one note holds all of these facts, each whole: "1 scans" is not in "11 scans"."""
    patterns = [re.compile(rf"(?<![\w.]){re.escape(fact)}(?!\w)") for fact in facts]
    return any(all(pattern.search(note) for pattern in patterns) for note in notes)
