"""The rows that CSV has, as a Parquet table with types."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from buddyline.tools.extras import needed
from buddyline.tools.newfile import new_file


def write(output: Path, said: str, names: Sequence[str], rows: Sequence[dict[str, object]]) -> None:
    """Write rows into output, which must not exist. said: what they are of, in words; names: the columns."""
    pa, pq = (needed(name, "--format parquet", "parquet") for name in ("pyarrow", "pyarrow.parquet"))
    columns: dict[str, Any] = {name: [row.get(name, "") for row in rows] for name in names}
    # An unknown number is null, as an empty cell is in CSV.
    arrays = {name: pa.array([None if value == "" else value for value in values]) for name, values in columns.items()}
    table = pa.table(arrays).replace_schema_metadata({"buddyline": said})
    with new_file(output) as part:
        pq.write_table(table, part)
