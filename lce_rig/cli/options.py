"""Kinds of option values that several verbs share."""

import math
from collections.abc import Collection, Sequence
from pathlib import Path
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


def split_names(_ctx: click.Context, _param: click.Parameter, value: str | None) -> list[str] | None:
    """Take names separated by commas apart, as an option's callback."""
    return None if value is None else [name.strip() for name in value.split(",")]


session_argument = click.argument("session", type=click.Path(path_type=Path), default="session")

rig_option = click.option(
    "--rig", "rig_name", required=True, metavar="NAME|FILE", help="Rig profile: a shipped name or a file."
)

json_option = click.option("--json", "as_json", is_flag=True, help="Print every figure as JSON.")

cameras_option = click.option(
    "--camera", "cameras", multiple=True, metavar="NAME", help="Only this camera; may be repeated."
)


def require_sensors(what: str, names: Sequence[str], known: Collection[str]) -> None:
    """Make sure that sensors asked for, such as cameras, are those of a rig.

    Raises:
        UsageError: one is not.
    """
    from lce_rig.core.errors import UsageError

    unknown = sorted(set(names) - set(known))
    if unknown:
        raise UsageError(f"there is no {what} {unknown[0]!r}; there is {', '.join(known)}")


EVENT_IMAGES = click.Choice(["network", "map"])

event_image_option = click.option(
    "--event-image",
    type=EVENT_IMAGES,
    help="How events become pictures: by network, or sums of polarities [default: the profile's, network].",
)
