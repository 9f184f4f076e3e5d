"""Names that no two things share."""

from __future__ import annotations


def apart(name: str, taken: set[str], joint: str = "-", capitals: bool = True) -> str:
    """The name, or the first with a number behind it that is not taken; it is from then on.

    Args:
        name: wanted.
        taken: by others; the one that is found is added.
        joint: what stands between name and number.
        capitals: whether names that differ in these alone are two; some file systems do not tell them apart.
    """
    made, count = name, 1
    while (made if capitals else made.lower()) in taken:
        count += 1
        made = f"{name}{joint}{count}"
    taken.add(made if capitals else made.lower())
    return made
