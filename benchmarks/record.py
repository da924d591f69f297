"""The record of a benchmark that runs for long: a CSV file, a line as it comes."""

from __future__ import annotations

import csv
from pathlib import Path


def kept(path: Path) -> list[dict[str, str]]:
    """The lines of a record; none if there is no file yet."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def keep(path: Path, row: dict[str, str]) -> None:
    """Writes one more line, below the names of its columns if it is the first."""
    new = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(row))
        if new:
            writer.writeheader()
        writer.writerow(row)
