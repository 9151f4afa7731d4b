#!/usr/bin/env python3
"""Write docs/cli.md: all commands with their arguments and options, from `--help`."""

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path

import click

from lce_rig.cli.main import EXIT_BUG, cli
from lce_rig.core.interrupts import EXIT_INTERRUPTED

# Options of most verbs begin so; they are explained once.
_COMMON = "Print all figures"
PAGE = Path(__file__).parents[1] / "docs" / "cli.md"
HEAD = f"""# Command line
Every verb with its options, as `lce-rig VERB --help` prints them. Results go to stdout, with `--json` as
[findings](findings.md) and figures; all else goes to stderr. `--explain` prints all figures and causes.

| exit code | meaning |
|---|---|
| 0 | done |
| 1 | other error |
| 2 | usage: an option or argument |
| 3 | rig profile |
| 4 | session |
| 5 | recording, sensor or missing dependency |
| 6 | not enough data |
| 7 | result refused |
| 8 | `deploy`: the target was not reached or written; the earlier files are in place |
| 9 | `deploy`: the new files are in place; the command after them failed |
| {EXIT_BUG} | a bug in lce-rig |
| {EXIT_INTERRUPTED} | interrupted (Ctrl-C) |

## Shell completion
The Tab key completes verbs, options and their values. Add the line of your shell to its start-up file:

| shell | file | line |
|---|---|---|
| bash 4.4 or newer | `~/.bashrc` | `eval "$(_LCE_RIG_COMPLETE=bash_source lce-rig)"` |
| zsh | `~/.zshrc` | `eval "$(_LCE_RIG_COMPLETE=zsh_source lce-rig)"` |
| fish | `~/.config/fish/completions/lce-rig.fish` | `_LCE_RIG_COMPLETE=fish_source lce-rig \\| source` |

`scripts/cli_page.py` writes this page from the commands.
"""


def page() -> str:
    """Build the page."""
    with click.Context(cli, info_name="lce-rig", max_content_width=100) as context:
        options = _table(_options(cli, context))
        parts = [HEAD, "## lce-rig\n", _text(cli), *options]
        parts += [line for name in cli.list_commands(context) for line in _verb(cli, name, context, "##")]
    return "\n".join(parts).rstrip() + "\n"


def _verb(group: click.Group, name: str, parent: click.Context, heading: str) -> Iterator[str]:
    command = group.get_command(parent, name)
    assert command is not None
    with click.Context(command, info_name=name, parent=parent) as context:
        usage = " ".join([context.command_path, *command.collect_usage_pieces(context)])
        yield f"{heading} {context.command_path}\n\n```text\n{usage}\n```\n"
        yield _text(command)
        options = _options(command, context)
        yield from _table([(name, text) for name, text in options if not text.startswith(_COMMON)])
        if common := [f"`{name}`" for name, text in options if text.startswith(_COMMON)]:
            yield f"Also {', '.join(common)}.\n"
        for each in command.list_commands(context) if isinstance(command, click.Group) else ():
            yield from _verb(command, each, context, heading + "#")


def _options(command: click.Command, context: click.Context) -> list[tuple[str, str]]:
    """List options with their help; --help itself is omitted."""
    options = [each for each in command.get_params(context) if isinstance(each, click.Option)]
    records = [each.get_help_record(context) for each in options if "--help" not in each.opts]
    return [record for record in records if record is not None]


def _table(rows: list[tuple[str, str]]) -> list[str]:
    if not rows:
        return []
    lines = [f"| `{name.replace('|', chr(92) + '|')}` | {_cell(text)} |" for name, text in rows]
    return ["| option | meaning |\n|---|---|", *lines, ""]


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").replace("<", "&lt;").split())


def _text(command: click.Command) -> str:
    r"""Show a command's help: paragraphs, and what is marked with \b as it stands."""
    paragraphs = []
    for paragraph in inspect.cleandoc(command.help or "").split("\n\n"):
        if paragraph.startswith("\b"):
            paragraphs.append(f"```text\n{inspect.cleandoc(paragraph[1:])}\n```")
        else:
            paragraphs.append(paragraph)
    return "\n\n".join(paragraphs) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    sys.stdout.write(f"{PAGE}\n")
