"""Numbers of things in sentences."""

from __future__ import annotations


def counted(number: int, thing: str) -> str:
    """``1 station``, ``2 stations``.

    Args:
        number: How many.
        thing: What, one of them; the plural adds an s.
    """
    return f"{number} {thing}" + ("" if number == 1 else "s")
