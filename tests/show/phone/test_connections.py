"""Pages that sleep or fail affect neither other pages nor the collection."""

import time

import pytest

from lce_rig.show.phone import pages
from lce_rig.show.phone.pages import Pages
from lce_rig.show.phone.preview import Preview

from .conftest import state
from .watcher import Watcher

pytestmark = pytest.mark.realtime


def test_idle_page_connection_is_replaced(preview, monkeypatch):
    monkeypatch.setattr(pages, "ANSWER_S", 3.0)
    with Watcher(preview.urls[0]) as asleep, Watcher(preview.urls[0]) as awake:
        asleep.watch()
        awake.watch()
        for _ in range(6):
            preview.publish(state())
            awake.next_state()
            time.sleep(0.1)
        while not isinstance(asleep.receive(), int):
            pass


def test_a_page_that_fails_altogether_ends_alone(monkeypatch):
    def broken(_pages):
        raise RuntimeError("broken")

    monkeypatch.setattr(Pages, "application", broken)
    with Preview(port=0) as preview:
        preview.publish(state())
    assert preview.failure == "RuntimeError('broken')"
