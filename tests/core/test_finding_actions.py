"""Every action named by a caller exists in its kind, and has the figures of its text."""

import ast
import string
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

import lce_rig
from lce_rig.core.findings import KINDS, Kind

PACKAGE = Path(lce_rig.__file__).parent
for _path in sorted(PACKAGE.glob("*/findings.py")):
    import_module(f"lce_rig.{_path.parent.name}.findings")


def _figures(template):
    """Make a figure for each name in a template; a size may be an angle or a length."""
    text = template if isinstance(template, str) else template.__doc__ or ""
    return {
        f"{name}_m" if (spec or "").endswith("size") else name: (1, 2) if spec == "few" else 1.5
        for _, name, spec, _ in string.Formatter().parse(text)
        if name and name not in ("subject", "session")
    }


def _assigned(function, name):
    """Yield the expressions that a function assigns to a local variable, by position in a tuple."""
    for node in ast.walk(function):
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        elif isinstance(node, ast.For | ast.comprehension):
            targets = [node.target]
        else:
            continue
        values = [node.iter] if isinstance(node, ast.For | ast.comprehension) else [node.value]
        if isinstance(values[0], ast.Tuple | ast.List) and isinstance(node, ast.For | ast.comprehension):
            values = values[0].elts
        for target in targets:
            for value in values:
                if isinstance(target, ast.Name) and target.id == name:
                    yield value
                elif isinstance(target, ast.Tuple):
                    for i, each in enumerate(target.elts):
                        if isinstance(each, ast.Name) and each.id == name:
                            yield value.elts[i] if isinstance(value, ast.Tuple) else value


def _results(expression, function, of):
    """Yield `of` each expression that one may evaluate to, as far as its function shows."""
    if isinstance(expression, ast.IfExp):
        for branch in (expression.body, expression.orelse):
            yield from _results(branch, function, of)
    elif isinstance(expression, ast.Name) and (assigned := list(_assigned(function, expression.id))):
        for value in assigned:
            yield from _results(value, function, of)
    else:
        yield of(expression)


@cache
def _uses():
    """List (place, kind, action, figures or None where they are not all named) of each call."""
    uses = []
    for path in sorted(PACKAGE.rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        inner = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
        module = ".".join(["lce_rig", *path.relative_to(PACKAGE).with_suffix("").parts])
        for function in inner:
            for call in ast.walk(function):
                stated = {word.arg: word.value for word in getattr(call, "keywords", ())}
                if isinstance(call, ast.Call) and "action" in stated:
                    uses.extend(_of_call(call, stated, function, module))
    return uses


def _of_call(call, stated, function, module):
    named = call.func
    if isinstance(named, ast.Attribute) and named.attr == "refusal":
        named = named.value
    kinds = [kind for kind in _results(named, function, lambda e: _kind(e, module)) if kind is not None]
    figures = None if None in stated else set(stated) - {"action", "severity"}
    place = f"{module}:{call.lineno}"
    for action in _results(stated["action"], function, lambda e: getattr(e, "value", None)):
        if isinstance(action, str):
            yield from ((place, kind, action, figures) for kind in kinds)


def _kind(expression, module):
    """Look a constant of a module up, "NAME" or "findings.NAME"."""
    if not isinstance(expression, ast.Name | ast.Attribute):
        return None
    at = import_module(module)
    for name in ast.unparse(expression).split("."):
        at = getattr(at, name, None)
    return at if isinstance(at, Kind) else None


def test_actions_match_their_kinds():
    uses = _uses()
    assert len({place for place, *_ in uses}) > 15
    assert len({(kind.code, action) for _, kind, action, _ in uses}) > 25
    unknown = [
        (place, kind.code, action) for place, kind, action, _ in uses if action and action not in kind.actions
    ]
    assert unknown == []


def test_actions_of_callers_have_their_figures():
    for place, kind, action, figures in _uses():
        if figures is not None:
            template = kind.actions[action] if action else kind.action
            assert set(_figures(template)) <= figures, (place, kind.code, action)


@pytest.mark.parametrize("code", sorted(KINDS))
def test_templates_render(code):
    kind = KINDS[code]
    for action in ("", *kind.actions):
        templates = kind.text, kind.actions.get(action, kind.action)
        figures = {name: value for each in templates for name, value in _figures(each).items()}
        found = kind("it", action=action, **figures)
        texts = (found.text if isinstance(templates[0], str) else "",)
        texts += (found.advice if isinstance(templates[1], str) else "",)
        assert not any("{" in text for text in texts)
