"""Outcomes of the study of corruptions, counted by verdict and by cause."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import get_args

from benchmarks.corruption_causes import NOTHING, Codes, cause_of_error, first_cause, independent_causes
from benchmarks.corruption_kinds import SOUND
from benchmarks.measured import measure
from benchmarks.tables import compare, print_head, print_row
from lce_rig.core.calibration import Calibration, Method
from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array, sigma_sizes
from lce_rig.judge.findings import Verdict
from lce_rig.judge.reach import covariance_alone
from lce_rig.rig import Rig

METHODS: tuple[Method, ...] = ("paper", "ml")
VERDICTS = (*get_args(Verdict), "refused")
# An error beyond so many reported standard deviations, or targets of the profile, is a wrong result.
_WRONG = 3.0
# Error of a mistake without effect, in targets: half of one adds 12 % to a standard deviation of one target.
_HARMLESS = 0.5


@dataclass(frozen=True)
class Outcome:
    """What one method made of one session.

    Attributes:
        session, corruption, method: which.
        unobservable: as `Corruption.unobservable`.
        verdict: "refused" where nothing came out.
        reason: the first one.
        cause: code of the first cause, see `first_cause`; "" for none.
        causes: codes of the causes that are no notes and follow from no other.
        expected: as `Corruption.causes`.
        faults: as `Samples.faults`.
        is_beyond: whether the corruption is larger than the profile allows for.
        error: deg and mm; None where nothing came out.
        reported: standard deviations, deg and mm.
        in_sigmas: the error, as a multiple of what is reported; the larger of rotation and translation.
        in_targets: the same, as a multiple of the profile's targets.
    """

    session: str
    corruption: str
    method: str
    unobservable: str
    verdict: str
    reason: str
    cause: str = ""
    causes: tuple[str, ...] = ()
    expected: Codes = NOTHING
    faults: Codes = NOTHING
    is_beyond: bool = True
    error: tuple[float, float] | None = None
    reported: tuple[float, float] | None = None
    in_sigmas: float = 0.0
    in_targets: float = 0.0

    @property
    def is_wrong(self) -> bool:
        """Whether the error is larger than the reported standard deviations allow."""
        return self.in_sigmas > _WRONG

    @property
    def is_far_off(self) -> bool:
        """Whether it also exceeds the profile's target."""
        return self.is_wrong and self.in_targets > _WRONG

    @property
    def is_right(self) -> bool:
        """Whether the first cause names the corruption."""
        return self.cause in self.expected

    @property
    def false_causes(self) -> tuple[str, ...]:
        """Codes of causes that name neither the corruption nor a fault of the recording."""
        return tuple(code for code in self.causes if code not in self.expected | self.faults)

    @property
    def is_unnoticed(self) -> bool:
        """Whether it passes, its cause is not named, and the error is within the standard deviations."""
        return self.verdict == "pass" and not self.is_right and not self.is_wrong

    @property
    def is_harmless(self) -> bool:
        """Whether it is unnoticed and leaves the extrinsics right: a pass is the right verdict."""
        return self.is_unnoticed and self.in_targets <= _HARMLESS

    @property
    def second_causes(self) -> tuple[str, ...]:
        """Codes of false causes other than the first."""
        return tuple(code for code in self.false_causes if code != self.cause)


def judged(rig: Rig, blank: Outcome, calibration: Calibration, truth: Array) -> Outcome:
    """Complete an outcome by a calibration and the true T_cam_lidar (4, 4)."""
    error_deg, error_mm = compare(calibration.T_cam_lidar, truth)
    # The truth is only a pose, without intrinsics.
    sigma_deg, sigma_m = sigma_sizes(covariance_alone(calibration))
    sigma_mm = 1000 * sigma_m
    return replace(
        blank,
        verdict=calibration.verdict,
        reason=calibration.findings[0].sentence if calibration.findings else "",
        cause=first_cause(calibration),
        causes=independent_causes(calibration),
        error=(error_deg, error_mm),
        reported=(sigma_deg, sigma_mm),
        in_sigmas=max(error_deg / sigma_deg, error_mm / sigma_mm),
        in_targets=rig.calibration.in_targets(error_deg, error_mm / 1000),
    )


def refused(blank: Outcome, error: LceRigError) -> Outcome:
    """Complete an outcome by the error that takes the place of a calibration."""
    reason, code = f"{error.what}: {error.hint}" if error.hint else error.what, cause_of_error(error)
    return replace(blank, reason=reason, cause=code, causes=(code,))


