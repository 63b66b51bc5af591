"""Rows as the text of a CSV file."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping
from typing import Any


def csv_text(rows: Iterable[Mapping[str, Any]]) -> str:
    """A line for each row under the names of the first one's columns; no rows: no text."""
    rows = list(rows)
    text = io.StringIO()
    if rows:
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return text.getvalue()


def number_text(value: float) -> str:
    """Three decimals; nothing for NaN."""
    return "" if math.isnan(value) else f"{value:.3f}"
