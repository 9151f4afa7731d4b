import http.client
import re

import aiohttp
import pytest

from lce_rig.show.phone.preview import Preview

from .conftest import port_of, state
from .watcher import Watcher

pytestmark = pytest.mark.realtime
FILES = ("", "page.css", "page.js", "stage.js", "live", "nothing-here")


def test_every_page_has_its_own_token():
    with Preview("127.0.0.1", 0) as first, Preview("0.0.0.0", 0) as second:
        tokens = [preview.urls[0].partition("?token=")[2] for preview in (first, second)]
        assert all(re.fullmatch(r"[A-Za-z0-9_-]{12}", token) for token in tokens)
        assert tokens[0] != tokens[1]


@pytest.mark.parametrize(
    "query", ["", "?token=", "?token=wrong-one", "?token=abcdefg", "?token=abcdefghi", "?token=%FF"]
)
def test_without_the_token_there_is_nothing(query):
    with Preview(port=0, token="abcdefgh") as preview, Watcher(preview.urls[0].partition("?")[0]) as watcher:
        preview.publish(state())
        for path in FILES:
            assert watcher.get(path + query)[0] == 403, path
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            watcher.watch(query)


def test_link_sets_cookie_for_all_requests():
    with Preview(port=0, token="abcdefgh") as preview, Watcher(preview.urls[0]) as watcher:
        preview.publish(state())
        status, headers, content = watcher.get("?token=abcdefgh")
        assert status == 200
        assert b"<h1" in content
        # No other site can open the page or its connection in a visitor's browser.
        assert "HttpOnly" in headers["Set-Cookie"] and "SameSite=Lax" in headers["Set-Cookie"]
        assert watcher.get("page.js")[0] == 200
        watcher.watch()
        assert watcher.next_state()[0]["n_captures"] == 7


def test_pages_load_nothing_and_are_not_kept(preview):
    with Watcher(preview.urls[0]) as watcher:
        for path in ("", "page.js", "nothing-here"):
            headers = watcher.get(path)[1]
            rules = dict(rule.split(maxsplit=1) for rule in headers["Content-Security-Policy"].split(";"))
            assert rules["default-src"] == rules["frame-ancestors"] == "'none'"
            assert headers["Cache-Control"] == "no-store"
            assert headers["Referrer-Policy"] == "no-referrer"
            assert headers["X-Content-Type-Options"] == "nosniff"


@pytest.mark.parametrize(
    "path", ["../preview.py", "..%2Fpreview.py", "%2e%2e/preview.py", "page/index.html", "__init__.py"]
)
def test_only_files_of_the_page_are_served(preview, path):
    with Watcher(preview.urls[0]) as watcher:
        assert watcher.get(path)[0] == 404


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Host": "localhost:1"}, 200),
        ({"Host": "rebound.example"}, 403),
        ({"Host": "rebound.example", "Origin": "http://rebound.example"}, 403),
        ({"Host": "localhost:1", "Origin": "http://localhost:1"}, 200),
        ({"Host": "localhost:1", "Origin": "http://elsewhere.example"}, 403),
    ],
)
def test_guard_answers_its_own_address_only(headers, status):
    with Preview(port=0, token="abcdefgh") as preview:
        line = http.client.HTTPConnection("127.0.0.1", port_of(preview), timeout=60)
        line.request("GET", "/?token=abcdefgh", headers=headers)
        assert line.getresponse().status == status
        line.close()
