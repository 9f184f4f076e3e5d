import math
import os

import pytest

from neurad.core.errors import InputError
from neurad.runtime.tables import align, append_csv, markdown, numbers, read_csv, read_header, write_csv


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "a.csv"
    write_csv(
        path, ("name", "seconds", "rays"), [{"name": 'a, "b"', "seconds": 1.0 / 3.0, "rays": 2.0}, {"name": None}]
    )
    assert path.read_bytes() == b'name,seconds,rays\n"a, ""b""",0.3333333,2\n,,\n'
    columns, rows = read_csv(path)
    assert columns == read_header(path) == ["name", "seconds", "rays"]
    assert rows[0] == {"name": 'a, "b"', "seconds": "0.3333333", "rays": "2"}
    assert numbers({"x": "1.5", "y": "", "z": "exact"}) == {"x": 1.5, "z": math.inf}
    assert not list(tmp_path.glob("*.part"))


def test_rows_follow_the_header_of_the_file_and_a_torn_line_is_none(tmp_path):
    path = tmp_path / "a.csv"
    append_csv(path, ("a", "b"), {"a": 1.0, "b": 2.0})
    append_csv(path, ("b", "c"), {"b": 3, "c": 4})
    assert path.read_text() == "a,b\n1,2\n,3\n"

    path = tmp_path / "a.csv"
    path.write_text("a,b\n1,2\n3")
    assert read_csv(path)[1] == [{"a": "1", "b": "2"}]
    assert read_csv(tmp_path / "none.csv") == ([], [])


def test_a_table_that_cannot_be_written_leaves_the_old_one(tmp_path):
    path = tmp_path / "a.csv"
    write_csv(path, ("a",), [{"a": 1}])

    def rows():
        yield {"a": 2}
        raise RuntimeError("no more")

    with pytest.raises(RuntimeError):
        write_csv(path, ("a",), rows())
    assert path.read_text() == "a\n1\n"


def test_text_tables():
    assert align([["a", "n", "b"], ["long", "12", "c"]], left=(0, 2)) == ["a      n  b", "long  12  c"]
    assert markdown(("a", "n"), [["x|y", "1"]], left=("a",)) == ["| a | n |", "|---|---:|", "| x\\|y | 1 |"]


@pytest.mark.parametrize("make", [lambda path: path.symlink_to("/dev/zero"), lambda path: os.mkfifo(path)])
def test_what_has_no_end_is_no_table(tmp_path, make):
    make(tmp_path / "metrics.csv")
    with pytest.raises(InputError, match=r"metrics\.csv: it is a .*, not a file"):
        read_csv(tmp_path / "metrics.csv")
