"""Visible states of a page, as expressions to wait for."""

from .conftest import state

OPEN = "document.body?.dataset.connection === 'open'"


def shown(preview, page, until, **changes):
    """Publish a state and wait until the page shows it."""
    page.wait_until(OPEN)
    preview.publish(state(**changes))
    page.wait_until(until)


def has_text(element, text):
    return f"document.getElementById({element!r}).textContent.replaceAll('\\u00a0', ' ') === {text!r}"
