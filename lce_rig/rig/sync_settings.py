"""The sync board's block of a profile: its connection, and the camera that each line triggers."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from lce_rig.rig.settings import Name, Settings, problem

BOARD, PPS_LINE = "sync", "pps"
"""Reserved names: the sync board among the sensors, and its pulse per second among the camera lines."""


class TriggerSettings(Settings):
    """The pulses that trigger one camera.

    Attributes:
        channel: number of the board's line.
        rate_hz: pulses per second.
        phase_us: first pulse of a second after that second's beginning.
        pulse_us: length of a pulse.
        max_delay_s: maximum delay of an image's timestamp after its pulse; as short as the camera allows.
    """

    channel: Annotated[int, Field(ge=0, le=15)]
    rate_hz: Annotated[float, Field(gt=0, le=1000)]
    phase_us: Annotated[int, Field(ge=0, lt=1_000_000)] = 0
    pulse_us: Annotated[int, Field(ge=1, lt=1_000_000)] = 100
    max_delay_s: Annotated[float, Field(gt=0, le=1)] = 0.1

    @model_validator(mode="after")
    def _pulses_fit_into_their_period(self) -> "TriggerSettings":
        period_us = 1e6 / self.rate_hz
        if self.pulse_us >= period_us:
            what = f"pulses of {self.pulse_us} us exceed the period of {period_us:.0f} us"
            raise problem(what, "pulse_us")
        if self.phase_us >= period_us:
            what = f"{self.phase_us} us is beyond the period of {period_us:.0f} us"
            raise problem(what, "phase_us")
        return self


class SyncSettings(Settings):
    """A board that generates the pulse per second and triggers cameras.

    Attributes:
        type: its protocol: lce-rig's own (docs/sync-protocol.md).
        device: its serial port.
        baud: speed of the port; None for 115200, any over USB.
        triggers: the trigger lines, by the camera's name.
    """

    type: Literal["lce1"] = "lce1"
    device: Annotated[str, Field(min_length=1, max_length=4096)]
    baud: Annotated[int, Field(ge=1200, le=4_000_000)] | None = None
    triggers: dict[Name, TriggerSettings] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _lines_are_used_once(self) -> "SyncSettings":
        cameras: dict[int, str] = {}
        for camera, trigger in self.triggers.items():
            if trigger.channel in cameras:
                what = f"line {trigger.channel} triggers {cameras[trigger.channel]} already"
                raise problem(what, f"triggers.{camera}.channel")
            cameras[trigger.channel] = camera
        return self

    @property
    def port_baud(self) -> int:
        """The speed of the port."""
        return self.baud or 115_200
