"""Every code that the package makes has words, and every word is asked for."""

import ast
from pathlib import Path

import lce_rig
from lce_rig.core.results import STAGES
from lce_rig.words.rendering import phrases

MAKERS = ("Finding", "Refusal")


def codes_made() -> set[str]:
    """List the codes of findings that the sources make; those of "{stage}.name" for every stage."""
    found = set()
    for path in Path(lce_rig.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in MAKERS and node.args:
                found |= codes_of(node.args[0])
    return found


def codes_of(code: ast.expr) -> set[str]:
    if isinstance(code, ast.Constant):
        return {code.value}
    if isinstance(code, ast.JoinedStr) and isinstance(code.values[-1], ast.Constant):
        return {f"{stage}{code.values[-1].value}" for stage in STAGES} & phrases().keys()
    return set()


def test_every_code_has_a_phrase_and_every_phrase_a_code() -> None:
    made = codes_made()
    assert len(made) > 60
    assert made ^ phrases().keys() == set()


def test_codes_are_a_family_and_a_name() -> None:
    for code in phrases():
        family, _, name = code.partition(".")
        assert family.isidentifier() and name.isidentifier() and code.islower()
