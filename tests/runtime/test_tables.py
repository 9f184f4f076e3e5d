import pytest

from neurad.runtime.tables import align, append_csv, markdown, write_csv


def test_rows_follow_the_header_of_the_file(tmp_path):
    append_csv(tmp_path / "a.csv", ("a", "b"), {"a": 1.0, "b": 2.0})
    append_csv(tmp_path / "a.csv", ("b", "c"), {"b": 3, "c": 4})
    assert (tmp_path / "a.csv").read_text() == "a,b\n1,2\n,3\n"


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
