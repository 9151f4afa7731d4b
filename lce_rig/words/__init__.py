"""Findings in plain English: the only place where a code becomes a sentence.

Each family of codes has a module with a table PHRASES. A phrase is a template over the finding's figures, or
a function where one template does not serve. Text that leaves the program is rendered here.
"""

from lce_rig.words.rendering import (
    Phrase,
    as_json,
    as_line,
    describe,
    enumerated,
    is_renderable,
    not_enough,
    recommend,
    refusal_as_json,
    sentence,
)

__all__ = [
    "Phrase",
    "as_json",
    "as_line",
    "describe",
    "enumerated",
    "is_renderable",
    "not_enough",
    "recommend",
    "refusal_as_json",
    "sentence",
]
