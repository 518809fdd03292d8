import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from tests.recorded import HEADER, STATES, a_table, load, refuses, write
from visadapt.recordings import RecordingError
from visadapt.recordings.csv import Table

ODD = ("", " ", " 1 ", "1.", "+.5", "1e", "1d3", "1e400", "0x1", "1_0", "1#2", "-nan", "Infinity", "1 2", "1\f", "\v1")
CELLS = st.one_of(
    st.floats().map(str),
    st.floats().map("{:.9g}".format),
    st.sampled_from(ODD),
    st.text("0123456789.eE+-_# \t\0\x1c\u0661", max_size=5),
)


def rows_of(text):
    """The rows of a file of two columns, or why they are refused, without the name of the file."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rows.csv"
        file.write_text(text)
        try:
            rows = Table.open(file).rows([0, 1])
        except RecordingError as error:
            return str(error).removeprefix(str(file))
        return np.column_stack((rows.numbers, rows.lines, rows.values)).tolist()


class TestText:
    @pytest.mark.parametrize(
        "form",
        [
            {"separator": ";"},
            {"separator": "\t"},
            {"end": "\r\n"},
            {"encoding": "utf-8-sig"},
            {"before": "# a rig\n\n# 0.05 s\n"},
            {"separator": ";", "end": "\r\n", "encoding": "utf-8-sig", "before": "# a; b, c\r\n"},
            {"separator": ";", "end": "\r\n", "encoding": "utf-8-sig", "before": "sep=;\r\n"},
        ],
    )
    def test_forms_of_the_same_table(self, file, form):
        table = a_table()
        state = load(write(file, table, **form)).episodes[0].state
        np.testing.assert_array_equal(state, np.column_stack([table[name] for name in STATES]))

    @pytest.mark.parametrize("quote", ['"', ""])
    def test_commas_within_names_are_no_separators(self, file, quote):
        table = a_table()
        names = {name: f"{quote}{name}, SI{quote}" for name in table}
        write(file, {names[name]: values for name, values in table.items()}, separator=";")
        assert load(file, columns={name: f"{name}, SI" for name in names}).measured == STATES

    def test_comments_between_rows_and_quotes(self, file):
        lines = write(file, a_table()).read_text().splitlines()
        lines.insert(20, "# paused, resumed")
        file.write_text("\n".join(lines).replace("theta_dot", '"theta_dot"'))
        assert load(file).samples == 40

    @given(st.lists(st.tuples(CELLS, CELLS), min_size=1, max_size=4))
    def test_a_quoted_cell_changes_nothing_in_the_rows_beside_it(self, cells):
        below = "".join(f"{one},{other}\n" for one, other in cells)
        plain, quoted = rows_of("a,b\n0,1\n" + below), rows_of('a,b\n"0",1\n' + below)
        assert repr(plain) == repr(quoted)

    @pytest.mark.parametrize(
        ("cell", "message"),
        [
            ("nan", "column 'theta' is empty or nan; a finite number is right"),
            ("inf", "column 'theta' is inf"),
            ("", "column 'theta' is empty or nan"),
            ("oops", "column 'theta' is 'oops'; a number is right"),
            ('"0,12"', "column 'theta' is '0,12'; a decimal point is right"),
            ("1_0.5", "column 'theta' is '1_0.5'; a number is right"),
            ("\uff11", "column 'theta' is .*; a number is right"),
            ("1" * 200_000, "no row of CSV: field larger than field limit"),
            ("oops # a remark", "column 'theta' is 'oops'; a number is right"),
            ('"0.1', "a quotation mark is left open|no row of CSV"),
        ],
    )
    def test_a_cell_that_is_no_number(self, file, cell, message):
        table = {name: list(values) for name, values in a_table().items()}
        table["theta"][6] = cell
        refuses(rf"run.csv: row 7 \(line 9\).*({message})", write(file, table, before="# a comment\n"))

    def test_what_other_columns_hold_is_their_affair(self, file):
        lines = write(file, a_table()).read_text().splitlines()
        rows = [f'{line},"a, b"' if row == 5 else f"{line}," for row, line in enumerate(lines[1:])]
        file.write_text("\n".join([f'{lines[0]},"note, or more"', *rows]))
        assert load(file).samples == 40

    def test_a_quotation_mark_swallows_no_rows(self, file):
        lines = write(file, a_table()).read_text().splitlines()
        rows = [f'{line},"' if row in (5, 20) else f"{line},b" for row, line in enumerate(lines[1:])]
        file.write_text("\n".join([f"{lines[0]},note", *rows]))
        refuses(r"row 6 \(line 7\): a quotation mark is left open", file)

    def test_a_torn_last_line(self, file):
        content = write(file, a_table()).read_text()
        file.write_text(content[:-30])
        refuses(r"row 41 \(line 42\) is cut short: 5 of 6 cells; is the file incomplete", file)

    def test_a_row_that_is_too_long(self, file):
        lines = write(file, a_table()).read_text().splitlines()
        lines[5] += ",1"
        file.write_text("\n".join(lines))
        refuses(r"row 5 \(line 6\) has 7 cells, the line of names 6", file)

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (b"", "is empty"),
            (b"\n# only a comment\n", "is empty"),
            (b"time,x,theta,command\n", "has no rows"),
            (b"0.0,1,2,3\n0.1,1,2,3\n", "line 1 holds numbers where the columns' names belong"),
            (b"\xff\xfe\x00time", "not text in UTF-8"),
            ("time,x,theta,command\n".encode("utf-16"), "not text in UTF-8, but in UTF-16; CSV in UTF-8 is right"),
            ("time,x,theta,command\n".encode("utf-16-le"), "line 1 holds NUL bytes"),
            (bytes(1000), "line 1 holds NUL bytes"),
            (b"time x theta command\n0 1 2 3\n", "line 1: names separated by commas, semicolons or tabs are right"),
            (b"<!doctype html><html></html>\n", "line 1: names separated by commas, semicolons or tabs are right"),
            (b'time,x,theta,"command\n0,1,2,3\n', "line 1 is no line of names"),
        ],
    )
    def test_no_table_at_all(self, file, content, message):
        file.write_bytes(content)
        refuses(message, file)


class TestSize:
    def test_a_million_rows(self, file):
        rows = 10**6
        table = a_table(rows=1000, period=0.01)
        block = np.column_stack([table[name] for name in HEADER[1:]])
        lines = [f",{n / 100}," + ",".join(f"{value:.9g}" for value in row) for n, row in enumerate(block)]
        with file.open("w") as out:
            out.write("episode,time,x,x_dot,theta,theta_dot,command\n")
            for episode in range(rows // 1000):
                out.write("".join(f"{episode}{line}\n" for line in lines))
        assert load(file).samples == rows - 1000
