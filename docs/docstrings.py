"""Docstrings of travjax as reStructuredText.

A docstring is a sentence, then lines such as `heights: [n, rows, cols] metres`, whose continuation is indented, then
what is returned and raised. In reStructuredText these lines become a list, and what else would be markup is escaped.
"""

import re
from collections.abc import Iterator
from itertools import groupby

_NAMES = r"\*{0,2}[A-Za-z_]\w*(?:, \*{0,2}[A-Za-z_]\w*)*"
_ENTRY = re.compile(rf"(?P<names>{_NAMES}):\s+(?P<text>\S.*)")
_ENTRY_WITHOUT_TEXT = re.compile(rf"(?P<names>{_NAMES})$")
_BULLET = re.compile(r"- (?P<text>.*)")
_NEW_PARAGRAPH = re.compile(r"(Returns|Raises|Source)\b")


def to_rest(lines: list[str]) -> list[str]:
    """Returns the lines of a docstring, which is not indented, as lines of reStructuredText."""
    result: list[str] = []
    for blank, group in groupby(lines, key=lambda line: not line.strip()):
        if not blank:
            result.extend(_paragraph(list(group)))
    return result


def _paragraph(lines: list[str]) -> Iterator[str]:
    """Yields a paragraph, with the blank lines around its parts; an indented one is code."""
    if all(line.startswith("    ") for line in lines):
        yield from (".. code-block:: text", "", *lines, "")
        return
    for is_item, text in _parts(lines):
        yield from ([f"- {text}"] if is_item else ["", text, ""])
    yield ""


def _parts(lines: list[str]) -> list[tuple[bool, str]]:
    """Joins lines to list items, each with its continuation, and to prose; returns whether each is an item."""
    parts: list[tuple[bool, str]] = []
    in_list = False
    for line in lines:
        item = _item(line.strip(), in_list) if not line.startswith(" ") else None
        if item is not None:
            parts.append((True, item))
        elif parts and (line.startswith(" ") or not (in_list or _NEW_PARAGRAPH.match(line))):
            is_item, text = parts[-1]
            parts[-1] = is_item, f"{text} {_escaped(line.strip())}"
        else:
            parts.append((False, _escaped(line.strip())))
        in_list = parts[-1][0]
    return parts


def _item(line: str, in_list: bool) -> str | None:
    """Returns a line that begins a list item as that item, and None for any other."""
    if entry := _ENTRY.match(line):
        return f"**{_escaped(entry['names'])}**: {_escaped(entry['text'])}"
    if bullet := _BULLET.match(line):
        return _escaped(bullet["text"])
    if in_list and (entry := _ENTRY_WITHOUT_TEXT.match(line)):
        return f"**{_escaped(entry['names'])}**"
    return None


def _escaped(line: str) -> str:
    """Returns a line in which only `code` is markup; a backquote without a partner is left as an apostrophe."""
    pieces = line.split("`")
    if len(pieces) % 2 == 0:
        pieces = ["'".join(pieces)]
    return "".join(f"``{piece}``" if place % 2 else _plain(piece) for place, piece in enumerate(pieces))


def _plain(text: str) -> str:
    return re.sub(r"([\\*_|])", r"\\\1", text).replace("::", ":\\:")
