"""The README and the documentation: their Python runs, their links lead somewhere, and the README stays short."""

import ast
import doctest
import pkgutil
import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from tests.test_layering import LAYERS, MODULES, PACKAGE, TOP, imports_of

ROOT = Path(__file__).parents[1]
MADE = {"_build", "api", "records"}
"""Folders of docs/ that building the site fills."""
PAGES = [
    path
    for where in ("*.md", "docs/**/*.md", "experiments/**/*.md", "examples/**/*.md")
    for path in ROOT.glob(where)
    if not MADE & {*path.parts}
]
README = ROOT / "README.md"
NOT_RUN = "<!-- not run -->\n"
BLOCK = re.compile(rf"(?P<left_out>{NOT_RUN})?```python\n(?P<code>.*?)^```$", re.DOTALL | re.MULTILINE)
MOST_WORDS = 900
DEFINITIONS = (ast.FunctionDef, ast.ClassDef)
LARGEST_PICTURE = 300_000


def blocks_of(page: Path) -> list[tuple[int, str]]:
    """Returns the line number and the code of each Python block that is to run."""
    text = page.read_text()
    found = [block for block in BLOCK.finditer(text) if not block["left_out"]]
    return [(text[: block.start("code")].count("\n"), block["code"]) for block in found]


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


WITH_CODE = [page for page in PAGES if (page == README or "docs" in page.parts) and blocks_of(page)]


TINY_PRESET = """
weights = "none"
elevation_scale = 0.1
[dataset]
maps = 5
validation = 0.2
test = 0.2
[trunk]
blocks = [1]
width = 4
[heads]
hidden = 4
[training]
batch_size = 8
head_epochs = 0
epochs = 1
each = 3
failing = 2
[evaluation]
each = 20
"""


@pytest.fixture
def folder(tmp_path, monkeypatch) -> None:
    """A working directory with mine.toml, a tiny preset, and site.tif, 16 x 16 m of gentle ground at 0.0625 m."""
    (tmp_path / "mine.toml").write_text(TINY_PRESET)
    rasterio = pytest.importorskip("rasterio")
    y, x = np.mgrid[:257, :257] * 0.0625
    heights = (0.3 * np.sin(x) * np.cos(0.7 * y)).astype(np.float32)
    place = rasterio.Affine(0.0625, 0, 500000, 0, -0.0625, 5000000)
    profile = dict(driver="GTiff", width=257, height=257, count=1, dtype="float32", crs="EPSG:32632")
    with rasterio.open(tmp_path / "site.tif", "w", transform=place, **profile) as file:
        file.write(heights, 1)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("page", WITH_CODE, ids=name_of)
def test_python_of_a_page_runs_and_prints_what_it_says(page, folder):
    names: dict[str, object] = {"__name__": page.stem}
    runner = doctest.DocTestRunner(verbose=False)
    for line, code in blocks_of(page):
        if ">>>" in code:
            test = doctest.DocTestParser().get_doctest(code, names, name_of(page), name_of(page), line)
            runner.run(test, clear_globs=False)
            names = test.globs
        else:
            exec(compile("\n" * line + code, page, "exec"), names)
    assert runner.summarize(verbose=False).failed == 0


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_of_a_page_lead_somewhere(page):
    targets = re.findall(r"\]\(([^)\s]+)\)", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL))
    relative = [target.split("#")[0] for target in targets if not target.startswith(("http", "#"))]
    missing = [target for target in relative if not (page.parent / target).exists()]
    assert not missing


OURS = re.compile(r"(?<![\w./*-])((?:travjax|tests|docs|experiments|examples)(?:/[\w.-]+)*/[\w.-]*\w|[\w/]+\w\.py)\b")
NAMES = re.compile(r"\btravjax(?:\.[A-Za-z_]\w*)+")
NOT_THERE = {
    *("travjax.corruption", "travjax.dataset.load"),
    *("travjax/estimators/pooled_estimator.py", "travjax.estimators.pooled_estimator", "travjax/presets/pooled"),
}
"""Names of the past, and of what a reader is to write."""


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_and_modules_that_a_page_names_exist(page):
    text = page.read_text()
    places = (ROOT, PACKAGE, page.parent)
    missing = {
        name
        for name in set(OURS.findall(text)) - NOT_THERE
        if not any((place / name).exists() for place in places) and not ("/" not in name and [*ROOT.rglob(name)])
    }
    assert not missing
    for name in set(NAMES.findall(text)) - NOT_THERE:
        assert pkgutil.resolve_name(name)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_headings_that_are_linked_exist(page):
    targets = re.findall(r"\]\(([^)\s]*\.md)?#([^)\s]+)\)", page.read_text())
    for name, anchor in targets:
        if not name.startswith("http"):
            text = (page.parent / name if name else page).read_text()
            assert anchor in anchors_of(text)


