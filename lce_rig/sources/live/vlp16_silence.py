"""Why no packets of a VLP-16 come: what can be told from here, and what is left to check."""

from lce_rig.core import velodyne
from lce_rig.core.errors import SourceError
from lce_rig.rig import LidarSettings
from lce_rig.sources.live.velodyne_web import VelodyneWeb, WebReport, find_problems
from lce_rig.sources.live.vlp16_status import Reception
from lce_rig.sources.velodyne_stream import Vlp16Stream
from lce_rig.words import as_line, describe, sentence

_WEB_TIMEOUT_S = 1.0
_EVERYBODY = "255.255.255.255"
_MAX_SHOWN = 3


def explain_silence(
    sensor: str,
    settings: LidarSettings,
    stream: Vlp16Stream,
    reception: Reception,
    silence_s: float,
    web_port: int,
) -> SourceError:
    """Find the likeliest reason; the sensor's web page is asked."""
    port, address = settings.driver.port or velodyne.DATA_PORT, settings.driver.address
    whose = f" from {address}" if address else ""
    began = "have stopped" if stream.counts.n_data else "come"
    none = "" if stream.counts.n_data else "no "
    what = f"{sensor}: {none}data packets{whose} on UDP port {port} {began} (for {silence_s:g} s)"
    others = stream.counts.other_models.most_common(1)
    if others:
        return SourceError(
            f"{sensor}: the packets on UDP port {port} come from a {others[0][0]}, not a VLP-16",
            "Only the VLP-16 (Puck, Puck LITE) is read: check driver.address.",
        )
    if stream.counts.n_bad:
        bad = ", ".join(describe(flaw) for flaw in stream.counts.flaws()[:_MAX_SHOWN])
        return SourceError(f"{what}: only {bad}", "Check which program sends to this port.")
    if reception.strangers:
        there = ", ".join(sorted(reception.strangers))
        return SourceError(what, f"Packets come from {there}: set driver.address in the profile.")
    return SourceError(what, _ask_the_web_page(address or velodyne.FACTORY_ADDRESS, port, settings, web_port))


def _ask_the_web_page(address: str, port: int, settings: LidarSettings, web_port: int) -> str:
    try:
        report = VelodyneWeb(address, web_port, _WEB_TIMEOUT_S).read()
    except SourceError:
        return (
            f"Its web page http://{address} does not answer either. Check its power and cable; that this "
            "computer has an address in its network (192.168.1.x, mask 255.255.255.0); and driver.address."
        )
    return " ".join([f"Its web page http://{address} answers.", *_advise(report, port, settings)])


def _advise(report: WebReport, port: int, settings: LidarSettings) -> list[str]:
    problems = [as_line(sentence(problem)) for problem in find_problems(report, settings)]
    if report.host and report.host != _EVERYBODY:
        problems.append(f"Data go to {report.host} only: check that this is this computer.")
    return problems or [f"Open UDP port {port} in this computer's firewall (sudo ufw allow {port}/udp)."]
