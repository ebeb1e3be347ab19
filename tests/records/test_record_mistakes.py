from collections.abc import Sequence
from pathlib import Path

import pytest

from psa_casadi.common.errors import InputError
from psa_casadi.records import read_record
from psa_casadi.records.read import table
from tests.records.record_files import HEADER, ROWS, problems_of, write


def with_row(row: int, text: str) -> list[str]:
    return [*ROWS[:row], text, *ROWS[row + 1 :]]


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("time [s],displacement [um]", r"line 1: the column 'voltage' is missing \(found: time, d"),
        ("time [s],voltge [V],displacement [um]", r"'voltge' is unknown; if 'voltage' is meant"),
        (f"{HEADER},load_fource [N]", r"'load_fource' is unknown; if 'load_force' is meant"),
        ("time [s],voltage [vlot],displacement [um]", r"'vlot' is unknown; units of voltage .*kV"),
        ("time [s],voltage,displacement [um]", r"'voltage' has no unit .*'voltage \[V\]'"),
        ("time [s],voltage [],displacement [um]", r"column 'voltage': has no unit"),
        ("time [V],voltage [V],displacement [um]", r"'time': the unit 'V' does not measure time"),
        (
            "time [s],voltage [V],displacement [V]",
            r"not measure length; .* um, nm, pm, counts, or say what 1 in",
        ),
        (f"{HEADER},Voltage [mV]", r"column 4: 'voltage' stands twice .*\(first as column 2\)"),
        (
            f"time [s],voltage [V],displacement [um{'9' * 500}]",
            r"line 1, column 'displacement': 'um9{58}' is not a unit string; write symbols",
        ),
        ("time [s],voltage [kV99],displacement [um]", r"'voltage': .*kV99' is not a unit string"),
        ("0,1,2", r"line 1: found '0,1,2', expected a header; write .*'time \[s\],voltage \[V\]"),
    ],
)
def test_mistakes_of_the_header(tmp_path: Path, header: str, expected: str) -> None:
    rows = [f"{row},1" if header.count(",") == 3 else row for row in ROWS]
    rows = [row.rsplit(",", 1)[0] if header.count(",") == 1 else row for row in rows]
    problems = problems_of(write(tmp_path / "a.csv", header, *rows))
    assert len(problems) == 1
    with pytest.raises(InputError, match=expected):
        raise InputError(problems)


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        ("0.004,abc,1", "line 6, column 'voltage': found 'abc', expected a number; correct"),
        ("0.004,1_0,1", "line 6, column 'voltage': found '1_0', expected a number"),
        ("0.004,1,#REF!", "line 6, column 'displacement': found '#REF!', expected a number"),
        ("0.004,,1", "line 6, column 'voltage': found no value, expected a number"),
        ("nan,1,1", "line 6, column 'time': found no value, expected a number"),
        ("0.004,inf,1", "line 6, column 'voltage': found inf, expected a finite number"),
        ("0.004,1,-inf", "line 6, column 'displacement': found -inf, expected a finite number"),
        ("0.004,1e101,1", "line 6, column 'voltage': found 1e+101, expected a measured number"),
        ("0.003,1,1", "line 6, column 'time': time stands still (from 0.003 in line 5 to 0.003)"),
        ("0.002,1,1", "line 6, column 'time': time goes back (from 0.003 in line 5 to 0.002)"),
        ("0.004,1", "line 6: found 2 cells, expected 3 as in the header"),
        ("0.004,1,1,1", "line 6: found 4 cells, expected 3 as in the header"),
    ],
)
def test_mistakes_of_a_row(tmp_path: Path, row: str, expected: str) -> None:
    problems = problems_of(write(tmp_path / "a.csv", HEADER, *with_row(4, row)))
    assert len(problems) == 1
    assert expected in problems[0]
    assert problems[0].endswith(".")
    assert ";" in problems[0]


