"""How long work says what it does."""

from collections.abc import Callable

# Takes what is being done, and how far it is, 0 to 1.
Report = Callable[[str, float], None]


def silent(text: str, share: float) -> None:
    """Say nothing."""
