"""The clock on which a rig's streams meet, and how far apart on it the parts of a capture are."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from lce_rig.core.data import Events, Image, LiveSample, Scan
from lce_rig.core.findings import Finding
from lce_rig.rig import Rig
from lce_rig.timing.clock import ClockModel
from lce_rig.timing.rig_time import rig_time_ns
from lce_rig.timing.scan_pairing import Frame, middle_of_sweep_ns

# A board that a person moves by hand, in haste.
BOARD_SPEED_MPS = 1.0


@dataclass(frozen=True)
class PairTime:
    """How far a part of a capture lies from its scan in time, and how well that is known.

    Attributes:
        stream: the other part: "cam.frames", or a second LiDAR.
        lidar: the LiDAR whose scan it was paired with.
        difference_ns: the other's time minus the middle of the scan, on the rig's clock.
        sigma_ns: standard deviation of that, from the clock models; None where a clock is not tied.
        tolerance_ns: largest difference that the profile allows.
        clock: the models behind it, in words.
    """

    stream: str
    lidar: str
    difference_ns: int
    sigma_ns: float | None
    tolerance_ns: int
    clock: str

    def to_meta(self) -> dict[str, object]:
        """Give it as the manifest of a capture keeps it."""
        sigma_s = None if self.sigma_ns is None else round(self.sigma_ns * 1e-9, 9)
        return {
            "stream": self.stream,
            "lidar": self.lidar,
            "difference_s": round(self.difference_ns * 1e-9, 9),
            "sigma_s": sigma_s,
            "tolerance_s": self.tolerance_ns * 1e-9,
            "clock": self.clock,
        }


@dataclass(frozen=True)
class SyncVerdict:
    """Whether boards must stand still while they are captured.

    Attributes:
        requires_still_boards: whether they must.
        reasons: why; empty where they may move.
    """

    requires_still_boards: bool
    reasons: tuple[Finding, ...]

    @property
    def finding(self) -> Finding:
        """What the verdict says by itself, without the reasons."""
        return Finding(
            "sync.boards_must_stand" if self.requires_still_boards else "sync.boards_may_move", "note"
        )


class CommonClock:
    """The rig's clock, and the models from the sensors' clocks to it."""

    def __init__(self, models: Mapping[str, ClockModel] | None = None) -> None:
        """Begin with the models that are known.

        Args:
            models: by the sensor's name, from its clock to the rig's.
        """
        self._models = dict(models or {})

    def tie(self, sensor: str, model: ClockModel) -> None:
        """Take a new model for a sensor; what was placed before keeps its time."""
        self._models[sensor] = model

    def untie(self, sensor: str) -> None:
        """Forget a sensor's model: its clock has jumped, or its board has restarted."""
        self._models.pop(sensor, None)

    def model(self, sensor: str) -> ClockModel | None:
        """Give a sensor's model; None where it is not tied."""
        return self._models.get(sensor)

    def place(self, sample: LiveSample) -> LiveSample:
        """Give a sample with its timestamps on the rig's clock; as it is where its sensor is not tied."""
        model = self._models.get(sample.sensor)
        if model is None:
            return sample
        if isinstance(sample, Events):
            return replace(sample, t_ns=model.convert_all(sample.t_ns))
        if sample.stamp_ns is None:
            return sample
        return replace(sample, stamp_ns=model.convert(sample.stamp_ns))

    def sigma_ns(self, sensor: str, time_ns: int) -> float | None:
        """Give a timestamp's standard deviation at a time of the rig's clock; None where not tied."""
        model = self._models.get(sensor)
        return None if model is None else model.inverse().sigma_ns(time_ns)


def pair_times(frame: Frame, rig: Rig, clock: CommonClock) -> list[PairTime]:
    """Measure how far the images and further scans of a frame lie from its first scan.

    Args:
        frame: its samples' timestamps are on the rig's clock.
        rig: says what to add to timestamps, and how far pairs may lie apart.
        clock: how the timestamps came there.
    """
    anchor = frame.scans[0]
    parts: list[tuple[str, int | None, Image | Scan]] = [
        (f"{image.sensor}.{image.channel}", rig_time_ns(image, rig), image) for image in frame.images
    ]
    parts += [(scan.sensor, middle_of_sweep_ns(scan, rig), scan) for scan in frame.scans[1:]]
    return [
        _pair_time(name, time_ns, part, anchor, frame.time_ns, rig, clock)
        for name, time_ns, part in parts
        if time_ns is not None
    ]


def judge_sync(rig: Rig, clock: CommonClock | None = None) -> SyncVerdict:
    """Judge whether the sensors' times are good enough for boards that move.

    A board that is carried moves by a metre in a second: the times must be known to within
    quality.max_motion_m / (1 m/s).

    Args:
        rig: says which sensors are synchronised.
        clock: how well they are; None where only the profile is known.
    """
    limit_ns = rig.quality.max_motion_m / BOARD_SPEED_MPS * 1e9
    sensors = [(name, f"lidars.{name}", lidar.timestamps) for name, lidar in rig.lidars.items()]
    for name, camera in rig.cameras.items():
        for channel, given in camera.channels.items():
            sensors.append((name, f"cameras.{name}.channels.{channel}", given.timestamps))
    reasons: list[Finding] = []
    for name, key, timestamps in sensors:
        model = None if clock is None else clock.model(name)
        if timestamps.sync == "none":
            reasons.append(
                Finding("sync.none_in_profile", "warning", name, {"key": f"{key}.timestamps.sync"})
            )
        elif clock is not None and model is None:
            reasons.append(Finding("sync.not_tied", "warning", name))
        elif model is not None and model.sigma_ns(model.last_ns) > limit_ns:
            figures = {"sigma_ms": model.sigma_ns(model.last_ns) / 1e6, "limit_ms": limit_ns / 1e6}
            reasons.append(Finding("sync.too_uncertain", "warning", name, figures))
    # Channels of one camera share its clock.
    unique = tuple(found for index, found in enumerate(reasons) if found not in reasons[:index])
    return SyncVerdict(bool(unique), unique)


def _pair_time(
    name: str, time_ns: int, part: Image | Scan, anchor: Scan, anchor_ns: int, rig: Rig, clock: CommonClock
) -> PairTime:
    sigmas = [clock.sigma_ns(sensor, anchor_ns) for sensor in (part.sensor, anchor.sensor)]
    known = [sigma for sigma in sigmas if sigma is not None]
    if isinstance(part, Image):
        tolerance_s = rig.cameras[part.sensor].channels[part.channel].timestamps.tolerance_s
    else:
        tolerance_s = rig.lidars[part.sensor].timestamps.tolerance_s
    tolerance_s = max(tolerance_s, rig.lidars[anchor.sensor].timestamps.tolerance_s)
    words = [
        f"{sensor}: {clock.model(sensor) or 'its own timestamps'}" for sensor in (part.sensor, anchor.sensor)
    ]
    return PairTime(
        stream=name,
        lidar=anchor.sensor,
        difference_ns=time_ns - anchor_ns,
        sigma_ns=sum(sigma**2 for sigma in known) ** 0.5 if len(known) == len(sigmas) else None,
        tolerance_ns=round(tolerance_s * 1e9),
        clock="; ".join(words),
    )
