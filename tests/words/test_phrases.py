"""Every code that the package makes has words, and all words are of codes that it makes."""

import ast
from collections.abc import Iterator
from pathlib import Path

import lce_rig
from lce_rig.core.findings import STAGES
from lce_rig.words.rendering import phrases

MAKERS = ("Finding", "Refusal", "reason", "_warn")
PACKAGE = Path(lce_rig.__file__).parent


def nodes() -> Iterator[ast.AST]:
    for path in PACKAGE.rglob("*.py"):
        if path.parent != PACKAGE / "words":
            yield from ast.walk(ast.parse(path.read_text(encoding="utf-8")))


def codes_of(text: ast.AST) -> set[str]:
    """Give a literal, or what f"{stage}.name" may be."""
    if isinstance(text, ast.Constant) and isinstance(text.value, str):
        return {text.value}
    if isinstance(text, ast.JoinedStr) and isinstance(text.values[-1], ast.Constant):
        return {f"{stage}{text.values[-1].value}" for stage in STAGES} & phrases().keys()
    return set()


def test_every_code_has_a_phrase_and_every_phrase_a_code() -> None:
    made, literal = set(), set()
    for node in nodes():
        literal |= codes_of(node)
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in MAKERS and node.args:
            made |= codes_of(node.args[0])
    assert len(made) > 60
    assert made - phrases().keys() == set()
    assert {code for code in phrases() if not code.startswith("t.")} - literal == set()


def test_codes_are_a_family_and_a_name() -> None:
    for code in phrases():
        family, _, name = code.partition(".")
        assert family.isidentifier() and name.isidentifier() and code.islower()
