"""Why a session of a fleet has no result."""

from lce_rig.words.rendering import Phrase

PHRASES = {
    "fleet.profile": Phrase("{what}", "{hint}"),
    "fleet.session": Phrase("{what}", "{hint}"),
    "fleet.source": Phrase("{what}", "{hint}"),
    "fleet.not_enough_data": Phrase("{what}", "{hint}"),
    "fleet.refused": Phrase("{what}", "{hint}"),
    "fleet.usage": Phrase("{what}", "{hint}"),
    "fleet.other_error": Phrase("{what}", "{hint}"),
    "fleet.bug": Phrase("a bug in lce-rig: {what}", "report it with the session"),
    "fleet.timed_out": Phrase(
        "not done after {limit_s:.0f} s (limit)",
        "set a larger --time-limit and add --retry, or take the session apart",
    ),
    "fleet.out_of_memory": Phrase(
        "needs more than {limit_mb:.0f} MB of memory (limit)",
        "set a larger --memory-limit and add --retry, or take the session apart",
    ),
    "fleet.signal": Phrase("its process was ended by signal {signal}: {what}", "calibrate the session alone"),
    "fleet.exited": Phrase("its process ended with exit code {code}: {what}", "calibrate the session alone"),
    "fleet.worker_lost": Phrase(
        "{n} workers were lost with it", "run again; if it stays, calibrate the session alone"
    ),
}
