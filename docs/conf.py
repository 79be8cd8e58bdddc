"""How Sphinx builds the site: pages in Markdown, the API reference from docstrings (`make docs`)."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import api_pages  # noqa: E402
import records  # noqa: E402
from docstrings import to_rest  # noqa: E402

import travjax  # noqa: E402

project = "travjax"
author = "the travjax authors"
version = release = travjax.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "travjax"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True

# Types of other packages, whose documentation lies elsewhere.
nitpick_ignore_regex = [("py:.*", r"(?!travjax).*")]
nitpick_ignore = [("py:class", "travjax.config.Config")]  # a type variable


def setup(app):
    """Writes the pages that are made of other files, and turns docstrings into reStructuredText."""
    api_pages.write(HERE / "api")
    records.write(HERE / "records")
    app.connect("source-read", _link_records)
    app.connect("autodoc-process-docstring", _to_rest)


def _link_records(app, docname: str, content: list[str]) -> None:
    page = HERE / f"{docname}.md"
    if page.exists() and not docname.startswith("records/"):
        content[0] = records.with_links_between_pages(content[0], page, page)


def _to_rest(app, what, name, obj, options, lines: list[str]) -> None:
    lines[:] = to_rest(lines)
