import os
import stat
from pathlib import Path

import pytest

from psa_casadi.errors import InputError, Problems, PsaError
from psa_casadi.files import atomic_path, atomic_write


def test_text_and_bytes_are_written_as_given(tmp_path: Path) -> None:
    atomic_write(tmp_path / "a.txt", "µm\n")
    atomic_write(tmp_path / "b.bin", b"\r\n\0")
    assert (tmp_path / "a.txt").read_bytes() == "µm\n".encode()
    assert (tmp_path / "b.bin").read_bytes() == b"\r\n\0"
    assert sorted(os.listdir(tmp_path)) == ["a.txt", "b.bin"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "model.json"
    target.write_text("old")

    def write_half() -> None:
        with atomic_path(target) as path:
            path.write_text("half")
            raise RuntimeError("interrupted")

    with pytest.raises(RuntimeError, match="interrupted"):
        write_half()
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["model.json"]


def test_the_temporary_file_keeps_the_suffix_that_writers_look_at(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "x.fmu") as path:
        assert path.suffix == ".fmu"
        assert path.parent == tmp_path
        path.write_text("whole")
    assert (tmp_path / "x.fmu").read_text() == "whole"


def test_mode_of_an_old_file_and_the_target_of_a_link_are_kept(tmp_path: Path) -> None:
    target, link = tmp_path / "target.csv", tmp_path / "link.csv"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(target)
    atomic_write(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"
    assert stat.S_IMODE(target.stat().st_mode) == 0o640


def test_a_new_file_is_readable_as_the_umask_says(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    atomic_write(tmp_path / "ours", "")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.skipif(not Path("/dev/null").is_char_device(), reason="this system has no /dev/null")
def test_a_device_is_written_to_and_stays_a_device() -> None:
    atomic_write("/dev/null", "text")
    assert Path("/dev/null").is_char_device()


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"is a directory; name a file in it\.$"):
        atomic_write(tmp_path, "")
    with pytest.raises(InputError, match=r"no/such.* does not exist; create it first\.$"):
        atomic_write(tmp_path / "no" / "such" / "file", "")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot write"):
        atomic_write(tmp_path / "file" / "below", "")


def test_an_input_error_says_one_problem_on_each_line() -> None:
    error = InputError(["first.", "second."])
    assert isinstance(error, PsaError)
    assert isinstance(error, ValueError)
    assert error.problems == ("first.", "second.")
    assert str(error) == "first.\nsecond."
    assert InputError("only one.").problems == ("only one.",)


def test_problems_beyond_the_limit_are_counted() -> None:
    problems = Problems(limit=2)
    problems.raise_if_any()
    for k in range(5):
        problems.add(f"mistake {k}.")
    problems.add_uncounted(10)
    with pytest.raises(InputError) as caught:
        problems.raise_if_any()
    assert caught.value.problems == ("mistake 0.", "mistake 1.", "... and 13 more")
