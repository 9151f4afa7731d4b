"""Pages and their drawings: self-contained files in which all inserted text is escaped."""

import re
from functools import cache
from io import StringIO
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape


@cache
def environment() -> Environment:
    """Return the templates: inserted text is escaped, and a missing value is an error."""
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
    """Set words of findings for a page: commands between backquotes as code, +- as one sign."""
    escaped = str(escape(text)).replace("+-", "±")
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", escaped).replace("\n", "<br>"))


def render(template: str, **values: object) -> str:
    """Write a page: the same values give the same bytes.

    Args:
        template: file of `templates/`; it extends frame.html.
        values: by the template's names. Text is escaped; `drawing` returns markup, which is not;
            the filter `words` sets the texts of findings.
    """
    return environment().get_template(template).render(**values) + "\n"


INK, QUIET, FAINT, SHADE = "#1b1f24", "#5b636b", "#b9c0c8", "#eceff2"
BLUE, ORANGE, GREEN, RED = "#1f6fb4", "#c9660a", "#1a7f4b", "#c62f2f"
# The page's style sheet redefines these in the dark.
_VARIABLES = {
    INK: "ink", QUIET: "quiet", FAINT: "line", SHADE: "shade",
    BLUE: "blue", ORANGE: "orange", GREEN: "good", RED: "bad",
}  # fmt: skip
WIDTH_IN = 4.4
"""Drawings of this width stay legible on a phone; a wide screen shows several side by side."""
_FONT_PT = 8.5
# Most of the drawing time goes into ticks.
_MOST_TICKS = 5
_PAGE_HAS = [
    (re.compile(pattern, re.DOTALL), replacement)
    for pattern, replacement in (
        (r"<metadata>.*?</metadata>|<defs>\s*<style[^>]*>.*?</style>\s*</defs>", ""),
        (r' id="[a-zA-Z0-9.]+_\d+"| target="_blank"| transform="rotate\(-0 [^"]*"', ""),
        (r" font-family: [^;]*;|font: (?=[\d.]+px)", ""),
        (r"\s*\n\s*", "\n"),
    )
]
_STYLE: Any = {
    "text.parse_math": False,
    "svg.fonttype": "none",
    "font.size": _FONT_PT,
    "axes.titlesize": _FONT_PT,
    "axes.labelsize": _FONT_PT,
    "xtick.labelsize": _FONT_PT,
    "ytick.labelsize": _FONT_PT,
    "legend.fontsize": _FONT_PT,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": QUIET,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    # Otherwise Matplotlib measures all texts to place a title above them.
    "axes.titley": 1.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "text.color": INK,
    "grid.color": FAINT,
    "grid.linewidth": 0.5,
    "legend.frameon": False,
}


def style(part: str = "") -> Any:
    """Return the context in which figures of a part of a page are made and drawn."""
    from matplotlib import rc_context

    return rc_context(_STYLE | {"svg.hashsalt": part})


def new_axes(
    height_in: float,
    n_columns: int = 1,
    *,
    left_in: float = 0.42,
    right_in: float = 0.1,
    bottom_in: float = 0.42,
    top_in: float = 0.25,
    between_in: float = 0.45,
) -> tuple[Any, list[Any]]:
    """Start a Matplotlib figure for `drawing` with axes side by side; call it within `style`.

    Margins are given, as measuring all texts to find them takes longer than the drawing.
    """
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(WIDTH_IN, height_in))
    width_in = (WIDTH_IN - left_in - right_in - (n_columns - 1) * between_in) / n_columns
    row = figure.subplots(
        1,
        n_columns,
        squeeze=False,
        gridspec_kw={
            "left": left_in / WIDTH_IN,
            "right": 1 - right_in / WIDTH_IN,
            "bottom": bottom_in / height_in,
            "top": 1 - top_in / height_in,
            "wspace": between_in / width_in,
        },
    )[0]
    for axes in row:
        axes.locator_params(nbins=_MOST_TICKS)
    return figure, list(row)


def drawing(figure: Any, label: str) -> Markup:
    """Write a figure as inline SVG: the same figure and label give the same bytes.

    An artist's `set_url("#name")` makes it a link.

    Args:
        figure: of Matplotlib, in the colours of this module; call it within `style`.
        label: its content, for screen readers; labels within one part of a page differ.
    """
    from matplotlib import rc_context, rcParams
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    figure.patch.set_alpha(0.0)
    for axes in figure.axes:
        axes.patch.set_alpha(0.0)
    written = StringIO()
    # Names of clipping paths are hashes of their content; equal ones of two drawings must not be mixed up.
    with rc_context({"svg.hashsalt": f"{rcParams['svg.hashsalt']} {label}"}):
        canvas: Any = FigureCanvasSVG(figure)
        canvas.print_svg(written, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return _as_part_of_a_page(written.getvalue(), label)


def _as_part_of_a_page(svg: str, label: str) -> Markup:
    """Strip an SVG file for a page: no names of parts, no fonts and no colours of its own."""
    box = re.search(r'viewBox="[^"]*"', svg)
    assert box is not None
    text = svg[svg.index(">", box.end()) + 1 :]
    for pattern, replacement in _PAGE_HAS:
        text = pattern.sub(replacement, text)
    for colour, name in _VARIABLES.items():
        text = text.replace(colour, f"var(--{name})")
    return Markup(f'<svg {box[0]} role="img" aria-label="{escape(label)}">{text.strip()}')
