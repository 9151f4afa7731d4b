import re

import aiohttp
import pytest

from lce_rig.core.errors import UsageError
from lce_rig.show.phone import Preview

from .conftest import state
from .watcher import Watcher

FILES = ("", "page.css", "page.js", "stage.js", "live", "nothing-here")


def test_this_computer_needs_no_token_and_others_do() -> None:
    with Preview("127.0.0.1", 0) as alone, Preview("0.0.0.0", 0) as shared:
        assert "token" not in alone.urls[0]
        token = shared.urls[0].partition("?token=")[2]
        assert re.fullmatch(r"[A-Za-z0-9_-]{12}", token)
    with Preview("0.0.0.0", 0) as again:
        assert token not in again.urls[0]


@pytest.mark.parametrize(
    "query", ["", "?token=", "?token=wrong-one", "?token=abcdefg", "?token=abcdefghi", "?token=%FF"]
)
def test_without_the_token_there_is_nothing(query: str) -> None:
    with Preview(port=0, token="abcdefgh") as preview, Watcher(preview.urls[0]) as watcher:
        preview.publish(state())
        for path in FILES:
            status, _, content = watcher.get(path + query)
            assert status == 403, path
            assert b"whole link" in content
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            watcher.watch(query)


def test_the_link_opens_the_page_and_its_cookie_all_it_loads() -> None:
    with Preview(port=0, token="abcdefgh") as preview, Watcher(preview.urls[0]) as watcher:
        preview.publish(state())
        status, headers, content = watcher.get("?token=abcdefgh")
        assert status == 200
        assert b"<h1" in content
        assert "HttpOnly" in headers["Set-Cookie"]
        assert "SameSite=Lax" in headers["Set-Cookie"]
        assert watcher.get("page.js")[0] == 200
        watcher.watch()
        assert watcher.next_state()[0]["n_captures"] == 7
        with Watcher(preview.urls[0]) as stranger:
            assert stranger.get("page.js")[0] == 403


@pytest.mark.parametrize("token", ["", "short", "with space", "a&b=cdefgh", "x" * 200])
def test_a_token_that_cannot_be_part_of_a_link_is_refused(token: str) -> None:
    with pytest.raises(UsageError, match="token cannot be used"):
        Preview(token=token)


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8765", "127.0.0.1.evil.example", "localhost.evil.example", ""]
)
def test_a_site_whose_name_is_pointed_at_this_computer_gets_nothing(preview: Preview, host: str) -> None:
    with Watcher(preview.urls[0]) as watcher:
        for path in ("", "page.js", "live"):
            assert watcher.get(path, {"Host": host})[0] == 403


@pytest.mark.parametrize(
    "host", ["127.0.0.1:{port}", "localhost:{port}", "localhost:9000", "[::1]:{port}", "LOCALHOST"]
)
def test_names_of_this_computer_are_served(preview: Preview, host: str) -> None:
    port = preview.urls[0].rstrip("/").rpartition(":")[2]
    with Watcher(preview.urls[0]) as watcher:
        assert watcher.get("", {"Host": host.format(port=port)})[0] == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://{host}", "http://127.0.0.1:1"])
def test_other_sites_cannot_watch_through_a_visitors_browser(preview: Preview, origin: str) -> None:
    host = preview.urls[0].removeprefix("http://").rstrip("/")
    with Watcher(preview.urls[0]) as watcher:
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            watcher.watch(headers={"Origin": origin.format(host=host)})
        watcher.watch(headers={"Origin": f"http://{host}"})


def test_pages_may_load_nothing_from_elsewhere_and_are_not_framed_or_kept(preview: Preview) -> None:
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
def test_only_files_of_the_page_are_served(preview: Preview, path: str) -> None:
    with Watcher(preview.urls[0]) as watcher:
        assert watcher.get(path)[0] == 404