def test_a_quote_that_never_ends_is_told_as_a_mistake(tmp_path: Path) -> None:
    rows = with_row(4, '0.004,"' + "9" * 200_000 + ",1")
    (problem,) = problems_of(write(tmp_path / "a.csv", HEADER, *rows))
    assert "line 6, column 'voltage': found '\"999" in problem
    header = f'{HEADER},"{"x" * 200_000}'
    assert read_record(write(tmp_path / "b.csv", header, *(f"{row},1" for row in ROWS))).n == 20


def test_one_file_has_one_decimal_sign(tmp_path: Path) -> None:
    for sign, other, name in ((",", ".", "comma"), (".", ",", "point")):
        rows = [row.replace(",", ";").replace(".", sign) for row in ROWS]
        rows[4] = f"0{other}004;4;0{sign}4"
        (problem,) = problems_of(write(tmp_path / "a.csv", HEADER.replace(",", ";"), *rows))
        assert f"line 6, column 'time': found '0{other}004'" in problem
        assert f"other numbers of this file have a decimal {name}, write this one so too" in problem


def test_decimal_commas_between_commas_are_told_from_a_row_too_long(tmp_path: Path) -> None:
    rows = [f"0,00{k},1,5,0,{k}" for k in range(9)]
    problems = problems_of(write(tmp_path / "a.csv", HEADER, *rows))
    assert "line 2: found 6 cells, expected 3 as in the header; where numbers have" in problems[0]
    assert "separate the cells by semicolons" in problems[0]


@pytest.mark.parametrize(
    ("order", "problem"),
    [
        ([k for n in range(30) for k in (n, n)], "their time stands still; remove repeated lines"),
        (range(30)[::-1], "the lines are not in the order of time; sort them by it"),
    ],
)
def test_many_lines_out_of_order_are_told_in_one_sentence(
    order: Sequence[int], problem: str, tmp_path: Path
) -> None:
    lines = [f"{k / 1000},{k % 7},{k % 7 / 10}" for k in order]
    (sentence,) = problems_of(write(tmp_path / "a.csv", HEADER, *lines))
    assert "are not later than the one before, line" in sentence
    assert problem in sentence


@pytest.mark.parametrize("row", ["inf,nan,1", "a,b,c"])
def test_a_file_full_of_mistakes_lists_twenty_and_counts_the_others(
    tmp_path: Path, row: str
) -> None:
    problems = problems_of(write(tmp_path / "a.csv", HEADER, *[row] * 500))
    expected = {"inf,nan,1": 1000, "a,b,c": 1501}[row]
    assert len(problems) == 21
    assert problems[-1] == f"... and {expected - 20} more"


def test_instants_that_are_one_in_seconds_are_refused(tmp_path: Path) -> None:
    rows = [f"{k}e-323,{k},{k}" for k in range(1, 21)]
    assert read_record(write(tmp_path / "a.csv", HEADER, *rows)).n == 20
    header = HEADER.replace("[s]", "[ms]")
    (problem,) = problems_of(write(tmp_path / "b.csv", header, *rows))
    assert "instants are the same in seconds" in problem


def test_lines_without_end_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "a.csv", HEADER, *ROWS, *[""] * 1000)
    assert read_record(path).n == 20
    monkeypatch.setattr(table, "MOST_BYTES", 10_000)
    (problem,) = problems_of(path)
    assert "its lines need more than" in problem


def test_files_that_are_no_csv_are_named_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "empty.csv").write_text("\n \n")
    (tmp_path / "comments.csv").write_text("# only\n# comments\n")
    (tmp_path / "binary.csv").write_bytes(b"PK\x03\x04\x00\x00\x08")
    (tmp_path / "wide.csv").write_bytes("time [s]".encode("utf-16")[:-1])
    reasons = {
        "absent.csv": "there is no such file; check the name",
        "": "is a directory; name the CSV files in it",
        "empty.csv": "the file is empty",
        "comments.csv": "holds no header and no data",
        "binary.csv": "is not text but a binary file",
        "wide.csv": "begins as UTF-16 text and is none",
    }
    for name, reason in reasons.items():
        (problem,) = problems_of(tmp_path / name)
        assert reason in problem
