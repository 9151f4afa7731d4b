"""Every command that a finding, a hint or a page advises works when typed, with real values for its names."""

import ast
import re
import shlex
import shutil
from importlib import import_module
from pathlib import Path

import click
import pytest

import lce_rig
from lce_rig.cli.main import cli, run
from lce_rig.core.findings import KINDS
from tests.shared import make_once

PACKAGE = Path(lce_rig.__file__).parent
# In backticks up to the closing one, else up to the end of the sentence or of the text.
_QUOTED = re.compile(r"`lce-rig ([^`]*)`")
_PLAIN = re.compile(
    r"(?:[Rr]un|[Ww]rite|with|by|it|one|new|next|Then|then|collect):? +lce-rig ([^,;()<]+?)(?=[.,;()<]|$)"
)


def _texts(source):
    """Yield every text of a module but docstrings, with X for each value that is put in."""
    tree = ast.parse(source)
    parts = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            parts.add(id(node.value))
        if isinstance(node, ast.JoinedStr):
            parts.update(map(id, node.values))
            yield "".join(str(v.value) if isinstance(v, ast.Constant) else " X " for v in node.values)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
            yield node.value


def _advised():
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
assert len(ADVISED) > 20


def _lacking(command):
    """Return the reason why a command cannot be run as typed; "" if it can."""
    words = [word for word in shlex.split(command) if word != "\\"]
    at = cli
    context = click.Context(cli, info_name="lce-rig")
    while isinstance(at, click.Group):
        if not words:
            return "" if at.invoke_without_command else "a verb"
        name = words.pop(0)
        below = at.get_command(context, name)
        if below is None:
            return f"the verb {name}"
        at, context = below, click.Context(below, info_name=name, parent=context)
    if "--help" in words:
        return ""
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


def _actions():
    for path in sorted(PACKAGE.glob("*/findings.py")):
        import_module(f"lce_rig.{path.parent.name}.findings")
    for kind in KINDS.values():
        for action in (kind.action, *kind.actions.values()):
            if isinstance(action, str):
                yield kind.code, action


def test_action_fits_one_terminal_line():
    for code, action in _actions():
        # Indented by "    -> "; a figure takes about four characters.
        filled = re.sub(r"{[^}]*}", "1.23", action.replace("{session}", "session"))
        assert len(filled) <= 80 - 7, (code, action)


def test_action_option_is_part_of_a_command():
    for code, action in _actions():
        assert " --" not in f" {_QUOTED.sub('', action)}", (code, action)


@pytest.mark.parametrize(("place", "command"), ADVISED)
def test_advised_command_parses(place, command):
    assert _lacking(command) == ""


# `doctor` has no simulated sensors, and the workbench's recording no scene: these are parsed only.
# `fleet run` makes the workbench's registry. Without a recording `collect` has a simulated rig.
PARSED_ONLY = {"doctor", "calibrate --scene"}
_VALUES = {
    "--targets": "deploy.yaml",
    "--robot": "kestrel",
    "--rig": "rig.yaml",
    "--channels": "frames",
    "--from": "recording",
    "--scene": "recording",
    "--save-profile": "new.yaml",
    "--result": "session/calibration/result.json",
    "--name": "second",
    "--registry": "registry",
    "--target": "kestrel",
    "--formats": "autoware",
    "--tree": "robot.urdf",
    "--reason": "asked",
    "--release": "EARLIER",
    "--restore": "000001",
    "--model": "radtan5",
    "-o": "new",
}
_PLACEHOLDER = re.compile("X|R|RIG|FILE|FOLDER|NAME|TARGET|ROOT|SESSION|OTHER_SESSION|RECORDING|URDF|TEXT")


