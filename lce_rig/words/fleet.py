"""Sessions of a fleet without a result, and robots that changed."""

from lce_rig.core.findings import Finding
from lce_rig.words.extrinsics import motion_words
from lce_rig.words.rendering import Phrase

_SENSORS = {"camera": "the camera", "lidar": "the LiDAR", "": "the camera or the LiDAR"}


def _listed(finding: Finding, name: str) -> tuple[str, ...]:
    values = finding.figures[name]
    assert isinstance(values, tuple)
    return tuple(map(str, values))


def _motions(finding: Finding) -> str:
    """Name the axes of a change with its sizes."""
    axes, changes, sigmas = (_listed(finding, name) for name in ("axes", "changes", "sigmas"))
    parts = []
    for axis, change, sigma in zip(axes, changes, sigmas, strict=True):
        if axis.startswith("rotation"):
            places = 2 if float(sigma) >= 0.005 else 3
            size = f"{float(change):+.{places}f} +- {float(sigma):.{places}f} deg"
        else:
            size = f"{1e3 * float(change):+.1f} +- {1e3 * float(sigma):.1f} mm"
        parts.append(f"{size}, {motion_words(axis)}")
    return "; ".join(parts)


def _day(finding: Finding, name: str) -> str:
    return str(finding.figures[name])[:10]


def _moved(finding: Finding) -> str:
    """{sensor} moved between {before} and {after}: {axes}, {changes}, {sigmas} in m or deg."""
    sensor = _SENSORS[str(finding.figures["sensor"])]
    return (
        f"{sensor} moved between {_day(finding, 'before')} and {_day(finding, 'after')}, {_motions(finding)}"
    )


def _drifts(finding: Finding) -> str:
    """Changes slowly from {before} to {after}: {axes}, {changes}, {sigmas} in m or deg."""
    return f"drifts slowly from {_day(finding, 'before')} to {_day(finding, 'after')}, {_motions(finding)}"


def _odd(finding: Finding) -> str:
    """The session of {after} differs from the others: {axes}, {changes}, {sigmas} in m or deg."""
    return f"the session of {_day(finding, 'after')} differs from the others, {_motions(finding)}"


def _apart(finding: Finding) -> str:
    """Mounted {apart_m} or {apart_deg} by {axis} from {n_siblings} siblings; {sigmas}, {limit_sigmas}."""
    figures = finding.figures
    if "apart_deg" in figures:
        size = f"{finding.figure('apart_deg'):+.2f} deg"
    else:
        size = f"{1e3 * finding.figure('apart_m'):+.1f} mm"
    return (
        f"mounted {size}, {motion_words(str(figures['axis']))}, from the median of {figures['n_siblings']} "
        f"siblings, {finding.figure('sigmas'):.1f} standard deviations of their spread "
        f"(limit {finding.figure('limit_sigmas'):.1f})"
    )


_USE_LATER = "use no result from before; check how the sensor is fastened"

PHRASES = {
    "fleet.moved": Phrase(_moved, _USE_LATER),
    "fleet.moved_last": Phrase(
        _moved, "collect another session to confirm it; use no result from before until then"
    ),
    "fleet.drifts": Phrase(
        _drifts, "look for a bracket that bends or a screw that loosens; calibrate more often"
    ),
    "fleet.creeps": Phrase(
        "small differences of its sessions add up: cumulative sum {cusum:.1f} (limit {limit_cusum:.1f})",
        "collect another session soon",
    ),
    "fleet.odd_session": Phrase(_odd, "leave its result out; look at its captures"),
    "fleet.apart_from_siblings": Phrase(_apart, "check the mounting against the CAD model"),
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
