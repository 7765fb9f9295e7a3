"""The one Markdown table of this project's reports."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def markdown_table(head: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    """A Markdown table with these column heads and the cells of each line.

    Raises:
        ValueError: a line that has not one cell for each head.
    """
    text = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for line in lines:
        if len(line) != len(head):
            raise ValueError(f"expected {len(head)} cells in a line, got {len(line)}: {list(line)}")
        text.append(f"| {' | '.join(map(str, line))} |")
    return "\n".join(text)
