"""The board searched for in a process of its own, while this one reads sensors."""

from dataclasses import replace

from lce_rig.collect.live.worker import Worker
from lce_rig.collect.watching import BoardWatcher, Moment, Sighting
from lce_rig.core.results import Refusal
from lce_rig.rig import Rig
from lce_rig.timing.scan_pairing import Frame

#: How often a picture without a board is searched thoroughly, during which nothing is said.
THOROUGH_S = 3.0
#: How often a scan is searched for other things of the board's size while all that are known are followed.
RESCAN_S = 1.0


class BoardSearch(Worker):
    """A `BoardWatcher` in its process; frames' events, which it has no use for, stay here."""

    def __init__(self, rig: Rig, search_interval_s: float) -> None:
        """Prepare; see `BoardWatcher`."""
        super().__init__("search for the board", _Search, rig, search_interval_s)

    def sight(self, frame: Frame) -> Sighting:
        """Find the board in every picture and scan of a frame.

        Raises:
            LceRigError: the profile cannot be used.
        """
        sighting: Sighting = self.call("sight", replace(frame, events=()))
        return replace(sighting, frame=frame)

    def confirm(self, moment: Moment) -> Moment | Refusal:
        """Search the frame of a moment as `check` does; see `BoardWatcher.confirm`."""
        frame = moment.sighting.frame
        bare = replace(moment.sighting, frame=replace(frame, events=()))
        found: Moment | Refusal = self.call("confirm", replace(moment, sighting=bare))
        if isinstance(found, Refusal):
            return found
        return replace(found, sighting=replace(found.sighting, frame=frame))


class _Search:
    """What runs there: what was searched is not sent back."""

    def __init__(self, rig: Rig, search_interval_s: float) -> None:
        self._watcher = BoardWatcher(
            rig, search_interval_s, thorough_interval_s=THOROUGH_S, rescan_interval_s=RESCAN_S
        )

    def sight(self, frame: Frame) -> Sighting:
        return _without_samples(self._watcher.sight(frame))

    def confirm(self, moment: Moment) -> Moment | Refusal:
        found = self._watcher.confirm(moment)
        if isinstance(found, Moment):
            return replace(found, sighting=_without_samples(found.sighting))
        return found


def _without_samples(sighting: Sighting) -> Sighting:
    return replace(sighting, frame=replace(sighting.frame, images=(), scans=()))
