"""The recurrent network that reconstructs images from events, at any requested time of a stream."""

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events, Image, join_events
from lce_rig.core.errors import SourceError, UsageError
from lce_rig.core.findings import Refusal
from lce_rig.core.interrupts import without_interrupt
from lce_rig.detect.events.windows import (
    FloatArray,
    NoiseFilter,
    WindowRule,
    active_share,
    normalise_voxels,
    voxel_grid,
)
from lce_rig.detect.findings import (
    READ_NETWORK_SETTLING,
    READ_NO_EVENTS,
    READ_OUTSIDE_EVENTS,
)

States = tuple[FloatArray, ...]

SHIPPED_NETWORK = Path(__file__).parents[2] / "models" / "reconstruction.onnx"


class ReconstructionModel:
    """The recurrent event-to-image network in ONNX, its state explicit.

    Args:
        path: ONNX file of the network.

    Raises:
        SourceError: onnxruntime is not installed.
    """

    def __init__(self, path: Path = SHIPPED_NETWORK) -> None:
        try:
            with without_interrupt():
                import onnxruntime
        except ImportError as error:
            raise SourceError("onnxruntime is not installed", "Run: pip install onnxruntime") from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.log_severity_level = 4
        providers = ["CPUExecutionProvider"]
        self._session = onnxruntime.InferenceSession(path.read_bytes(), options, providers=providers)
        voxels, *states = self._session.get_inputs()
        # (1, bins, "height", "width"), and (1, channels, "height_2", "width_2") of a state at half size.
        self.n_bins = int(voxels.shape[1])
        self._states = [(int(each.shape[1]), int(each.shape[2].partition("_")[2])) for each in states]
        # The image is padded so that every state has a whole number of rows and columns.
        self._multiple = math.lcm(*(divisor for _, divisor in self._states))

    def initial_states(self, height_px: int, width_px: int) -> States:
        """Return the states before the first window for a sensor of this size: zeros."""
        height, width = self._padded(height_px), self._padded(width_px)
        return tuple(
            np.zeros((1, n_channels, height // divisor, width // divisor), np.float32)
            for n_channels, divisor in self._states
        )

    def step(self, voxels: FloatArray, states: States) -> tuple[FloatArray, States]:
        """Reconstruct one window.

        Args:
            voxels: (bins, H, W) normalised voxel grid.
            states: those returned by the last step, or by `initial_states`.

        Returns:
            image (H, W), arbitrary scale; next states.
        """
        _, height, width = voxels.shape
        rows, cols = self._padded(height) - height, self._padded(width) - width
        names = (item.name for item in self._session.get_inputs())
        grid = np.pad(voxels, ((0, 0), (0, rows), (0, cols)))[None]
        outputs = self._session.run(None, dict(zip(names, (grid, *states), strict=True)))
        image, *following = (np.asarray(array, np.float32) for array in outputs)
        return image[0, 0, :height, :width], tuple(following)

    def _padded(self, size_px: int) -> int:
        return -(-size_px // self._multiple) * self._multiple


# Percentiles that map the network's arbitrary scale to 8 bits, without flicker.
_PERCENTILES = (1.0, 99.0)
# Smallest spread that is stretched to the full range: below it is noise, not contrast.
_MIN_SPREAD = 0.05
# Share of the earlier images in the running means of scale and active pixels.
_MEMORY = 0.8


class IntensityScale:
    """Robust minimum and maximum, smoothed over images."""

    def __init__(self) -> None:
        self._smooth: NDArray[np.float64] | None = None

    def follow(self, picture: FloatArray) -> None:
        """Update the scale with the stream's next image, (H, W)."""
        bounds = _bounds(picture)
        if self._smooth is not None:
            bounds = _MEMORY * self._smooth + (1 - _MEMORY) * bounds
        self._smooth = bounds

    def to_grey(self, picture: FloatArray) -> NDArray[np.uint8]:
        """Map (H, W) to uint8."""
        bounds = _bounds(picture) if self._smooth is None else self._smooth
        spread = max(float(bounds[1] - bounds[0]), _MIN_SPREAD)
        darkest = float(bounds.mean()) - spread / 2
        scaled = (picture - darkest) * (255.0 / spread)
        return np.asarray(np.clip(np.rint(scaled), 0, 255), dtype=np.uint8)


def _bounds(picture: FloatArray) -> NDArray[np.float64]:
    # Every fourth pixel in each direction is enough for the percentiles.
    return np.asarray(np.percentile(picture[::4, ::4], _PERCENTILES), dtype=np.float64)


# Minimum fill of a window that is used alone, not merged with the previous one: too few events give noise,
# not edges.
_MIN_FILL = 0.5
# Longest silence that is processed step by step, ns: a longer one is skipped at once, and the states are
# kept.
_LONGEST_SILENCE_NS = 2_000_000_000
# Largest time from a stream's last event to a requested timestamp at its end, ns.
_MAX_AFTER_END_NS = 100_000_000
# Number of steps until the states have settled, on a real DAVIS346 recording.
N_WARM_UP = 12


@dataclass(frozen=True, eq=False)
class _Window:
    """A range of the stream and the states before it."""

    start_ns: int
    events: Events
    states: States


class Reconstructor:
    """Runs the network over one event stream, with a recurrent state for the whole stream.

    Windows depend on the events alone, so that neither the batches in which events arrive nor the requested
    timestamps change the network's state: an image at a timestamp is an extra step from the running state
    with the events up to the timestamp.

    Args:
        channel: the channel of the images.

    Raises:
        SourceError: onnxruntime is not installed.
    """

    def __init__(self, channel: str = "events") -> None:
        self.channel = channel
        self._model = ReconstructionModel()
        self.reset()

    def reset(self) -> None:
        """Forget the stream."""
        self.n_steps = 0
        self._scale = IntensityScale()
        self._share = 1.0
        self._first_ns: int | None = None
        self._fed_ns: int | None = None
        self._previous: _Window | None = None
        self._current: _Window | None = None
        self._noise = NoiseFilter()

    def reconstruct(self, batches: Iterable[Events], stamps_ns: Sequence[int]) -> Iterator[Image | Refusal]:
        """Return one image, or the reason for none, for every timestamp, in the order of the timestamps.

        Args:
            batches: the stream from its beginning, in time order, cut anywhere.
            stamps_ns: times of the images, never decreasing, on the events' clock.

        Raises:
            SourceError: the batches are of different sensors or go back in time.
            UsageError: timestamps out of order.
        """
        if np.any(np.diff(np.asarray(stamps_ns, dtype=np.int64)) < 0):
            raise UsageError("stamps_ns must not decrease")
        self.reset()
        wanted = deque(stamps_ns)
        for batch in filter(len, batches):
            last_ns = self._take(batch)
            while wanted and wanted[0] <= last_ns:
                yield self.picture_at(wanted.popleft())
            self._advance(last_ns)
        for stamp_ns in wanted:
            late_ns = 0 if self._fed_ns is None else stamp_ns - self._fed_ns
            if late_ns <= _MAX_AFTER_END_NS:
                yield self.picture_at(stamp_ns)
            else:
                yield READ_OUTSIDE_EVENTS.refusal(gap_s=1e-9 * late_ns)

    def feed(self, events: Events) -> None:
        """Add the next events of the stream; `picture_at` returns its images.

        Args:
            events: events up to the next requested timestamp at most.

        Raises:
            SourceError: the events are of another sensor or go back in time.
        """
        if len(events):
            self._advance(self._take(events))

    def picture_at(self, stamp_ns: int, *, is_step: bool = False) -> Image | Refusal:
        """Return the image at a timestamp up to which the stream was fed, or the reason for none.

        Args:
            stamp_ns: on the events' clock.
            is_step: end the window there if it is half full, so that the network does not run again over its
                events; later images then depend on the requested timestamps.
        """
        if self._first_ns is None:
            return READ_NO_EVENTS.refusal()
        if stamp_ns <= self._first_ns:
            return READ_OUTSIDE_EVENTS.refusal(gap_s=1e-9 * (self._first_ns - stamp_ns))
        self._advance(stamp_ns)
        if self.n_steps < N_WARM_UP:
            seen_s = 1e-9 * (stamp_ns - self._first_ns)
            return READ_NETWORK_SETTLING.refusal(n_steps=self.n_steps, n_warm_up=N_WARM_UP, seen_s=seen_s)
        window = self._current
        assert window is not None
        events = self._noise.clean(window.events.between(window.start_ns, stamp_ns))
        is_thin = self._rule().fill(len(events), stamp_ns - window.start_ns) < _MIN_FILL
        if is_thin and self._previous is not None:
            events = join_events([self._previous.events, events])
            window = self._previous
        if is_step and not is_thin:
            picture = self._commit(stamp_ns)
        else:
            picture, _ = self._picture(events, window.start_ns, stamp_ns, window.states)
        return Image(events.sensor, self.channel, stamp_ns, self._scale.to_grey(picture))

    def _take(self, batch: Events) -> int:
        """Append a batch to the current window, and return when it ends."""
        last_ns, self._fed_ns = self._fed_ns, int(batch.t_ns[-1])
        if self._current is None:
            self._first_ns = int(batch.t_ns[0])
            states = self._model.initial_states(batch.height_px, batch.width_px)
            self._current = _Window(self._first_ns, batch, states)
            return self._fed_ns
        pending = self._current.events
        size, expected = (batch.width_px, batch.height_px), (pending.width_px, pending.height_px)
        if size != expected:
            raise SourceError(
                f"{batch.sensor}: events of {size} px follow events of {expected} px",
                "Give one sensor's stream.",
            )
        if last_ns is not None and int(batch.t_ns[0]) < last_ns:
            back_s = (last_ns - int(batch.t_ns[0])) / 1e9
            raise SourceError(
                f"{batch.sensor}: events go back in time by {back_s:.6f} s", "Sort the recording."
            )
        self._current = replace(self._current, events=join_events([pending, batch]))
        return self._fed_ns

    def _rule(self) -> WindowRule:
        assert self._current is not None
        events = self._current.events
        return WindowRule.of(events.height_px * events.width_px, self._share)

    def _advance(self, until_ns: int) -> None:
        """Run every step whose window is complete at that time."""
        while self._current is not None:
            events = self._current.events
            if len(events) and int(events.t_ns[0]) - self._current.start_ns > _LONGEST_SILENCE_NS:
                self._current = replace(self._current, start_ns=int(events.t_ns[0]))
            end_ns = self._rule().end(events, self._current.start_ns)
            if end_ns is None or end_ns > until_ns:
                return
            self._commit(end_ns)

    def _commit(self, end_ns: int) -> FloatArray:
        """Close the current window and run its step; the remaining events start the next window."""
        assert self._current is not None
        window = self._current
        events = window.events.between(window.start_ns, end_ns)
        self._noise.learn(events)
        events = self._noise.clean(events)
        picture, states = self._picture(events, window.start_ns, end_ns, window.states)
        self._scale.follow(picture)
        memory = _MEMORY if self.n_steps else 0.0
        self._share = memory * self._share + (1 - memory) * active_share(events)
        self._previous = replace(window, events=events)
        last_ns = int(window.events.t_ns[-1]) + 1 if len(window.events) else end_ns
        self._current = _Window(end_ns, window.events.between(end_ns, max(last_ns, end_ns)), states)
        self.n_steps += 1
        return picture

    def _picture(
        self, events: Events, start_ns: int, end_ns: int, states: States
    ) -> tuple[FloatArray, States]:
        """Compute the image (H, W) at end_ns from the window [start_ns, end_ns) and the states before it."""
        voxels = normalise_voxels(voxel_grid(events, self._model.n_bins, start_ns, end_ns))
        return self._model.step(voxels, states)
