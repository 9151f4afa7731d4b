"""What a page shows, as expressions that can be waited for."""

from typing import Any

from lce_rig.show.phone.preview import Preview

from .browser import Page
from .conftest import state

OPEN = "document.body?.dataset.connection === 'open'"


def shown(preview: Preview, page: Page, until: str, **changes: Any) -> None:
    """Publish a state and wait until the page shows it."""
    page.wait_until(OPEN)
    preview.publish(state(**changes))
    page.wait_until(until)


def has_text(element: str, text: str) -> str:
    return f"document.getElementById({element!r}).textContent.replaceAll('\\u00a0', ' ') === {text!r}"
