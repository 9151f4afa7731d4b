"""Phrases for texts of earlier versions."""

from lce_rig.words.rendering import Phrase

PHRASES: dict[str, Phrase] = {
    "verdict.text": Phrase("{text}", "{advice}"),
}