def anchors_of(text: str) -> set[str]:
    """Returns the anchors of headings, as GitHub and the site name them, and those that are set by (name)=."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    slugs = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
    return slugs | set(re.findall(r"^\((.*)\)=$", text, re.MULTILINE))


def test_the_readme_is_short():
    assert len(README.read_text().split()) <= MOST_WORDS


def test_pictures_of_the_readme_are_small():
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README.read_text())
    assert pictures
    assert all((ROOT / picture).stat().st_size < LARGEST_PICTURE for picture in pictures)


def test_the_model_of_the_page_is_the_one_that_is_tested():
    code = blocks_of(ROOT / "docs/extending/model.md")[1][1]
    tested = (ROOT / "tests/training/test_own_model.py").read_text()
    parts = [ast.get_source_segment(code, node) for node in ast.parse(code).body if isinstance(node, DEFINITIONS)]
    assert len(parts) == 4 and all(part.replace("3042", "len(FEW)") in tested for part in parts)


HEADLINES = {
    "experiments/timing/timing.tsv": ["0.00423", "0.000845", "3.49"],
    "experiments/field/laptop/evaluation/tables.txt": ["0.945", "0.793"],
    "experiments/comparison/report.md": ["0.906", "0.174", "0.830"],
    "experiments/synthetic/workstation/report.md": ["0.848", "0.723", "0.684"],
}
"""The figures that the README quotes, as they stand in their records."""


@pytest.mark.parametrize("record", HEADLINES)
def test_figures_of_the_readme_stand_in_their_records(record):
    text = (ROOT / record).read_text()
    assert all(figure in text for figure in HEADLINES[record])


def test_a_docstring_becomes_a_list_of_its_names_and_keeps_its_prose():
    to_rest = runpy.run_path(str(ROOT / "docs/docstrings.py"))["to_rest"]
    docstring = """Returns *n of `max_step`, a_b.

heights: [n, rows] metres,
         NaN unknown
left, right
robot:   a Robot
Returns [n] arrays.
Raises InputError.

    code = 1"""
    lines = [line for line in to_rest(docstring.split("\n")) if line]
    assert lines == [
        r"Returns \*n of ``max_step``, a\_b.",
        "- **heights**: [n, rows] metres, NaN unknown",
        "- **left, right**",
        "- **robot**: a Robot",
        "Returns [n] arrays.",
        "Raises InputError.",
        ".. code-block:: text",
        "    code = 1",
    ]


def test_links_between_pages_of_the_site_lead_to_pages_and_others_to_files():
    records = runpy.run_path(str(ROOT / "docs/records.py"))
    text = "[a](BUILD_NOTES.md#decisions) [b](docs/start.md) ![c](docs/images/frames.svg) [d](examples) [e](https://x.y/z.md)"
    made = records["with_links_between_pages"](text, README, ROOT / "docs/records/README.md")
    expected = "[a](BUILD_NOTES.md#decisions) [b](../start.md) ![c](../images/frames.svg) d [e](https://x.y/z.md)"
    assert made == expected


def test_packages_of_the_drawing_import_only_from_rows_below():
    rows = runpy.run_path(str(ROOT / "docs/pictures.py"))["PACKAGES"]
    row_of = {name: row for row, names in enumerate(reversed(rows)) for name in names}
    assert set(row_of) == {name for name in LAYERS if "." not in name} - {*TOP}
    for module in MODULES:
        package = module.split(".")[0]
        if package in row_of and not module.endswith("__init__"):
            used = {name.split(".")[0] for name in imports_of((PACKAGE / f"{module.replace('.', '/')}.py").read_text())}
            assert all(row_of[name] < row_of[package] for name in used & set(row_of) - {package})