def print_summary(outcomes: Sequence[Outcome]) -> None:
    """Count by method and verdict, and name every wrong result that passes.

    Args:
        outcomes: of all sessions; sound ones are not counted.
    """
    corrupted = [outcome for outcome in outcomes if outcome.corruption != SOUND]
    head = "method, verdict, calibrations, error over 3 sigmas, of them over 3 targets, worst in sigmas"
    print_head(*head.split(", "), "over 3 sigmas where the data cannot show it")
    for method in _methods(outcomes):
        for verdict in VERDICTS:
            found = [o for o in corrupted if (o.method, o.verdict) == (method, verdict)]
            shown = [o for o in found if not o.unobservable]
            worst = max((o.in_sigmas for o in shown), default=0.0)
            print_row(
                method,
                verdict,
                len(found),
                sum(o.is_wrong for o in shown),
                sum(o.is_far_off for o in shown),
                f"{worst:.1f}" if verdict != "refused" else "-",
                sum(o.is_wrong for o in found) - sum(o.is_wrong for o in shown),
            )
    print("\nWrong and passed:\n")
    print_head(
        "session", "corruption", "method", "error deg / mm", "in sigmas", "in targets", "why it passes"
    )
    for o in corrupted:
        if o.is_wrong and o.verdict == "pass":
            why = f"the data cannot show it: {o.unobservable}" if o.unobservable else "overconfident"
            figures = f"{o.in_sigmas:.1f}", f"{o.in_targets:.1f}"
            print_row(o.session, o.corruption, o.method, pair(o.error), *figures, why)


def print_causes(outcomes: Sequence[Outcome]) -> None:
    """Count by method how often the first cause is right; list other causes, and false findings.

    Args:
        outcomes: of all sessions, sound ones too.
    """
    corrupted = [o for o in outcomes if o.corruption != SOUND and not o.unobservable]
    beyond = [o for o in corrupted if o.is_beyond]
    print_head(
        *["method", "beyond tolerance", "of them harmless", "others", "first cause right"],
        "second false cause",
        *["passes unnoticed within 3 sigmas", "passes over 3 sigmas"],
        *["within tolerance", "false cause", "sound", "false cause"],
    )
    for method in _methods(outcomes):
        large, small, sound = (
            [o for o in group if o.method == method]
            for group in (
                beyond,
                [o for o in corrupted if not o.is_beyond],
                [o for o in outcomes if o.corruption == SOUND],
            )
        )
        n_beyond, large = len(large), [o for o in large if not o.is_harmless]
        print_row(
            method,
            n_beyond,
            n_beyond - len(large),
            len(large),
            share(o.is_right for o in large),
            share(bool(o.second_causes) for o in large),
            share(o.is_unnoticed for o in large),
            sum(o.is_wrong and o.verdict == "pass" for o in large),
            len(small),
            share(bool(o.false_causes) for o in small),
            len(sound),
            share(bool(o.false_causes) for o in sound),
        )
    print("\nBeyond tolerance, first cause not right:\n")
    print_head("session", "corruption", "method", "verdict", "first cause", "other causes", "in sigmas")
    for o in beyond:
        if not o.is_right:
            others = "(harmless)" if o.is_harmless else ", ".join(c for c in o.causes if c != o.cause)
            of_recording = " (of the recording)" if o.cause in o.faults else ""
            first = f"{o.cause or '-'}{of_recording}"
            print_row(o.session, o.corruption, o.method, o.verdict, first, others, f"{o.in_sigmas:.1f}")
    print("\nFalse causes of sound sessions, of errors within tolerance, and second ones beyond it:\n")
    print_head("session", "corruption", "method", "verdict", "first cause", "false causes")
    for o in [o for o in outcomes if o.corruption == SOUND] + corrupted:
        is_sound = o.corruption == SOUND or not o.is_beyond
        if false := o.false_causes if is_sound else o.second_causes:
            print_row(o.session, o.corruption, o.method, o.verdict, o.cause or "-", ", ".join(false))


def measure_causes(outcomes: Sequence[Outcome]) -> None:
    """Keep each session's counts of mistakes beyond the profile's tolerances, and of harmless ones apart."""
    beyond = [o for o in outcomes if o.corruption != SOUND and not o.unobservable and o.is_beyond]
    for session, method in {(o.session, o.method): None for o in beyond}:
        every = [o for o in beyond if (o.session, o.method) == (session, method)]
        own = [o for o in every if not o.is_harmless]
        key, n_right = f"corruptions.{session}.{method}", sum(o.is_right for o in own)
        measure(f"{key}.mistakes", "{}", len(own))
        measure(f"{key}.harmless", "{}", len(every) - len(own))
        measure(f"{key}.right", "{} ({:.0f} %)", n_right, 100 * n_right / len(own))
        measure(f"{key}.second", "{}", sum(bool(o.second_causes) for o in own))
        measure(f"{key}.unnoticed", "{}", sum(o.is_unnoticed for o in own))
        measure(f"{key}.passes", "{}", sum(o.is_wrong and o.verdict == "pass" for o in own))


def share(marks: Iterable[bool]) -> str:
    """Format the number of true values with their percentage; "-" without any."""
    held = list(marks)
    return f"{sum(held)} ({100 * sum(held) / len(held):.0f} %)" if held else "-"


def pair(figures: tuple[float, float] | None) -> str:
    """Format deg and mm."""
    return "-" if figures is None else f"{figures[0]:.2f} / {figures[1]:.1f}"


def _methods(outcomes: Sequence[Outcome]) -> list[Method]:
    return [method for method in METHODS if any(o.method == method for o in outcomes)]
