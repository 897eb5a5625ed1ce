"""A dive's track or poses as a Parquet table: the columns of the CSV, typed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from buddyline.tools.dives import Dive
from buddyline.tools.extras import needed
from buddyline.tools.newfile import new_file


def export(dive: Dive, output: Path, what: str | None = None) -> int:
    """Write the best track, or the poses, into output, which must not exist; return the number of rows."""
    pa, pq = (needed(name, "--format parquet", "parquet") for name in ("pyarrow", "pyarrow.parquet"))
    from buddyline.tools.evaluation.logs import load
    from buddyline.tools.export.command import rows_of

    name, names, rows = rows_of(load([str(reader.path) for reader in dive.readers]), what, dive.name)
    columns: dict[str, Any] = {field: [row.get(field, "") for row in rows] for field in names}
    # An unknown number is null, as an empty cell is in CSV.
    arrays = {
        field: pa.array([None if value == "" else value for value in values]) for field, values in columns.items()
    }
    table = pa.table(arrays).replace_schema_metadata({"buddyline": name})
    with new_file(output) as part:
        pq.write_table(table, part)
    return len(rows)
