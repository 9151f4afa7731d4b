"""Each sensor: whether it answers and what it is, and whether its stream comes whole and at its rate."""

from dataclasses import dataclass
from textwrap import shorten

from lce_rig.collect.health.check import Check, Severity, worst
from lce_rig.collect.health.examination import Examination
from lce_rig.collect.health.observing import Observation
from lce_rig.collect.health.remarks import as_remedy, remarks
from lce_rig.collect.health.sensors import driver_of
from lce_rig.core.errors import SourceError
from lce_rig.rig import Rig
from lce_rig.sources.live.base import SourceStatus
from lce_rig.sources.live.velodyne_web import WebReport
from lce_rig.words import as_line

# A rotor holds its speed within some tenths of a percent, cameras theirs within a few percent.
_MAX_OFF_RATE = 0.05
_MAX_LOST_SHARE = 0.01
_STOPPED_S = 1.0
_US_PER_S = 1e6
_MAX_COMMAND = 50


def check_device(exam: Examination, sensor: str) -> Check:
    """Say what answers, or why nothing does."""
    seen = exam.seen[sensor]
    if seen.failure is not None:
        what = seen.failure.what
        for name in (
            f"{sensor}: ",
            f"camera {sensor!r}: ",
            f"sync board {sensor!r}: ",
            f"sync board {sensor!r} ",
        ):
            what = what.removeprefix(name)
        return Check(sensor, "device", "red", what, seen.failure.hint)
    assert seen.status is not None  # what neither opened nor failed is a failure of its own
    problems = remarks(seen.status, "device")
    named = seen.status.device or f"answers (driver {driver_of(exam.rig, sensor)})"
    if driver_of(exam.rig, sensor) == "command":
        named = shorten(named, _MAX_COMMAND, placeholder=" ...")
    figure = ", ".join(filter(None, (named, _web_words(exam.web.get(sensor)))))
    return Check(sensor, "device", "yellow" if problems else "green", figure, as_remedy(problems))


def check_stream(exam: Examination, sensor: str) -> Check | None:
    """Hold a LiDAR's or camera's rates against the profile, and count what was lost."""
    seen, rig = exam.seen[sensor], exam.rig
    if seen.status is None:
        return None
    stream = "scans" if sensor in rig.lidars else "frames"
    camera = rig.cameras.get(sensor)
    kinds = {"scans"} if camera is None else {channel.kind for channel in camera.channels.values()}
    findings = [_rate(rig, seen, stream)] if stream in kinds or seen.frames else []
    findings += [_event_rate(seen)] if "events" in kinds else []
    findings.append(_losses(seen.status, len(seen.stamps.get(stream, ()))))
    problems = remarks(seen.status, "stream")
    remedies = as_remedy(problems) or "\n".join(as_line(each.remedy) for each in findings if each.remedy)
    severity = worst(["yellow" if problems else "green", *(each.severity for each in findings)])
    values = {"watched_s": seen.watched_s, "rate_hz": rate_hz(seen, stream), **seen.status.figures}
    values |= {"n_lost": float(seen.status.n_lost), "n_dropped": float(seen.status.n_dropped)}
    if seen.status.n_packets is not None:
        values["n_packets"] = float(seen.status.n_packets)
    figure = ", ".join(each.words for each in findings)
    return Check(sensor, "stream", severity, figure, remedies, values)


def wanted_rate_hz(rig: Rig, sensor: str) -> float | None:
    """Give how many scans or pictures a second the profile wants; None where it does not say."""
    if sensor in rig.lidars:
        return rig.lidars[sensor].rate_hz
    driver = rig.cameras[sensor].driver
    # Pulses cannot trigger a DAVIS, which keeps an interval of its own.
    if driver_of(rig, sensor) == "davis":
        interval_us = driver.controls.get("frame_interval_us", 0)
        return _US_PER_S / interval_us if isinstance(interval_us, int | float) and interval_us > 0 else None
    if rig.sync is not None and sensor in rig.sync.triggers:
        return rig.sync.triggers[sensor].rate_hz
    return driver.frame_rate_hz


def rate_hz(seen: Observation, stream: str) -> float:
    """Measure how many a second came; 0 where fewer than two did.

    A LiDAR's is its rotor's speed, by its own clock: scans arrive late on a busy computer.
    """
    rotor_hz = 0.0 if seen.status is None else seen.status.rates_hz.get("scans", 0.0)
    if stream == "scans" and seen.stamps.get(stream) and rotor_hz > 0:
        return rotor_hz
    _, arrivals = seen.times(stream)
    span_ns = int(arrivals[-1] - arrivals[0]) if len(arrivals) > 1 else 0
    return 1e9 * (len(arrivals) - 1) / span_ns if span_ns > 0 else 0.0


@dataclass(frozen=True)
class _Finding:
    words: str
    severity: Severity = "green"
    remedy: str = ""


def _web_words(report: WebReport | SourceError | None) -> str:
    if not isinstance(report, WebReport):
        return ""
    temperature = None if report.temperature_c is None else f"{report.temperature_c:.0f} C"
    firmware = f"firmware {report.firmware}" if report.firmware else None
    return ", ".join(
        filter(None, (firmware, f"serial {report.serial}" if report.serial else "", temperature))
    )


def _rate(rig: Rig, seen: Observation, stream: str) -> _Finding:
    now_hz, wanted_hz = rate_hz(seen, stream), wanted_rate_hz(rig, seen.sensor)
    wanted = "" if wanted_hz is None else f" ({wanted_hz:g} wanted)"
    if now_hz == 0:
        return _Finding(
            f"no {stream}{wanted}", "red", "check its trigger line; a triggered camera waits for pulses"
        )
    words = f"{now_hz:.1f} {stream}/s{wanted}"
    silent_s = (seen.ended_ns - seen.stamps[stream][-1][1]) * 1e-9
    if silent_s > max(_STOPPED_S, 3 / now_hz):
        return _Finding(
            f"{words}, none for {silent_s:.1f} s", "red", "check cable and power, and its trigger line"
        )
    if wanted_hz is None or abs(now_hz / wanted_hz - 1) <= _MAX_OFF_RATE:
        return _Finding(words)
    if stream == "scans":
        remedy = f"set rpm {60 * wanted_hz:.0f} on its web page, or rate_hz in the profile"
    elif rig.sync is not None and seen.sensor in rig.sync.triggers:
        remedy = "does it follow its trigger? Set its trigger mode in driver.controls, and check the line"
    else:
        remedy = "long exposures slow a camera down: set rate and exposure, or correct the profile"
    return _Finding(words, "yellow", remedy)


def _event_rate(seen: Observation) -> _Finding:
    if not seen.n_events:
        return _Finding("no events", "red", "uncover the lens, and check the biases in driver.controls")
    return _Finding(f"{seen.n_events / max(seen.watched_s, 1e-9) / 1e6:.2f} M events/s")


def _losses(status: SourceStatus, n_came: int) -> _Finding:
    """Count what was lost on the way and by this computer."""
    n_packets = status.n_packets
    packets = "" if n_packets is None else f"{n_packets} packets, "
    if not status.n_lost + status.n_dropped:
        return _Finding(f"{packets}none lost")
    late = f", {status.n_dropped} not taken in time" if status.n_dropped else ""
    n_all = max(n_came if n_packets is None else n_packets, 1)
    share = (status.n_lost + status.n_dropped) / (n_all + status.n_lost)
    severity: Severity = "red" if share > _MAX_LOST_SHARE else "yellow"
    remedy = "check its cable; close other programs (top shows which are busy)"
    return _Finding(f"{packets}{status.n_lost} lost{late}", severity, remedy)
