"""Writes the pages of the API reference: one of the public names, and one of each package with all its modules."""

import importlib
import pkgutil
from pathlib import Path

import travjax

HIDDEN = {"travjax.__main__", "travjax.experiments"}
"""What acts when it is imported."""


def write(folder: Path) -> None:
    """Writes index.rst and a page a package into the folder, and removes pages of packages that are no more."""
    folder.mkdir(exist_ok=True)
    packages = [
        info.name
        for info in pkgutil.iter_modules(travjax.__path__, "travjax.")
        if info.ispkg and info.name not in HIDDEN
    ]
    pages = {"public": _public(), "travjax": _modules("travjax", "What everything stands on")}
    pages |= {name.removeprefix("travjax."): _modules(name, name) for name in packages}
    pages["index"] = _index(list(pages))
    for path in folder.glob("*.rst"):
        if path.stem not in pages:
            path.unlink()
    for name, text in pages.items():
        path = folder / f"{name}.rst"
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


def _heading(text: str, underline: str = "=") -> str:
    return f"{text}\n{underline * len(text)}\n\n"


def _index(pages: list[str]) -> str:
    entries = "".join(f"   {page}\n" for page in pages)
    return f"{_heading('API reference')}.. toctree::\n   :maxdepth: 1\n\n{entries}"


def _public() -> str:
    """Returns the page of the names that `import travjax` offers."""
    text = _heading("Public names")
    for name in travjax.__all__:
        value = getattr(travjax, name)
        if isinstance(value, type):
            text += f".. autoclass:: travjax.{name}\n   :members:\n\n"
        elif callable(value):
            text += f".. autofunction:: travjax.{name}\n\n"
        else:
            text += f".. py:data:: travjax.{name}\n\n   ``{value!r}``\n\n"
    return text


def _modules(package: str, title: str) -> str:
    """Returns the page of a package: its own docstring, then its modules."""
    path = importlib.import_module(package).__path__
    text = _heading(title) + f".. automodule:: {package}\n\n"
    for info in pkgutil.iter_modules(path, f"{package}."):
        if not info.ispkg and info.name not in HIDDEN:
            text += _heading(info.name.removeprefix("travjax."), "-") + f".. automodule:: {info.name}\n   :members:\n\n"
    return text
