"""What mkdocs needs beyond the pages of docs/: the files at the top of the repository, and GitHub's lists."""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
# Files at the top of the repository that are pages too, and the names of these pages.
TOP_PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
}
# Files that the site holds as they are.
TOP_FILES = {"CITATION.cff": "citation.cff", "docs/site/site.css": "site.css"}
_ALL = {**TOP_PAGES, **TOP_FILES}
_LINK = re.compile(r"(\]\(|src=\")([^)#\"\s]+)")
_CODE = re.compile(r"`[^`]*`")
_ITEM = re.compile(r"\s*([-*]|\d+\.) ")
_ROW = re.compile(r"\|")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from the top of the repository."""
    for name, page in TOP_PAGES.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=_LINK.sub(_within_docs, text)))
    for name, target in TOP_FILES.items():
        files.append(File.generated(config, target, abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Turn links to files at the top into links to their pages, and open lists as GitHub does."""
    depth = "../" * (len(PurePosixPath(page.file.src_uri).parts))
    for name, target in TOP_PAGES.items():
        markdown = markdown.replace(f"]({depth}{name}", f"]({depth[3:]}{target}")
    return "\n".join(_open_lists(_plain_pipes(line) for line in markdown.splitlines()))


def _plain_pipes(line: str) -> str:
    r"""Take the backslash off `\|` in code in a table, which GitHub wants and Python-Markdown shows."""
    return _CODE.sub(lambda code: code[0].replace("\\|", "|"), line) if line.startswith("|") else line


def _within_docs(match: re.Match[str]) -> str:
    """Make a link of a file at the top one of a file in docs/."""
    opening, target = match.groups()
    return opening + _ALL.get(target, target.removeprefix("docs/"))


def _open_lists(lines: Iterable[str]) -> Iterator[str]:
    """Put an empty line before each list and table that follows a paragraph at once; Markdown wants one."""
    before, is_code = "", False
    for line in lines:
        is_code ^= line.lstrip().startswith("```")
        starts = [bool(pattern.match(line)) and not pattern.match(before) for pattern in (_ITEM, _ROW)]
        is_paragraph = bool(before.strip()) and not before.startswith((" ", "#"))
        if any(starts) and is_paragraph and not is_code and not _ITEM.match(before):
            yield ""
        yield line
        before = line
