"""Names that no two things share."""


def make_unique(name: str, taken: set[str], joint: str = "-", capitals: bool = True) -> str:
    """The name, or one with a number behind it that is not taken; it is from then on.

    Of many things of one name each gets the next number, without asking for all of those before.

    Args:
        taken: by others; the one that is found is added.
        joint: what stands between name and number.
        capitals: whether names that differ in these alone are two; some file systems do not tell them apart.
    """

    def made(count: int) -> str:
        numbered = name if count == 1 else f"{name}{joint}{count}"
        return numbered if capitals else numbered.lower()

    high = 1
    while made(high) in taken:
        high *= 2
    low = high // 2  # taken, as none before 1 can be asked for
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if made(middle) in taken else (low, middle)
    taken.add(made(high))
    return name if high == 1 else f"{name}{joint}{high}"
