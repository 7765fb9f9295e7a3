"""Text files, written whole."""

from __future__ import annotations

from pathlib import Path

from mtsp_env.writing import atomic_write


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically (``mtsp_env.writing.atomic_write``); its folder is made if it is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
