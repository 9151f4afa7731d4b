"""One camera and one LiDAR of a session: what both saw -> estimate -> examination, before it is judged."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from lce_rig.calibrate import (
    CalibrateOptions,
    CalibrationEstimate,
    CaptureCandidates,
    ChannelsEstimate,
    Clocks,
    calibrate_channels,
)
from lce_rig.calibrate.consensus import find_consensus
from lce_rig.calibrate.examination import Examination, examine
from lce_rig.calibrate.intrinsics_estimate import View
from lce_rig.calibrate.shared_scans import take_apart
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.results import ImageBoard, Refusal
from lce_rig.detect.detection import Detections, Pair
from lce_rig.pipeline.progress import Progress
from lce_rig.rig import Rig
from lce_rig.words import sentence


@dataclass(frozen=True, eq=False)
class Solved:
    """The extrinsic of one camera with one LiDAR.

    Attributes:
        pairs: channels of the camera with the LiDAR.
        options: of the algorithm, with what the profile says of the LiDAR.
        refused: why captures were of no use before they came to the estimate.
        result: what each channel says.
        examination: the estimate, and what checks on its captures found.
    """

    pairs: tuple[Pair, ...]
    options: CalibrateOptions
    refused: Mapping[str, Refusal]
    result: ChannelsEstimate
    examination: Examination

    @property
    def camera(self) -> str:
        """Its name."""
        return self.pairs[0].camera

    @property
    def lidar(self) -> str:
        """Its name."""
        return self.pairs[0].lidar

    @property
    def estimate(self) -> CalibrationEstimate:
        """The estimate, its covariance widened where that was needed."""
        return self.examination.estimate

    @property
    def widened_by(self) -> float:
        """By how many times the examination widened the method's standard deviations; 1 where it did not."""
        return self.estimate.diagnostics.get("sigma_widened", 1.0)

    @property
    def is_still(self) -> bool:
        """Whether boards stood still, so that pictures count as they are, whenever they were taken."""
        return all(channel.time_offset_s is None for channel in self.result.channels)


def solve(
    rig: Rig, detections: Detections, pairs: Sequence[Pair], options: CalibrateOptions, progress: Progress
) -> Solved:
    """Estimate the extrinsic of one camera and LiDAR, and check it on its captures.

    Args:
        rig: thresholds, targets, lens and board.
        detections: of one session.
        pairs: channels of the camera with the LiDAR.
        options: switches of the algorithm.
        progress: called with (done, total).

    Raises:
        NotEnoughDataError: too few captures, or they leave a direction open.
    """
    candidates, refused = _usable(rig, detections, pairs)
    camera, lidar = pairs[0].camera, pairs[0].lidar
    settings = rig.lidars[lidar]
    options = replace(
        options,
        laser_bias_sigma_m=settings.laser_bias_sigma_m,
        range_offset_sigma_m=settings.range_offset_sigma_m,
    )
    clocks = clocks_of(rig, camera, lidar)
    result = calibrate_channels(candidates, rig.board.to_board(), options, clocks, progress)
    examination = examine_pairs(rig, detections, pairs, result)
    return Solved(tuple(pairs), options, refused, result, examination)


def examine_pairs(
    rig: Rig, detections: Detections, pairs: Sequence[Pair], result: ChannelsEstimate
) -> Examination:
    """Check the result of a camera's channels with a LiDAR on its own captures."""
    lens = rig.cameras[pairs[0].camera].to_intrinsics()
    views = _views(detections, pairs, result)
    return examine(result.estimate, rig, rig.lidars[pairs[0].lidar], lens, views)


def _views(detections: Detections, pairs: Sequence[Pair], result: ChannelsEstimate) -> list[View]:
    """List the pictures of the captures behind an extrinsic, of the channels that gave it."""
    used = sorted(take_apart(result.estimate.used))
    channels = {channel.channel for channel in result.channels}
    views = []
    for name in used:
        for pair in pairs:
            image = detections.images[pair.camera, pair.channel].get(name)
            if pair.channel in channels and isinstance(image, ImageBoard):
                views.append(View(name, pair.channel, image))
    return views


def _usable(
    rig: Rig, detections: Detections, pairs: Sequence[Pair]
) -> tuple[dict[str, list[CaptureCandidates]], dict[str, Refusal]]:
    """Gather the candidates of each channel that has captures enough, and refusals of captures of no use.

    Raises:
        NotEnoughDataError: no channel has.
    """
    candidates: dict[str, list[CaptureCandidates]] = {}
    refused: dict[str, Refusal] = {}
    needed = rig.quality.min_captures
    trouble: NotEnoughDataError | None = None
    for pair in pairs:
        own, own_refused = _candidates(detections, pair)
        refused |= {name: why for name, why in own_refused.items() if name not in refused}
        if len(own) >= needed:
            candidates[pair.channel] = own
        elif trouble is None:
            trouble = NotEnoughDataError(
                f"{pair}: the board was found by both sensors in {len(own)} of "
                f"{len(own) + len(own_refused)} captures, at least {needed} are needed",
                _commonest(own_refused) or "collect more captures",
            )
    if not candidates and trouble is not None:
        raise trouble
    found = {item.capture for items in candidates.values() for item in items}
    return candidates, {name: why for name, why in refused.items() if name not in found}


def clocks_of(rig: Rig, camera: str, lidar: str) -> Clocks:
    """Read what the profile says of the time of a camera and a LiDAR."""
    stamps = {name: channel.timestamps for name, channel in rig.cameras[camera].channels.items()}
    return Clocks(
        sweep_s=1 / rig.lidars[lidar].rate_hz,
        lidar_offset_s=rig.lidars[lidar].timestamps.expected_offset_s,
        channel_offset_s={name: settings.expected_offset_s for name, settings in stamps.items()},
        tolerance_s={name: settings.tolerance_s for name, settings in stamps.items()},
    )


def _candidates(detections: Detections, pair: Pair) -> tuple[list[CaptureCandidates], dict[str, Refusal]]:
    candidates, refused = [], {}
    for name in detections.captures(pair):
        image, lidar = detections.of(pair, name)
        if isinstance(image, Refusal):
            refused[name] = image
        elif isinstance(lidar, Refusal):
            refused[name] = lidar
        else:
            candidates.append(CaptureCandidates(name, image, lidar))
    return candidates, refused


def refusals_of(rig: Rig, detections: Detections, pair: Pair) -> dict[str, Refusal]:
    """Say why captures of a pair cannot be used: a sensor saw no board, or both sensors disagree."""
    candidates, refused = _candidates(detections, pair)
    consensus = find_consensus(candidates, rig.board.to_board()) if len(candidates) >= 3 else None
    return dict(sorted({**refused, **(consensus.refused if consensus else {})}.items()))


def _commonest(refused: dict[str, Refusal]) -> str:
    """List the commonest causes of refusal, one a line."""
    counts = Counter(f"{why.stage}: {sentence(why)}" for why in refused.values())
    return "\n".join(f"{n} x {text}" for text, n in counts.most_common(3))
