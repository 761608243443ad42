"""Errors that a user can fix."""

from collections.abc import Sequence


class DuagError(Exception):
    """One line that names the file, the topic, what was found and what was expected.

    The command line prints the line and exits with 1; anything else that is raised is a bug.
    """

    def __str__(self) -> str:
        """One printable line, whatever names of topics and files it holds."""
        text = super().__str__()
        if text.isprintable():
            return text
        return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def closest(word: str, known: Sequence[str], kind: str) -> str:
    """The end of a line about a wrong name: what was perhaps meant, else what there is, else that no `kind` is.

    Args:
        word: the wrong name.
        known: names that exist.
        kind: what the name is of, with its article.
    """
    import difflib

    near = difflib.get_close_matches(word, known, n=1, cutoff=0.6)
    if near:
        return f"expected perhaps {near[0]}"
    return f"expected one of {', '.join(known)}" if known else f"expected {kind}, and there is none"
