"""The pages of the documentation, and how their words are counted."""

from __future__ import annotations

import re
from pathlib import Path

from tests.docs.generate import BEGIN, DOCS, END

ROOT = DOCS.parent
KINDS = ("tutorial", "how-to", "reference", "explanation", "results", "lab")


def pages() -> list[Path]:
    """Every page, in order of its path."""
    return sorted(DOCS.rglob("*.md"))


def front_matter(text: str) -> dict[str, str]:
    """What stands between the first two lines of dashes; empty if there is none."""
    found = re.match(r"---\n(.*?)\n---\n", text, re.DOTALL)
    lines = found[1].splitlines() if found else []
    return {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}


def kind(page: Path) -> str:
    """The kind that a page says it is of; empty if it says none."""
    return front_matter(page.read_text(encoding="utf-8")).get("kind", "")


def is_generated(page: Path) -> bool:
    """Whether the whole page is made from the code."""
    return front_matter(page.read_text(encoding="utf-8")).get("generated") == "true"


def prose(page: Path) -> str:
    """A page without front matter, generated blocks and code in fences."""
    text = re.sub(r"\A---\n.*?\n---\n", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    text = re.sub(re.escape(BEGIN) + ".*?" + re.escape(END), "", text, flags=re.DOTALL)
    return re.sub(r"^ *```.*?^ *```", "", text, flags=re.DOTALL | re.MULTILINE)


def count_words(page: Path) -> int:
    """Words of a page that somebody wrote: parts between spaces with a letter or a digit, tables included.

    Pages and blocks that are generated from the code do not count, and neither does code in fences.
    """
    return 0 if is_generated(page) else sum(any(c.isalnum() for c in part) for part in prose(page).split())
