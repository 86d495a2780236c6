"""Files of a trial: JSON read and written whole, and their digests."""

import hashlib
import json
from pathlib import Path

from eha_monitor.output import write_text


def digest_of(content: bytes) -> str:
    """Return the SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def read_json(path: Path) -> dict | None:
    """Return what a JSON file holds; None where there is none that can be read."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def write_json(path: Path, content: dict) -> None:
    """Write a JSON file whole."""
    write_text(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")
