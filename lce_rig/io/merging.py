"""Merging of several streams by the rig's time."""

from collections.abc import Iterable, Iterator
from heapq import merge

from lce_rig.core.data import Sample
from lce_rig.core.errors import SourceError
from lce_rig.rig import Rig
from lce_rig.timing.rig_time import rig_time_ns


def merge_by_time(parts: Iterable[Iterable[Sample]], rig: Rig) -> Iterator[Sample]:
    """Yield the samples of all parts, the earliest first; each part's own order is kept.

    Packets of events count by their first timestamp. Only one sample of each part is held.

    Raises:
        SourceError: a part is torn; after everything that the parts hold, it and the others.
    """
    torn: list[SourceError] = []
    keyed = [_keyed(part, rig, torn) for part in parts]
    for _, sample in merge(*keyed, key=lambda pair: pair[0]):
        yield sample
    if torn:
        raise torn[0]


def _keyed(part: Iterable[Sample], rig: Rig, torn: list[SourceError]) -> Iterator[tuple[int, Sample]]:
    time_ns = -(2**62)
    try:
        for sample in part:
            known_ns = rig_time_ns(sample, rig)
            # What carries no timestamp comes right after what it follows.
            time_ns = time_ns if known_ns is None else known_ns
            yield time_ns, sample
    except SourceError as error:
        torn.append(error)
