"""The frame of pages and their parts: escaped, without requests."""

import re

from jinja2 import Environment

from lce_rig.show.report.page import environment

_PAGE = """{% extends "frame.html" %}
{% from "parts.html" import table, figure, badge %}
{% block title %}{{ title }}{% endblock %}
{% block body %}
{{ badge("marginal") }}{{ table(["name", "mm"], rows) }}{{ figure(svg, "Residuals") }}
{% endblock %}
"""


def _page(**values: object) -> str:
    own: Environment = environment()
    given = {"title": "T", "rows": [], "svg": "", **values}
    return own.from_string(_PAGE).render(**given)


def test_what_is_put_in_is_escaped():
    page = _page(title="<script>", rows=[["<img src=x>", 1]], svg="<svg>")
    assert "<script>" not in page and "<img" not in page and "<svg>" not in page
    assert "&lt;img src=x&gt;" in page


def test_the_policy_forbids_requests_and_scripts():
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', _page())
    assert policy is not None
    rules = dict(rule.strip().split(" ", 1) for rule in policy[1].split(";"))
    assert rules["default-src"] == "'none'"
    assert "script-src" not in rules
    assert not any("http" in sources or "*" in sources for sources in rules.values())
