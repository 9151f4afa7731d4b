"""Every command that a finding, a hint or a page advises can be typed: its words exist, nothing lacks."""

import ast
import re
import shlex
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import click
import pytest

import lce_rig
from lce_rig.cli.main import cli
from lce_rig.core.findings import KINDS

PACKAGE = Path(lce_rig.__file__).parent
# In backticks up to the closing one, else up to the end of the sentence or of the text.
_QUOTED = re.compile(r"`lce-rig ([^`]*)`")
_PLAIN = re.compile(
    r"(?:[Rr]un|[Ww]rite|with|by|it|one|new|next|Then|then|collect):? +lce-rig ([^,;()<]+?)(?=[.,;()<]|$)"
)


def _texts(source: str) -> Iterator[str]:
    """Yield every text of a module but docstrings, with X for each value that is put in."""
    tree = ast.parse(source)
    parts: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            parts.add(id(node.value))
        if isinstance(node, ast.JoinedStr):
            parts.update(map(id, node.values))
            yield "".join(str(v.value) if isinstance(v, ast.Constant) else " X " for v in node.values)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
            yield node.value


def _advised() -> Iterator[tuple[str, str]]:
    for path in sorted(PACKAGE.rglob("*")):
        if path.suffix == ".py":
            texts = list(_texts(path.read_text(encoding="utf-8")))
        elif path.suffix == ".html":
            texts = [re.sub(r"</?code>", "`", re.sub(r"{{.*?}}", "X", path.read_text(encoding="utf-8")))]
        else:
            continue
        for text in texts:
            for command in [*_QUOTED.findall(text), *_PLAIN.findall(_QUOTED.sub("", text))]:
                if re.match(r"[a-z]", command):  # no pattern of a regular expression
                    yield str(path.relative_to(PACKAGE)), " ".join(re.sub(r"{[^}]*}", "X", command).split())


ADVISED = sorted(set(_advised()))


def _lacking(command: str) -> str:
    """Say what a command lacks to be run as it is typed; "" if nothing."""
    words = [word for word in shlex.split(command) if word != "\\"]
    at: click.Command = cli
    context = click.Context(cli, info_name="lce-rig")
    while isinstance(at, click.Group):
        if not words:
            return "" if at.invoke_without_command else "a verb"
        name = words.pop(0)
        below = at.get_command(context, name)
        if below is None:
            return f"the verb {name}"
        at, context = below, click.Context(below, info_name=name, parent=context)
    try:
        values, _, _ = at.make_parser(context).parse_args(words)
    except click.UsageError as error:
        return error.format_message()
    missing = [
        param.human_readable_name
        for param in at.params
        if param.required
        and not (isinstance(value := values.get(param.name or ""), str | tuple | list) and value)
    ]
    return ", ".join(missing)


def test_an_action_takes_one_line_of_a_terminal() -> None:
    for path in sorted(PACKAGE.glob("*/findings.py")):
        import_module(f"lce_rig.{path.parent.name}.findings")
    for kind in KINDS.values():
        for action in (kind.action, *kind.actions.values()):
            if isinstance(action, str):
                # Indented by "    -> "; a figure takes about four characters.
                filled = re.sub(r"{[^}]*}", "1.23", action.replace("{session}", "session"))
                assert len(filled) <= 80 - 7, (kind.code, action)


def test_commands_are_found() -> None:
    verbs = {command.split()[0] for _, command in ADVISED}
    assert {"calibrate", "check", "collect", "intrinsics", "drift", "doctor", "rigs"} <= verbs


@pytest.mark.parametrize(("place", "command"), ADVISED)
def test_an_advised_command_can_be_typed(place: str, command: str) -> None:
    assert _lacking(command) == ""
