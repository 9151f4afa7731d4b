"""Collect recordings into a session, from paths or your own readers."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lce_rig.collect.offline import collect
from lce_rig.core.errors import NotEnoughDataError, UsageError
from lce_rig.core.findings import Losses
from lce_rig.core.progress import Progress, silent
from lce_rig.io import open_recordings
from lce_rig.io.recording import Recording, SourceOptions
from lce_rig.rig import Rig
from lce_rig.session import Session

Source = Path | str | Recording


def collect_from(
    rig: Rig,
    recordings: Source | list[Source] | tuple[Source, ...],
    session: Path | str,
    *,
    n_wanted: int | None = None,
    sources: SourceOptions | Sequence[SourceOptions] | None = None,
    progress: Progress = silent,
) -> Session:
    """Build or continue a session from recordings.

    Args:
        rig: the profile.
        recordings: paths of folders, bags and files, or readers with the attributes of `Recording`; several
            simultaneous ones are read as one.
        session: its folder.
        n_wanted: number of captures in the session at which to stop; None to read everything.
        sources: options for reading the paths: one for all, or one per path.
        progress: called with (done, total) samples.

    Returns:
        The session, open for reading.

    Raises:
        SourceError: a recording cannot be read to its end; captures before it are kept.
        SessionError: the folder is not a session, or cannot be written.
        NotEnoughDataError: no capture could be made; the most frequent causes are named.
        UsageError: `sources` and recordings differ in number.
    """
    given: list[Source] = [*recordings] if isinstance(recordings, list | tuple) else [recordings]
    sources = sources or SourceOptions()
    by_path = [sources] * len(given) if isinstance(sources, SourceOptions) else sources
    if len(by_path) != len(given):
        what = f"{len(by_path)} sources for {len(given)} recordings"
        raise UsageError(what, "Give one for all, or one for each.")
    opened: list[Recording] = []
    for source, how in zip(given, by_path, strict=True):
        part = replace(how, is_part=len(given) > 1)
        opened += open_recordings([Path(source)], rig, part) if isinstance(source, str | Path) else [source]
    with Session.resume(session, rig) as writer:
        report = collect(writer, opened, n_wanted, progress)
    if report.errors:
        raise report.errors[0]
    filled = Session.open(session)
    if not filled.captures:
        refused = Losses()
        refused.update(report.counts)
        for refusal in report.refused.values():
            refused.add(refusal)
        causes = "\n".join(f"{n} x {why.text}" for why, n in refused.counts()[:3])
        raise NotEnoughDataError(f"{session}: no capture could be made", causes)
    return filled
