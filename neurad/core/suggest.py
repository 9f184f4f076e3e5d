"""What somebody probably meant: the nearest of the names that there are."""

from collections.abc import Iterable

ALIKE = 0.6
"""Similarity of two names, in [0, 1], from which on one is suggested for the other."""


def nearest(name: str, names: Iterable[str]) -> str | None:
    """The name that is most similar, whatever the case; None where none is."""
    from difflib import get_close_matches  # imported when something is wrong, so that help answers at once

    known = {other.lower(): other for other in names}
    found = get_close_matches(name.lower(), known, 1, ALIKE)
    return known[found[0]] if found else None


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """The end of a sentence about a name that does not exist: ``, did you mean kitchen.yaml?``, or nothing."""
    found = nearest(name, names)
    return "" if found is None or found == name else f", did you mean {found}?"
