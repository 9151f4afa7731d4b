"""Kinds of option values that several verbs share."""

import math
from typing import Any

import click


class FiniteRange(click.FloatRange):
    """A number within limits that is neither infinite nor NaN."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Refuse what float() takes and no quantity is."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is no finite number.", param, ctx)
        return number


event_image_option = click.option(
    "--event-image",
    type=click.Choice(["network", "map"]),
    help="How pictures are made from raw events; by default as the profile says, which is the network.",
)
