"""The moments of a recording that are worth a capture."""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field

from lce_rig.collect.event_moment import MotionOptions
from lce_rig.collect.event_pictures import with_event_pictures
from lce_rig.collect.motion import find_moving_moments
from lce_rig.collect.novelty import Placements
from lce_rig.collect.stillness import StillnessOptions, find_still_moments
from lce_rig.collect.tally import Tally
from lce_rig.collect.watching import BoardWatcher, ImageKey, Moment
from lce_rig.core.data import Image, Sample, Stream
from lce_rig.core.results import Refusal
from lce_rig.rig import Rig
from lce_rig.timing.scan_pairing import PairingCounts, pair_by_time

# How often an image without a board is searched thoroughly, which takes most of a second.
_THOROUGH_S = 1.0


@dataclass
class MomentSearch:
    """Finds moments in a stream of samples: by stillness or, where there are events, by motion.

    A camera that sends events and no pictures is watched in pictures reconstructed as the stream runs.

    Attributes:
        rig: the profile.
        streams: what the recording holds.
        stillness: when a board stands still; None takes the profile's `quality.max_motion_m`.
        motion: how a moving board is judged.
        min_move_m, min_turn_deg: how far placements of a moving board must be apart.
    """

    rig: Rig
    streams: Collection[Stream]
    stillness: StillnessOptions | None
    motion: MotionOptions
    min_move_m: float
    min_turn_deg: float
    _pairing: PairingCounts = field(default_factory=PairingCounts)
    _tally: Tally = field(default_factory=Tally)

    @property
    def has_events(self) -> bool:
        """Whether events are kept with captures, so that the board has to move."""
        return any(stream.kind == "events" for stream in self.streams)

    @property
    def reconstructed(self) -> frozenset[ImageKey]:
        """(camera, channel) of the pictures that are made of events to watch the board."""
        with_pictures = {stream.sensor for stream in self.streams if stream.kind == "pictures"}
        return frozenset(
            (stream.sensor, stream.channel)
            for stream in self.streams
            if stream.kind == "events" and stream.sensor not in with_pictures
        )

    def moments(self, samples: Iterable[Sample]) -> Iterator[Moment]:
        """Yield the moments of a stream, as `find_still_moments` or `find_moving_moments` define them.

        Raises:
            ProfileError: the profile's network cannot be used.
            SourceError: as the samples do.
        """
        cameras = {camera for camera, _ in self.reconstructed}
        if cameras:
            samples = with_event_pictures(samples, self.rig, cameras, self._tally)
        stillness = self.stillness or StillnessOptions(max_motion_m=self.rig.quality.max_motion_m)
        interval_s = self.motion.search_interval_s if self.has_events else stillness.search_interval_s
        watcher = BoardWatcher(self.rig, interval_s, self._tally, _THOROUGH_S)
        frames = pair_by_time(samples, self.rig, self._pairing)
        sightings = (watcher.sight(frame) for frame in frames)
        if self.has_events:
            taken = Placements(self.min_move_m, self.min_turn_deg)
            moments = find_moving_moments(sightings, self.rig, self.motion, taken, self._tally)
        else:
            moments = find_still_moments(sightings, self.rig.board.to_board(), stillness)
        for moment in moments:
            confirmed = watcher.confirm(moment)
            if isinstance(confirmed, Refusal):
                self._tally.add(confirmed)
            else:
                yield confirmed

    def kept_images(self, moment: Moment) -> list[Image]:
        """List the pictures of a moment that its capture keeps: all but those that its events give again."""
        images = moment.sighting.frame.images
        return [image for image in images if (image.sensor, image.channel) not in self.reconstructed]

    def counts(self) -> Tally:
        """Count what became no moment so far."""
        # Why a picture could not be made of events is in the tally.
        n_alone = 0 if self.reconstructed else self._pairing.n_alone
        total = Tally()
        total.add(Refusal("read.no_image_at_scan"), n_alone)
        total.update(self._tally)
        return total

    def notes(self) -> list[str]:
        """Say how scans and pictures came together."""
        if self._pairing.n_alone == 0 or self.reconstructed:
            return []
        if self._pairing.nearest_ns is None:
            return ["no picture could be compared with a scan: one of the two has none"]
        apart_s = self._pairing.nearest_ns * 1e-9
        return [f"{self._pairing.n_alone} scans without a picture; the nearest was {apart_s:.3f} s away"]
