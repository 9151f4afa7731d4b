#!/usr/bin/env python3
"""Write docs/findings.md: every code that `--json` and result.json may hold, with its figures and words."""

import string
import sys
from importlib import import_module
from itertools import groupby
from pathlib import Path

import lce_rig
from lce_rig.core.findings import KINDS, Kind, Template

PAGE = Path(__file__).parents[1] / "docs" / "findings.md"
HEAD = """# Findings
`--json` and result.json hold findings as facts. Codes, figure names, units and action codes
are stable; texts may change in any release.

| field | content |
|---|---|
| `code` | "family.name" |
| `severity` | `note`: changes nothing; `warning`: usable, less well; `error`: must not be used |
| `subject` | a sensor, a capture, a profile key or a file; "" where it is plain |
| `figures` | by name with units (`_m`, `_deg`, `_s`, `_px`, `_mps`), *in italics* below; null if unknown |
| `action_code` | which of several actions applies, listed below; "" for the usual one |
| `follows` | code of the cause that explains this finding; "" for a cause. Resolve the cause first |
| `text`, `action` | the same in words, with the command to type |

Refused captures have `stage` and `cause` in place of `severity` and `text`; the code begins with the stage:
`read`, `image`, `lidar`, `pair` (camera and LiDAR disagree) or `calibrate`.

| command | prints with `--json` |
|---|---|
| `check` | the detections in each capture, or its refusal |
| `calibrate` | result.json, with `findings` and `captures_refused` of each camera and LiDAR |
| `verify` | residuals of each capture; `doubts`: findings by which captures contradict the extrinsics |
| `drift` | for each camera and LiDAR its `state`, the opinions of scene and boards with figures, `findings` |
| `repeat` | `findings` on the sessions; for each camera and LiDAR figures and a `finding`, the verdict |
| `doctor` | each check with its `findings` ([more](doctor.md)) |

Exit codes are the same with and without `--json`. `scripts/findings_page.py` writes this page.
"""


def page() -> str:
    """Build the page."""
    for path in sorted(Path(lce_rig.__file__).parent.glob("*/findings.py")):
        import_module(f"lce_rig.{path.parent.name}.findings")
    parts = [HEAD]
    for family, codes in groupby(sorted(KINDS), key=lambda code: code.partition(".")[0]):
        parts.append(f"## {family}\n| code | text | action codes |\n|---|---|---|")
        parts.extend(_row(KINDS[code]) for code in codes)
        parts.append("")
    return "\n".join(parts)


def _row(kind: Kind) -> str:
    templates = [kind.text, kind.action, *kind.actions.values()]
    names = dict.fromkeys(name for template in templates for name in _figures(template))
    text = _shown(kind.text)
    hidden = [f"*{name}*" for name in names if f"*{name}*" not in text]
    text += f" ({', '.join(hidden)})" if hidden else ""
    cells = f"`{kind.code}`", text, ", ".join(f"`{name}`" for name in kind.actions)
    return f"| {' | '.join(cell.replace('|', '/').replace(chr(10), '<br>') for cell in cells)} |"


def _figures(template: Template) -> list[str]:
    """List the figures of a template; for a function, those in its docstring, as {name}."""
    text = template if isinstance(template, str) else template.__doc__ or ""
    names = [name for _, name, _, _ in string.Formatter().parse(text) if name]
    return [name for name in names if name not in ("subject", "session")]


def _shown(template: Template) -> str:
    """Show a template with the names of its figures in place of their values."""
    text = template if isinstance(template, str) else (template.__doc__ or "").splitlines()[0].rstrip(".")
    shown = ""
    for before, name, _, _ in string.Formatter().parse(text):
        shown += before + ("SESSION" if name == "session" else f"*{name}*" if name else "")
    return shown


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    sys.stdout.write(f"{PAGE}\n")