def _typed(command):
    """Replace the placeholders of an advised command by test values."""
    words = shlex.split(command)
    first = " ".join(words[:2])
    typed = []
    for word in words:
        before = typed[-1] if typed else ""
        if not _PLACEHOLDER.fullmatch(word):
            value = word
        elif before in _VALUES:
            value = _VALUES[before]
        elif first == "rigs new":
            value = "mine"
        elif first in ("rigs show", "rigs check"):
            value = "rig.yaml"
        elif first == "fleet run":
            value = "sessions"
        else:
            value = "other" if word == "OTHER_SESSION" else "session"
        typed.append(value)
    if typed[0] == "collect" and "--from" not in typed:
        typed += ["--simulated", "--plain", "--captures", "1", "--timeout", "240"]
    if first == "rigs new" and len(typed) == 3:
        typed += ["--from", "rlfs"]
    return tuple(typed)


TYPED = [
    pytest.param(words, marks=pytest.mark.realtime if "--simulated" in words else ())
    for words in sorted(
        {_typed(command) for _, command in ADVISED if not command.startswith((*PARSED_ONLY, "fleet run"))}
    )
]


@pytest.fixture(scope="module")
def workbench():
    """Sessions, results, a recording, a registry and a robot: all that advised commands name."""

    def make(folder):
        folder.mkdir()
        session, rig, recording = folder / "session", folder / "rig.yaml", folder / "recording"

        def calls(*words):
            assert run([str(word) for word in words]) in (0, 7), words

        calls("rigs", "new", "rlfs", "--from", "rlfs", "-o", rig)
        calls("simulate", "--rig", rig, session, "--captures", "10", "--seed", "3")
        for file, kind in (("cam.frames.png", "img"), ("lidar.pcd", "pcd")):
            (recording / kind).mkdir(parents=True)
            for capture in sorted((session / "captures").iterdir())[:6]:
                shutil.copy(capture / file, recording / kind / f"{capture.name}{Path(file).suffix}")
        calls("captures", session, "--reject", "000001")
        calls("calibrate", session, "--robot", "kestrel")
        shutil.copytree(session, folder / "sessions" / "other")
        calls("simulate", "--rig", rig, folder / "other", "--captures", 10, "--seed", 4, "--mounting", 3)
        calls("calibrate", folder / "other", "--no-report")
        wrong = folder / "wrong.yaml"
        # A focal length 3 % too long.
        wrong.write_text(re.sub(r"(f[xy]_px): [0-9.]+", r"\1: 924.0", rig.read_text()))
        shutil.copytree(session, folder / "refocused")
        calls("calibrate", folder / "refocused", "--rig", wrong)
        calls("calibrate", session, "--name", "second", "--robot", "kestrel", "--without", "000002")
        calls("captures", session, "--restore", "000002")
        (folder / "deploy.yaml").write_text("targets: {kestrel: {to: robot, robot: kestrel}}\n")
        calls("fleet", "run", folder / "sessions", "--registry", folder / "registry", "--workers", "1")
        for name in ((), ("--name", "second")):
            calls("deploy", session, "--target", "kestrel", "--targets", folder / "deploy.yaml", *name)
        (folder / "robot.urdf").write_text(
            "<robot name='r'><link name='base_link'/><link name='velodyne'/><joint name='j' type='fixed'>"
            "<parent link='base_link'/><child link='velodyne'/></joint></robot>\n"
        )

    return make_once("workbench", make)


@pytest.mark.long
@pytest.mark.parametrize("command", TYPED, ids=" ".join)
def test_advised_command_runs(command, workbench, tmp_path, monkeypatch, lce_rig):
    shutil.copytree(workbench, tmp_path, dirs_exist_ok=True, symlinks=True)
    monkeypatch.chdir(tmp_path)
    if command[0] in ("collect", "simulate") or "--save-profile" in command:
        shutil.rmtree("session")
    if "--save-profile" in command:
        Path("refocused").rename("session")
    releases = sorted(path.name for path in Path("robot/releases").iterdir())
    outcome = lce_rig(*(releases[0] if word == "EARLIER" else word for word in command))
    assert outcome.code == 0, outcome.err
