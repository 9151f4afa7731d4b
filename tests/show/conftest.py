"""A real browser."""

import shutil

import pytest

from tests.show.phone.browser import Browser

_BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="session")
def started_browser(tmp_path_factory):
    """A headless browser for all tests."""
    executable = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if executable is None:
        pytest.skip(f"none of {', '.join(_BROWSERS)} is installed")
    with Browser(executable, tmp_path_factory.mktemp("browser")) as started:
        yield started


@pytest.fixture
def browser(started_browser):
    """A headless browser without open pages."""
    yield started_browser
    started_browser.close_pages()
