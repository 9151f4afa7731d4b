"""Check notes for facts: figures, names of files and topics, and the word that identifies a cause."""

import re


def has_note(notes, *facts):
    """Check whether one note holds all of these facts as whole words: "1 scans" is not in "11 scans"."""
    patterns = [re.compile(rf"(?<![\w.]){re.escape(fact)}(?!\w)") for fact in facts]
    return any(all(pattern.search(note) for pattern in patterns) for note in notes)
