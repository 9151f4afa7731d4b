"""Every page is found, every link leads somewhere, and pictures stay small."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
# Code holds no links; those to the web are not followed.
_CODE = re.compile(r"^```.*?^```|`[^`\n]*`", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\]\((?!https?:|mailto:|#)([^)#\s]+)")
_CLICKS = 2
_IMAGES_BYTES = 3_000_000


def links(page):
    return [
        (page.parent / target).resolve() for target in _LINK.findall(_CODE.sub("", page.read_text("utf-8")))
    ]


def pages():
    return [*ROOT.glob("*.md"), *DOCS.glob("*.md")]


def test_links_lead_to_files_of_the_repository():
    missing = {(page.name, str(target)) for page in pages() for target in links(page) if not target.exists()}
    assert not missing


def test_every_page_is_two_clicks_from_the_readme_at_most():
    reached = {(ROOT / "README.md").resolve()}
    for _ in range(_CLICKS):
        reached |= {target for page in reached if page.suffix == ".md" for target in links(page)}
    assert {page.name for page in pages()} <= {page.name for page in reached}


def test_every_image_is_shown_somewhere_and_all_are_small():
    images = {path.resolve() for path in (DOCS / "images").iterdir()}
    assert images <= {target for page in pages() for target in links(page)}
    assert sum(path.stat().st_size for path in images) < _IMAGES_BYTES


def test_no_page_holds_the_marks_of_a_merge():
    torn = [
        page.name for page in pages() if re.search(r"^(<<<<<<<|=======$|>>>>>>>)", page.read_text(), re.M)
    ]
    assert not torn
