"""Self-contained pages: everything inserted is escaped."""

import re
from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape


@cache
def environment() -> Environment:
    """Return the templates: everything inserted is escaped, and missing values are errors."""
    made = Environment(
        loader=PackageLoader("lce_rig.show.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["words"] = as_markup
    return made


def as_markup(text: str) -> Markup:
    """Format finding texts for a page: commands between backquotes as code, +- as one sign."""
    escaped = str(escape(text)).replace("+-", "±")
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", escaped).replace("\n", "<br>"))


def render(template: str, **values: object) -> str:
    """Write a page; the same values give the same bytes.

    Args:
        template: file of `templates/`; it extends frame.html.
        values: values by name. Text is escaped; `svg.Axes` returns markup, which is not;
            the filter `words` sets the texts of findings.
    """
    return environment().get_template(template).render(**values) + "\n"
