"""Which array of a file is which column: `time=t:ms,voltage=log.u,displacement=y:um`."""

import difflib
import re

from psa_casadi.errors import Problems
from psa_casadi.records.read.columns import COLUMNS, ColumnMap, Source, check_unit

#: What stands for the choice of a table among the names of columns.
TABLE = "table"
#: Its value that takes each table of a file as a record.
ALL = "all"
#: What a name may not hold that `--columns` is to name.
MARKS = re.compile(r"[,:=\[\]]+")
_NAMES = ", ".join(COLUMNS)
_PART = re.compile(
    r"(?P<name>[^=]*)=(?P<array>[^\[\]]*?)(?::(?P<unit>[^:\[\]]*)|\[(?P<in>[^]]*)\])?"
)
#: A unit with what 1 in the file is in it.
_SCALED = re.compile(r"(?P<scale>[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?)\s*(?P<unit>[^\d\s].*)")
_FORM = "write NAME=ARRAY:UNIT, several joined by commas, such as time=t:ms,displacement=y:um"


def parse_columns(text: str) -> ColumnMap:
    """Return what `NAME=ARRAY:UNIT,...` says (`NAME=ARRAY[UNIT]` is read too).

    NAME is a column of a record. ARRAY is a column's name in the header of a CSV or Parquet file,
    or a MATLAB array: a field of a structure is written `log.u`, the second column of a matrix
    `m.2`. Without UNIT the header's own unit counts, else the SI unit; a displacement is never
    guessed. A number before UNIT says what 1 in the file is, whatever the header says: `10um` for
    the volts of a sensor of 10 um/V. `FILE@NAME=ARRAY:UNIT` is said of one file by its name.
    `table=NAME` takes one of several tables of a file (sheets, groups, blocks, segments of time) by
    its name or number, `table=all` each as a record.

    Raises:
        InputError: every part that is not of this form, names no column or no unit of it.
    """
    found: dict[str, Source] = {}
    problems = Problems()
    for part in text.split(","):
        where = f"--columns, '{part.strip()}'"
        match = _PART.fullmatch(part.strip())
        if match is None or not match["array"].strip():
            problems.add(f"{where}: is not understood; {_FORM}.")
            continue
        file, at, own = match["name"].strip().rpartition("@")
        name = re.sub(r"[\s-]+", "_", own.strip().lower())
        key = f"{file.strip()}{at}{name}"
        unit = match["unit"] if match["in"] is None else match["in"]
        if name == TABLE:
            found[key] = Source(part.partition("=")[2].strip(), None)
        elif name not in COLUMNS:
            near = difflib.get_close_matches(name, COLUMNS, n=1, cutoff=0.6)
            meant = f"is '{near[0]}' meant? There are" if near else "there are"
            problems.add(f"{where}: '{name}' is no column of a record; {meant} {_NAMES}.")
        elif key in found:
            problems.add(f"{where}: '{key}' is given twice; remove one of the two.")
        else:
            scaled = _SCALED.fullmatch(unit.strip()) if unit else None
            scale = float(scaled["scale"]) if scaled else None
            unit = scaled["unit"] if scaled else unit
            if unit is not None:
                check_unit(COLUMNS[name], unit, where, problems)
            if scale is not None and not 0.0 < abs(scale) < float("inf"):
                problems.add(
                    f"{where}: the scale {scale:g} leaves nothing of the numbers; correct it."
                )
            found[key] = Source(match["array"].strip(), unit, scale)
    problems.raise_if_any()
    return found


def columns_of(wanted: ColumnMap, file: str) -> ColumnMap:
    """Return what is said of one file: by its name, else what is said of all."""
    own = {k.removeprefix(f"{file}@"): v for k, v in wanted.items() if k.startswith(f"{file}@")}
    return own or {k: v for k, v in wanted.items() if "@" not in k}


def files_named(wanted: ColumnMap) -> set[str]:
    """Return the names of the files of which something is said."""
    return {key.rpartition("@")[0] for key in wanted if "@" in key}
