"""Order of file names as people count."""

import re


def natural(name: str) -> list[str | int]:
    """Sort key by which part 10 comes after part 9."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", name))]
