"""Option types and options shared by several subcommands."""

import math
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

_Verb = TypeVar("_Verb", bound=Callable[..., Any])


class FiniteRange(click.FloatRange):
    """A finite number within limits."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Refuse infinity and NaN, which float() accepts."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


def names_option(name: str, text: str, metavar: str = "NAME[,NAME]") -> Callable[[_Verb], _Verb]:
    """Declare an option whose value is a list of names separated by commas."""

    def split(_ctx: click.Context, _param: click.Parameter, value: str | None) -> list[str] | None:
        return None if value is None else [part.strip() for part in value.split(",")]

    return click.option(name, callback=split, metavar=metavar, help=text)


def path_option(
    *names_metavar_help: str, is_file: bool = False, **attributes: Any
) -> Callable[[_Verb], _Verb]:
    """Declare an option whose value is a path: by its names, the name of its value and its help."""
    *names, metavar, text = names_metavar_help
    kind = click.Path(path_type=Path, dir_okay=not is_file)
    return click.option(*names, type=kind, metavar=metavar, help=text, **attributes)


def result_option(use: str) -> Callable[[_Verb], _Verb]:
    """Declare --name, which names a result of SESSION."""
    return click.option(
        "--name", metavar="NAME", help=f"{use} this result of SESSION (see `lce-rig results`)."
    )


session_argument = click.argument("session", type=click.Path(path_type=Path), default="session")

rig_option = click.option(
    "--rig",
    "rig_name",
    required=True,
    metavar="NAME|FILE",
    help="Set the rig profile: a shipped name or a file.",
)

json_option = click.option("--json", "as_json", is_flag=True, help="Print all figures as JSON.")

explain_option = click.option("--explain", is_flag=True, help="Print all figures and causes.")

robot_option = click.option(
    "--robot", metavar="NAME", help="Name the robot that carries the rig, for the result."
)

cameras_option = click.option(
    "--camera", "cameras", multiple=True, metavar="NAME", help="Use only this camera; repeatable."
)


def require_sensors(what: str, names: Sequence[str], choices: Collection[str]) -> None:
    """Check that the rig has the requested sensors.

    Raises:
        UsageError: a sensor is missing.
    """
    from lce_rig.core.errors import UsageError

    unknown = sorted(set(names) - set(choices))
    if unknown:
        raise UsageError(f"the rig has no {what} {unknown[0]!r}", f"Choose one of: {', '.join(choices)}")


registry_option = click.option(
    "--registry",
    required=True,
    metavar="DIR",
    help="Set the folder of results: a path, or an address such as s3://bucket/registry.",
)
