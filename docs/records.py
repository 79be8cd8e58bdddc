"""Makes the Markdown files that lie outside docs/ pages of the site: build notes, reports, model cards.

Every file becomes records/PATH.md, and links between pages lead to it. On GitHub the same links lead to the files.
"""

import os
import re
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent

_LINK = re.compile(r"(?P<text>!?\[[^\]]*\])\((?P<target>[^)#\s:]+)(?P<anchor>#[^)\s]*)?\)")


def sources() -> list[Path]:
    """Returns the Markdown files of the repository that are not in docs/."""
    return sorted(
        path
        for where in ("*.md", "experiments/**/*.md", "examples/**/*.md", "travjax/**/*.md")
        for path in ROOT.glob(where)
    )


def write(folder: Path) -> None:
    """Writes the pages and their index into the folder, and removes those of files that are no more."""
    pages = {_record(source): _page(source) for source in sources()}
    entries = "\n".join(str(page.relative_to(folder)) for page in pages)
    pages[folder / "index.md"] = f"# Records\n\n```{{toctree}}\n:maxdepth: 1\n\n{entries}\n```\n"
    for path in folder.rglob("*.md"):
        if path not in pages:
            path.unlink()
    for path, text in pages.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


def with_links_between_pages(text: str, source: Path, page: Path) -> str:
    """Returns a text of the source file as it stands on a page: its relative links lead to pages, else to files."""

    def link(match: re.Match) -> str:
        target = (source.parent / match["target"]).resolve()
        if target.is_dir():
            if not (target / "README.md").exists():
                return match["text"].strip("[]")
            target /= "README.md"
        if target.suffix == ".md" and not target.is_relative_to(HERE):
            target = _record(target)
        return f"{match['text']}({os.path.relpath(target, page.parent)}{match['anchor'] or ''})"

    return _LINK.sub(link, text)


def _record(source: Path) -> Path:
    return HERE / "records" / source.relative_to(ROOT)


def _page(source: Path) -> str:
    text = with_links_between_pages(source.read_text(), source, _record(source))
    return text if text.startswith("# ") else f"# {source.relative_to(ROOT)}\n\n{text}"
