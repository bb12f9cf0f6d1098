"""Odd log files: each is read right, or refused in one line that says what to pass."""

import numpy as np
import pandas
import pytest

from jaxatt.replay import load

NAN = float("nan")
HEAD = "time [s],g [rad/s]\n"
DATES = "time,g [rad/s]\n2024-03-01T12:00:00Z,1\n2024-03-01 13:00:00.25+01:00,2\n2024-03-01T12:00:00.500000001Z,3\n"
NOON = 1709294400.0  # seconds from 1970 to 2024-03-01T12:00 UTC, by the calendar: 19783.5 days

# what: (text, how it is asked for, times, samples)
RIGHT = {
    "byte order mark and CRLF": ("\ufefftime [s],g [rad/s]\r\n0,1\r\n1,2\r\n", {}, [0, 1], [1, 2]),
    "carriage returns alone": ("time [s],g [rad/s]\r0,1\r1,2\r", {}, [0, 1], [1, 2]),
    "quoted headers and cells": ('"time [s]","g [rad/s]","a, b"\n"0","1","x, y"\n1,2,z\n', {}, [0, 1], [1, 2]),
    "spaces after the commas": ("time [s], g [rad/s]\n 0, 1.5\n 1 , 2\n", {}, [0, 1], [1.5, 2]),
    "comments and blank lines": ("# a \"log\n\n" + HEAD + "\n0,1\n# x,y,z\n,\n1,2\n\n", {}, [0, 1], [1, 2]),
    "a lone trailing comma": (HEAD + "0,1,\n1,2,\n", {}, [0, 1], [1, 2]),
    "trailing commas in the header too": ("time [s],g [rad/s],,\n0,1,,\n1,2,,\n", {}, [0, 1], [1, 2]),
    "words for missing": (HEAD + "0,nan\n1,N/A\n2,null\n3,\n4,--\n5,7\n", {}, range(6), [NAN] * 5 + [7]),
    "semicolons": ("time [s];g [rad/s]\n0;1.5\n1;2\n", dict(separator=";"), [0, 1], [1.5, 2]),
    "semicolons and decimal commas": ("time [s];g [rad/s]\n0,08;0,0023\n0,09;5e-4\n", dict(separator=";", decimal=","),
                                      [0.08, 0.09], [0.0023, 0.0005]),
    "tabs": ("time [s]\tg [rad/s]\tnote\n0\t1\ta b\n1\t\tc\n2\t3\t\n", dict(separator="\t"), [0, 1, 2], [1, NAN, 3]),
    "spaces": ("  time [s]   g [rad/s]\n 0   1\n 1  nan\n2\t3\n", dict(separator=" "), [0, 1, 2], [1, NAN, 3]),
    "bars": ("time [s]|g [rad/s]\n0|1\n", dict(separator="|"), [0], [1]),
    "milliseconds": ("time [ms],g [rad/s]\n0,1\n12.5,2\n1000,3\n", dict(stamps="ms"), [0, 0.0125, 1], [1, 2, 3]),
    "microseconds": ("time (us),g [rad/s]\n0,1\n1000001,2\n", dict(stamps="us"), [0, 1.000001], [1, 2]),
    "nanoseconds since 1970": ("t_ns,g [rad/s]\n1709294400000000000,1\n1709294400250000000,2\n",
                               dict(stamps="ns", time="t_ns"), [NOON, NOON + 0.25], [1, 2]),
    "seconds that no header states": ("time,g [rad/s]\n0,1\n1,2\n", dict(stamps="s"), [0, 1], [1, 2]),
    "dates": (DATES, dict(stamps="iso"), [NOON, NOON + 0.25, NOON + 0.5], [1, 2, 3]),
    "instruments in rows of one time": ("time [s],g [rad/s],other [m]\n0,,5\n0,1,\n1,2,\n1,,6\n2,,7\n3,4,8\n", {},
                                        [0, 1, 2, 3], [1, 2, NAN, 4]),
    "a repeated header of a column nobody asks for": ("time [s],g [rad/s],g [deg/s]\n0,1,57\n", {}, [0], [1]),
}  # fmt: skip


@pytest.mark.parametrize("what", RIGHT)
def test_what_logs_bring_is_read_right(tmp_path, what):
    text, how, times, samples = RIGHT[what]
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode())
    t, columns = load(path, {"g": "rad/s"}, **how)
    np.testing.assert_array_equal(t, np.array(times, float))
    np.testing.assert_array_equal(columns["g"], np.array(samples, float))


