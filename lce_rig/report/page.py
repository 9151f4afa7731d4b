"""Render a page from its template: one file that loads nothing, with everything escaped that is put into it.

`templates/frame.html` is the frame of every page, with its style and its content security policy, which
forbids requests; `templates/parts.html` holds tables, drawings and badges.
"""

from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined


@cache
def environment() -> Environment:
    """Give the templates: everything that is put into them is escaped, and nothing may be missing."""
    return Environment(
        loader=PackageLoader("lce_rig.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render(template: str, **values: object) -> str:
    """Write a page: the same values give the same bytes.

    Args:
        template: file of `templates/`; it extends frame.html.
        values: what the template names. Text is escaped; `drawing` returns markup, which is not.
    """
    return environment().get_template(template).render(**values) + "\n"
