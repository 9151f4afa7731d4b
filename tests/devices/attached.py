"""A single attached sensor: its samples as they arrive, then the reason for the end."""

from contextlib import contextmanager
from typing import TypeVar

from lce_rig.devices.reading import AttachedSensors, LiveSource

Source = TypeVar("Source", bound=LiveSource)


@contextmanager
def attached(source):
    """Open a sensor; gives it and what comes from it, which ends with the error that ends its reading."""
    with AttachedSensors([source], reopen_every_s=None) as sensors:
        yield source, _samples(source, sensors)


def _samples(source, sensors):
    while True:
        lost = source.lost
        came = sensors.take(0.1)
        if came is not None:
            yield came[1]
        elif lost is not None:
            raise lost[0]