# what: (text, how it is asked for, message)
REFUSED = {
    "decimal commas": (HEAD + "0,0,0,0023\n1,0,0,0005\n",
                       {}, r"be a csv file of 2 cells.* 4 cells in row 0 \(line 2\): decimal commas need another sep"),
    "a row too long": (HEAD + "0,1\n\n1,2,3\n", {}, r"2 cells in each row.*a\.csv with 3 cells in row 1 \(line 4\)"),
    "two trailing commas": (HEAD + "0,1,,\n", {}, "4 cells in row 0"),
    "a row cut off": (HEAD + "0,1\n1\n", {}, "1 cells in row 1"),
    "a comma lost in the header": ("time [s],gx [rad/s] g [rad/s],gz [rad/s]\n0,1,2,3\n", dict(units={"gz": "rad/s"}), "3 cells"),
    "semicolons": ("time [s];g [rad/s]\n0;1\n", {}, r"`time \[s\]` must be a column of a\.csv \(pass separator=';'\?\)"),
    "tabs": ("time [s]\tg [rad/s]\n0\t1\n", {}, r"pass separator='\\t'\?"),
    "decimal commas between semicolons": ("time [s];g [rad/s]\n0;0,5\n", dict(separator=";"),
                                          r"`g \[rad/s\]` must hold numbers \(pass decimal=',' .*'0,5' in row 0"),
    "decimal points where commas are asked for": ("time [s];g [rad/s]\n0;1.234,5\n", dict(separator=";", decimal=","),
                                                  r"`g \[rad/s\]` must hold numbers, but it is '1.234,5'"),
    "commas for both": (HEAD, dict(decimal=","), "`separator` must differ from `decimal`"),
    "thousands": (HEAD + '0,"1,234.5"\n', {}, "must hold numbers, but it is '1,234.5' in row 0"),
    "underscores": (HEAD + "0,1_000\n", {}, "must hold numbers, but it is '1_000' in row 0"),
    "another script's digits": (HEAD + "0,٣\n", {}, "must hold numbers"),
    "a row of units that are none": ("time [s],g [rad/s]\ns,blips\n0,1\n", {}, "must hold numbers, but it is 's' in row 0"),
    "a row of units against the header": ("time [s],g [rad/s]\ns,deg/s\n0,1\n", {}, r"`g \[rad/s\]` must have one unit, but it is in \[deg/s\]"),
    "dates of which some name a zone": (DATES.replace("001Z", "001"), dict(stamps="iso"), "some dates name a zone and some do not.*in row 2"),
    "milliseconds": ("time [ms],g [rad/s]\n0,1\n", {}, r"`time` must be given in \[s\] \(or pass stamps='ms'\)"),
    "milliseconds that are seconds": (HEAD + "0,1\n", dict(stamps="ms"), r"`time` must be given in \[ms\].*'time \[s\]'"),
    "dates": (DATES.replace("time", "time [s]"), {}, r"`time \[s\]` must hold numbers \(pass stamps='iso' for dates\)"),
    "numbers for dates": ("time,g [rad/s]\n0,1\n", dict(stamps="iso"), "must hold stamps of ISO 8601, but it is '0' in row 0"),
    "a date that is none": (DATES.replace("03-01T", "02-31T"), dict(stamps="iso"), "stamps of ISO 8601.*02-31.* in row 0"),
    "times that go back": (HEAD + "0,1\n2,1\n1,1\n", {}, "`time` must increase .* 1 after 2 in row 2"),
    "two samples of one time": (HEAD + "0,1\n1,\n1,2\n1,3\n", {}, "`time` must increase .* 1 after 1 in row 3"),
    "a header twice": ("time [s],g [rad/s],g [rad/s]\n0,1,2\n", {}, "`path` must name every column once"),
    "one name and unit in two headers": ("time [s],g [rad/s],g (rad/s)\n0,1,2\n", {}, "`g` must be one column of a.csv"),
    "another text": ("time [s],g [\xb0/s]\n0,1\n".encode("latin-1"), {}, "`path` must be a csv file, but a.csv is none"),
    "wide characters": (HEAD.encode("utf-16"), {}, "`path` must be a csv file, but a.csv is none"),
    "a quote that does not end": (HEAD + '0,"1\n1,2\n', {}, "`path` must be a csv file"),
    "an unknown separator": (HEAD, dict(separator="::"), "`separator` must be one of"),
    "an unknown decimal sign": (HEAD, dict(decimal="'"), "`decimal` must be one of"),
    "unknown stamps": (HEAD, dict(stamps="min"), "`stamps` must be one of"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_would_be_read_wrong_is_refused_in_one_line(tmp_path, what):
    text, how, message = REFUSED[what]
    path = tmp_path / "a.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match=message) as refusal:
        load(path, **({"units": {"g": "rad/s"}} | how))
    assert "\n" not in str(refusal.value) and str(refusal.value).startswith("`")


HEADER = "time [s],q[0],q[1],gx (deg/s),g [deg/s],g [rad/s],w_[x],plain,share [1]\n"


@pytest.mark.parametrize(
    ("name", "unit", "at"),
    [
        ("q[0]", "1", 1), ("q[1]", None, 2), ("gx (deg/s)", "deg/s", 3), ("gx", "deg/s", 3), ("g", "deg/s", 4), ("g", "rad/s", 5),
        ("g [rad/s]", "rad/s", 5), ("w_[x]", "rad/s", 6), ("plain", None, 7), ("plain", "1", 7), ("share", "1", 8), ("share [1]", "1", 8),
    ],
)  # fmt: skip
def test_a_column_is_asked_for_by_name_and_unit_or_by_its_whole_header(tmp_path, name, unit, at):
    path = tmp_path / "a.csv"
    path.write_text(HEADER + "0,1,2,3,4,5,6,7,8\n")
    _, columns = load(path, {name: unit})
    assert {key: a.tolist() for key, a in columns.items()} == {name: [at]}


@pytest.mark.parametrize(
    ("name", "unit", "message"),
    [
        ("g [deg/s]", "rad", r"`g \[deg/s\]` must be given in \[rad\].*'g \[deg/s\]'"),
        ("g", "mrad/s", r"`g` must be one column of a\.csv \(ask for one by its whole header\)"),
        ("g", "1", r"`g` must be given in \[1\] .*'g \[deg/s\]' and 'g \[rad/s\]'"),
        ("gx (deg/s)", "rad/s^2", "must be given in"),
        ("plain", "rad/s", r"`plain` must be given in \[rad/s\]"),
        ("q", "0", r"`q \[0\]` must be a column of a\.csv"),
        ("q[2]", "1", "must be a column"),
    ],
)
def test_a_unit_of_another_quantity_is_refused_however_the_column_is_asked_for(tmp_path, name, unit, message):
    path = tmp_path / "a.csv"
    path.write_text(HEADER + "0,1,2,3,4,5,6,7,8\n")
    with pytest.raises(ValueError, match=message):
        load(path, {name: unit})


def test_tables_of_parquet_are_read_by_the_same_rules(tmp_path):
    path, units = tmp_path / "a.parquet", {"g": "rad/s"}
    stamps = pandas.to_datetime(["2024-03-01T12:00:00Z", "2024-03-01T12:00:00.25Z"], format="ISO8601")
    pandas.DataFrame({"time": stamps, "g [rad/s]": [1, None], "q[0]": ["0.5", "NaN"]}).to_parquet(path)
    t, columns = load(path, {**units, "q[0]": "1"}, stamps="iso")
    assert t.tolist() == [NOON, NOON + 0.25]
    for a, first in zip(columns.values(), (1, 0.5)):
        np.testing.assert_array_equal(a, [first, NAN])
    with pytest.raises(ValueError, match=r"`time` must hold numbers \(pass stamps='iso' for dates\)"):
        load(path, units, stamps="s")
    pandas.DataFrame({"time [ns]": np.array([0, 10**9]), "g [rad/s]": stamps}).to_parquet(path)
    with pytest.raises(ValueError, match=r"`g \[rad/s\]` must hold numbers, but it is of type datetime64"):
        load(path, units, stamps="ns")
    pandas.DataFrame({"time [ns]": np.array([0, 10**9]), "g [rad/s]": [True, False]}).to_parquet(path)
    t, columns = load(path, units, stamps="ns")
    assert t.tolist() == [0, 1] and columns["g"].tolist() == [1, 0]


def test_long_files_are_read_in_parts(tmp_path):
    path, rows = tmp_path / "a.csv", 25_000
    path.write_text(HEAD + "".join(f"{i},{i / 3!r}\n" for i in range(rows)))
    t, columns = load(path, {"g": "rad/s"})
    assert t.tolist() == list(range(rows)) and columns["g"].tolist() == [i / 3 for i in range(rows)]
    path.write_text(path.read_text().replace("20001,6667.0", "20001,off"))
    with pytest.raises(ValueError, match="'off' in row 20001"):
        load(path, {"g": "rad/s"})
