"""Numbers in sentences: one is not said as many are."""


def counted(count: int, noun: str = "point") -> str:
    """Return ``1 point``, ``1,234 points``."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def of_all(some: int, count: int, one: str, more: str, noun: str = "point") -> str:
    """Return ``1 of 20 points lies``, ``3 of 20 points lie``: the verb goes with `some`."""
    return f"{some:,} of {counted(count, noun)} {one if some == 1 else more}"
