"""Layouts of real logs, written here in the manner of their tools: each is read right, or refused in one line.

Every layout holds the same four samples of a body rate (about x, y, z) unless it says otherwise, so that what comes back can be
held against them; `report` must say how a layout was understood.
"""

from types import SimpleNamespace

import numpy as np
import pandas
import pytest
from scipy.spatial.transform import Rotation

from jaxatt.replay import Quaternion, checked, load, merged, report, resample, unit_quaternions

T = np.array([0.0, 0.01, 0.02, 0.05])  # [s], with a gap
W = np.array([[0.1, -0.2, 0.3], [0.15, -0.25, 0.35], [0.2, -0.3, 0.4], [0.25, -0.35, 0.45]])  # [deg/s]
NOON = 1709294400.0  # 2024-03-01T12:00 UTC, 19783.5 days after 1970
RAD = {"x": "rad/s", "y": "rad/s", "z": "rad/s"}
AXES = "xyz"


def lines(header, cells, separator=",", end="\n", before=()):
    return end.join([*before, separator.join(header), *(separator.join(map(str, row)) for row in cells)]) + end


def rows(stamp=lambda t: f"{t:.2f}", number=lambda a: f"{a:.2f}", more=()):
    """A row a sample: stamp, three rates, and whatever else."""
    return [[stamp(t), *map(number, w), *more] for t, w in zip(T, W)]


def names(form, time):
    return [time, *(form.format(axis) for axis in AXES)]


def at_noon(form):
    """Stamps of four samples: noon and what comes after."""
    return lambda t: form.format(f"12:00:0{t:.2f}")


comma = lambda a: f"{a:.2f}".replace(".", ",")
EUROC = [
    "#timestamp [ns]",
    *(f"w_RS_S_{axis} [deg s^-1]" for axis in AXES),
    *(f"a_RS_S_{axis} [m s^-2]" for axis in AXES),
]
ROS = ["%time", "field.header.seq", "field.header.frame_id", *(f"field.angular_velocity.{axis}" for axis in AXES)]
DEG = dict.fromkeys(AXES, "deg/s")
# what: (text or table, units asked for, how, times, factor to deg/s)
READ = {
    "degrees a second in round brackets": (lines(names("{} (deg/s)", "time [s]"), rows()), DEG, {}, T),
    "converted to rad/s": (lines(names("{} (deg/s)", "time [s]"), rows()), RAD, {}, T),
    "degree signs, capitals, sec": (lines(names("{} [°/Sec]", "time [sec]"), rows()), RAD, {}, T),
    "dps between semicolons, decimal commas, CRLF": (
        lines(names("{}(dps)", "time(ms)"), rows(lambda t: f"{1000 * t:.0f}", comma), ";", "\r\n"), RAD,
        dict(separator=";", decimal=",", stamps="ms"), T),
    "Latin-1": (lines(names("{} [°/s]", "time [s]"), rows()).encode("latin-1"), RAD, dict(encoding="latin-1"), T),
    "UTF-16 with tabs, as spreadsheets export": (lines(names("{} [deg/s]", "time [s]"), rows(), "\t").encode("utf-16"), DEG,
                                                 dict(encoding="utf-16", separator="\t"), T),
    "EuRoC MAV: header in a comment, ns since 1970": (
        lines(EUROC, rows(lambda t: f"{1709294400 * 10**9 + round(t * 10**9)}", more=(9.8, 0, 0))),
        {f"w_RS_S_{axis}": "deg/s" for axis in AXES}, dict(time="timestamp", stamps="ns"), NOON + T),
    "rostopic echo: percent sign, words in cells": (
        lines(ROS, [[row[0], 7, "imu_link", *row[1:]] for row in rows(lambda t: f"{1709294400 * 10**9 + round(t * 10**9)}")]),
        {f"field.angular_velocity.{axis}": "deg/s" for axis in AXES},
        dict(time="time", stamps="ns", told={f"field.angular_velocity.{axis}": "deg/s" for axis in AXES}), NOON + T),
    "rosbag: seconds and nanoseconds apart": (
        lines(["secs", "nsecs", "x", "y", "z"], [["1709294400", f"{round(float(row[0]) * 10**9)}", *row[1:]] for row in rows()]),
        DEG, dict(time=("secs", "nsecs"), stamps="s+ns", told=DEG), NOON + T),
    "Xsens: preamble of slashes, tabs": (
        lines(names("{} [deg/s]", "time [s]"), rows(), "\t", before=("// General information:", "//  Firmware: 4.0", "// Rate: 100")),
        RAD, dict(separator="\t"), T),
    "savetxt: header behind a hash": (lines(names("{} [deg/s]", "# time [s]"), rows()), RAD, {}, T),
    "TUM: header behind a hash, spaces": (
        lines(names("w{}", "# timestamp"), rows(lambda t: f"{NOON + t:.2f}"), " ", before=("# angular velocity", "# of an IMU")),
        {f"w{a}": "deg/s" for a in AXES}, dict(time="timestamp", stamps="s", separator=" ", told={f"w{a}": "deg/s" for a in AXES}), NOON + T),
    "no header: names told": (lines(rows()[0], rows()[1:]), RAD, dict(header=["time [s]", *(f"{a} [deg/s]" for a in AXES)]), T),
    "lines before the header": (lines(names("{} [deg/s]", "time [s]"), rows(), before=("Logger 7", "SN;12;34")), RAD, dict(skip=2), T),
    "a row of units": (lines(names("{}", "time"), [["s", "deg/s", "deg/s", "deg/s"], *rows()]), RAD, {}, T),
    "a row of units in brackets": (lines(names("{}", "time"), [["[s]", "[deg/s]", "[deg/s]", "[deg/s]"], *rows()]), RAD, {}, T),
    "units in the names, told": (lines(names("w{}_deg_s", "t_us"), rows(lambda t: f"{t * 1e6:.0f}")), {f"w{a}_deg_s": "rad/s" for a in AXES},
                                 dict(time="t_us", stamps="us", told={f"w{a}_deg_s": "deg/s" for a in AXES}), T),
    "indices for axes": (lines(["time [s]", "w[0]", "w[1]", "w[2]"], rows()), {f"w[{i}]": "deg/s" for i in range(3)}, {}, T),
    "arrays in cells": (lines(["time [s]", "w [deg/s]"], [[row[0], f'"[{", ".join(row[1:])}]"'] for row in rows()]),
                        {f"w.{i}": "rad/s" for i in range(3)}, {}, T),
    "arrays as NumPy prints them": (lines(["time [s]", "w [deg/s]"], [[row[0], f"[ {' '.join(row[1:])}]"] for row in rows()], ";"),
                                    {f"w[{i}]": "deg/s" for i in range(3)}, dict(separator=";"), T),
    "lists of Parquet": (pandas.DataFrame({"time [s]": T, "w [deg/s]": W.tolist()}), {f"w.{i}": "rad/s" for i in range(3)}, {}, T),
    "structs of Parquet": (pandas.DataFrame({"time [s]": T, "w [deg/s]": [dict(zip(AXES, w.tolist())) for w in W]}),
                           {f"w.{a}": "deg/s" for a in AXES}, {}, T),
    "dates of a zone": (lines(names("{} [deg/s]", "time"), rows(at_noon("2024-03-01T{}Z"))), DEG, dict(stamps="iso"), NOON + T),
    "dates an hour ahead": (lines(names("{} [deg/s]", "time"), rows(lambda t: f"2024-03-01 13:00:0{t:.2f} +0100")), DEG,
                            dict(stamps="iso"), NOON + T),
    "local dates, the zone told": (lines(names("{} [deg/s]", "time"), rows(lambda t: f"2024-03-01 13:00:0{t:.2f}")), DEG,
                                   dict(stamps="iso", zone="Europe/Berlin"), NOON + T),
    "local dates, the offset told": (lines(names("{} [deg/s]", "time"), rows(lambda t: f"2024-03-01 07:00:0{t:.2f}")), DEG,
                                     dict(stamps="iso", zone="-05:00"), NOON + T),
    "the day of the year": (lines(names("{} [deg/s]", "time"), rows(at_noon("2024-061T{}"))), DEG, dict(stamps="iso"), NOON + T),
    "dates without signs, decimal commas": (
        lines(names("{} [deg/s]", "time"), rows(lambda t: f"20240301T12000{comma(t)}Z", comma), ";"), DEG,
        dict(stamps="iso", separator=";", decimal=","), NOON + T),
    "date and time of day apart": (lines(["date", "clock", *(f"{a} [deg/s]" for a in AXES)], [["2024-03-01", *row] for row in rows(at_noon("{}"))]),
                                   DEG, dict(stamps="iso", time=("date", "clock")), NOON + T),
    "words for missing, marks for missing": (
        lines(["time [s]", *(f"{a} [deg/s]" for a in AXES), "star [1]"], [[*row, mark] for row, mark in zip(rows(), ("1.#QNAN", "-9999", "NaN", 2))]),
        DEG | {"star": "1"}, dict(missing=[-9999]), T),
    "one of several instruments": (
        lines(["time [s]", "imu_id", *(f"{a} [deg/s]" for a in AXES)],
              [[row[0], i, *(row[1:] if i else ("7", "8", "9"))] for row in rows() for i in (0, 1)]), DEG, dict(where={"imu_id": 1}), T),
    "an instrument whose block is shorter": (
        lines(["t_star [s]", "star [1]", "t_gyro [s]", *(f"{a} [deg/s]" for a in AXES)],
              [[*side, *row] for side, row in zip((("0", "1"), ("1", "2"), ("", ""), ("", "")), rows())]), DEG, dict(time="t_gyro"), T),
    "arrays of decimal commas": (lines(["time [s]", "w [deg/s]"], [[comma(t), f"[{' '.join(map(comma, w))}]"] for t, w in zip(T, W)], ";"),
                                 {f"w.{i}": "deg/s" for i in range(3)}, dict(separator=";", decimal=","), T),
    "a header that says the zone, as told": (lines(names("{} [deg/s]", "time [UTC+1]"), rows(lambda t: f"2024-03-01 13:00:0{t:.2f}")), DEG,
                                             dict(stamps="iso", zone="+01:00"), NOON + T),
    "naive dates of Parquet, the zone told": (
        pandas.DataFrame({"time": pandas.to_datetime(np.round(1e3 * (NOON + 3600 + T)), unit="ms"), **{f"{a} [deg/s]": W[:, i] for i, a in enumerate(AXES)}}),
        DEG, dict(stamps="iso", zone="+01:00"), NOON + T),
    "two stamps of each row, in ms and as dates": (
        lines(["time [s]", "seq", "stamp [ms]", "utc_time", *(f"{a} [deg/s]" for a in AXES)],
              [[row[0], 1, f"{1e3 * t + 7:.0f}", f"2024-03-01T12:00:0{t:.2f}", *row[1:]] for t, row in zip(T, rows())]), DEG, {}, T),
    "all of several kinds of rows, told": (
        lines(["time [s]", "type", *(f"{a} [deg/s]" for a in AXES)], [[row[0], kind, *row[1:]] for row, kind in zip(rows(), "abab")]), DEG,
        dict(where={"type": ["a", "b"]}), T),
    "flags in words, exponents of Fortran": (
        lines(["time [s]", *(f"{a} [deg/s]" for a in AXES), "valid"], [[*row, "True"] for row in rows(number=lambda a: f"{10 * a:.1f}D-01")]),
        DEG | {"valid": "1"}, {}, T),
}  # fmt: skip


def written(folder, content, name="a"):
    path = folder / f"{name}.{'parquet' if isinstance(content, pandas.DataFrame) else 'csv'}"
    if isinstance(content, pandas.DataFrame):
        content.to_parquet(path)
    else:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("what", READ)
def test_layouts_are_read_right(tmp_path, what):
    content, units, how, times = READ[what]
    path = written(tmp_path, content)
    t, columns = load(path, units, **how)
    np.testing.assert_allclose(t, times, rtol=0, atol=3e-7)  # since 1970 a float has steps of 2.4e-7 s
    factor = np.pi / 180 if "rad/s" in units.values() else 1.0
    np.testing.assert_allclose(np.stack(list(columns.values())[:3], 1), W * factor, rtol=1e-14)
    said = report(path, units, **how)
    assert said.startswith(f"{path.name}: ") and all(f"\n{name}: from " in said for name in units)
    assert ("x 0.0174532925" in said) == (factor < 1) and "1 gap: 0.03 s after" in said


RATES = [f"{a} [deg/s]" for a in AXES]
PLAIN = lines(["time [s]", *RATES], rows())
LOCAL = lambda hour: lines(["time", *RATES], rows(lambda t: f"2024-10-27T{hour}:30:0{t:.2f}"))
# what: (text, units asked for, how, message)
REFUSED = {
    "a unit of another quantity": (PLAIN.replace("deg/s", "deg/s²"), DEG, {}, r"`x` must be given in \[deg/s\]"),
    "a unit that is told against the header": (PLAIN, RAD, dict(told={"x [deg/s]": "rad/s"}), r"`told\['x \[deg/s\]'\]` must be \[deg/s\], as the header"),
    "a unit that is told against the name": (lines(["time [s]", "x_deg_s"], [[0, 1]]), {"x_deg_s": "rad/s"}, dict(told={"x_deg_s": "rad/s"}),
                                             r"`told\['x_deg_s'\]` must be \[deg/s\]"),
    "a unit that only the name says": (lines(["time [s]", "x_deg_s"], [[0, 1]]), {"x_deg_s": "rad/s"}, {}, r"pass told=\{'x_deg_s': 'deg/s'\}"),
    "a name with a unit as a pure number": (lines(["time [s]", "x_deg_s"], [[0, 1]]), {"x_deg_s": "1"}, {}, "in .deg/s. by its name"),
    "a column that is told and not there": (PLAIN, DEG, dict(told={"w": "rad/s"}), "`told` must name columns of a.csv"),
    "ms by the name, told as s": (lines(["time_ms", *RATES], rows()), DEG, dict(time="time_ms", stamps="s"), r"`time_ms` must be given in \[s\], .*\[ms\] by its name"),
    "ms since 1970 told as s": (lines(["t", *RATES], rows(lambda t: f"{1000 * (NOON + t):.0f}")), DEG, dict(time="t", stamps="s"), "before the year 5138"),
    "s told as ns": (lines(["t", *RATES], rows()), DEG, dict(time="t", stamps="ns"), r"`t` must be stamps in \[ns\] that are a microsecond apart"),
    "a column of hours": (lines(["time [h]", *RATES], rows()), DEG, dict(stamps="s"), r"`time` must be given in \[s\].*'time \[h\]'"),
    "days told as seconds": (lines(["time [d]", *RATES], rows()), DEG, {}, r"`time` must be given in \[s\].*'time \[d\]'|`time \[s\]`"),
    "dates with and without a zone": (lines(["time", *RATES], [["2024-03-01T12:00:00Z", 1, 1, 1], ["2024-03-01T12:00:01", 1, 1, 1]]), DEG,
                                      dict(stamps="iso"), "some dates name a zone and some do not.*in row 1"),
    "dates of another zone than told": (lines(["time", *RATES], rows(at_noon("2024-03-01T{}Z"))), DEG, dict(stamps="iso", zone="+01:00"),
                                        "the date names another zone than `zone`"),
    "an hour that comes twice": (LOCAL("02"), DEG, dict(stamps="iso", zone="Europe/Berlin"), "the zone has this time twice or not at all"),
    "a zone of no world": (LOCAL("02"), DEG, dict(stamps="iso", zone="Mars/Base"), "`zone` must be an offset .* 'Mars/Base'"),
    "an offset of no zone": (lines(["time", *RATES], rows(at_noon("2024-03-01T{}+25:00"))), DEG, dict(stamps="iso"), "stamps of ISO 8601"),
    "dates of another country": (lines(["time", *RATES], rows(at_noon("03/01/2024 {}"))), DEG, dict(stamps="iso"), "must hold stamps of ISO 8601"),
    "a leap second": (lines(["time", *RATES], rows(lambda t: f"2016-12-31T23:59:60.{t:.2f}"[:22] + "Z")), DEG, dict(stamps="iso"), "stamps of ISO 8601"),
    "no header": (lines(rows()[0], rows()[1:]), DEG, {}, r"`path` must be a csv file with a header \(pass header=\[...\]"),
    "a header that is told and there": (PLAIN, DEG, dict(header=["time [s]", *RATES]), "`header` must be None, for a.csv has one"),
    "a told header of other length": (lines(rows()[0], rows()[1:]), {"x": "deg/s"}, dict(header=["time [s]", "x [deg/s]"]), "2 cells in each row.*4 cells"),
    "rows of two instruments": (lines(["time [s]", "sensor", *RATES], [[row[0], i, *row[1:]] for row, i in zip(rows(), (0, 1, 0, 1))]), DEG, {},
                                r"`x` must be of one instrument: say which, where=\{'sensor': '0'\}, .*of 2 by the column 'sensor'"),
    "an instrument that is not there": (lines(["time [s]", "sensor", *RATES], [[row[0], 1, *row[1:]] for row in rows()]), DEG,
                                        dict(where={"sensor": 3}), r"`where` must hold in some row of a.csv"),
    "a mark for missing that nobody told": (PLAIN.replace("-0.25", "-9999"), DEG, {}, r"`y` must hold samples \(pass missing=\[-9999\].* -9999 in row 1"),
    "a mark for missing in another unit": (PLAIN.replace("-0.25", "-9999"), RAD, {}, r"`y` must hold samples .* -9999 in row 1"),
    "a channel of nothing but marks": (lines(["time [s]", "x [deg/s]"], [[0, 999.9], [1, 999.9]]), {"x": "deg/s"}, {}, r"pass missing=\[999.9\]"),
    "signals below each other": (lines(["time [s]", "signal", "value [deg/s]"], [[0, "x", 1], [0.1, "y", 2], [0.2, "x", 3]]), {"value": "deg/s"}, {},
                                 r"where=\{'signal': 'x'\}"),
    "an array of decimal commas that nobody told": (lines(["time [s]", "w [deg/s]"], [["0", "[1,5 2,5]"]], ";"), {"w.1": "deg/s"}, dict(separator=";"),
                                                    r"`w \[deg/s\]` must hold arrays"),
    "a unit behind a colon against what is told": (lines(["time [s]", "x:deg/s"], [[0, 1]]), {"x:deg/s": "rad/s"}, dict(told={"x:deg/s": "rad/s"}),
                                                   r"must be \[deg/s\]"),
    "ms by a name in camel case, told as s": (lines(["timeMs", *RATES], rows()), DEG, dict(time="timeMs", stamps="s"), r"\[ms\] by its name"),
    "a header in local time": (lines(["LocalTime", *RATES], rows(at_noon("2024-03-01T{}"))), DEG, dict(stamps="iso", time="LocalTime"),
                               "`zone` must be told, such as '.01:00', for the header is 'LocalTime'"),
    "a header that says another zone": (lines(["time (UTC)", *RATES], rows(at_noon("2024-03-01T{}"))), DEG, dict(stamps="iso", zone="+01:00"),
                                        "`zone` must be 'UTC', as the header"),
    "a zone by its letters": (lines(["time (CET)", *RATES], rows(at_noon("2024-03-01T{}"))), DEG, dict(stamps="iso"), "`zone` must be told"),
    "the channel of another clock beside": (
        lines(["t_gyro [s]", "x [deg/s]", "t_star [s]", "star [deg]"], [[row[0], row[1], 0.2 * i, i] for i, row in enumerate(rows())]),
        {"x": "deg/s", "star": "deg"}, dict(time="t_gyro"), r"`star` must be stamped by its own clock: load it with time='t_star .s.'"),
    "nanoseconds before seconds": (lines(["secs", "nsecs", "x [deg/s]"], [[1, 2, 3]]), {"x": "deg/s"}, dict(time=("x", "secs"), stamps="s+ns"),
                                   "`time` must name the columns of seconds"),
    "an array as a number": (lines(["time [s]", "w [deg/s]"], [["0", '"[1, 2]"']]), {"w": "deg/s"}, {}, r"ask for an element, 'w.0'\)"),
    "an array cut by commas": (lines(["time [s]", "w", "x [deg/s]", "y [deg/s]"], [["0", "[1", "2", "3]"]]), {"x": "deg/s"}, {},
                               "`path` must have arrays in cells of their own"),
    "arrays of different lengths": (lines(["time [s]", "w [deg/s]"], [["0", '"[1, 2]"'], ["1", '"[1]"']]), {"w.0": "deg/s"}, {},
                                    "hold arrays of one length, but it is of 1 elements in row 1"),
    "an element that is not there": (lines(["time [s]", "w [deg/s]"], [["0", '"[1, 2]"']]), {"w.2": "deg/s"}, {}, "hold arrays with an element 2"),
    "an element of no array": (PLAIN, {"x.0": "deg/s"}, {}, r"`x \[deg/s\]` must hold arrays"),
    "a sample without a stamp": (PLAIN.replace("\n0.01,", "\n,"), DEG, {}, "`time` must be finite"),
    "a separator that is another": (PLAIN, DEG, dict(separator=";"), r"pass separator=','\?"),
    "an encoding of no computer": (PLAIN, DEG, dict(encoding="klingon"), "`encoding` must be one that Python knows"),
    "a format of code": (PLAIN, DEG, dict(stamps="s+ns"), "`time` must name the columns of seconds and of nanoseconds"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_could_be_read_wrong_is_refused_in_one_line(tmp_path, what):
    text, units, how, message = REFUSED[what]
    path = written(tmp_path, text)
    for read in (load, report):
        with pytest.raises(ValueError, match=message) as refusal:
            read(path, units, **how)
        assert "\n" not in str(refusal.value) and str(refusal.value).startswith("`")


# attitudes: order and direction told once

TURNS = Rotation.from_rotvec(np.linspace(0, 4, 6)[:, None] * [2 / 7, -3 / 7, 6 / 7])  # body to reference


def attitudes(form, order, inverse=False):
    q = np.round((TURNS.inv() if inverse else TURNS).as_quat(canonical=True, scalar_first=order == "wxyz"), 6)
    return lines(["time [s]", *form], [[0.1 * i, *row] for i, row in enumerate(q.tolist())])


FORMS = {
    "letters, the scalar last": (["q_x", "q_y", "q_z", "q_w"], "xyzw"),
    "numbers, the scalar first": (["q[0]", "q[1]", "q[2]", "q[3]"], "wxyz"),
    "numbers from one, the scalar last": (["q1", "q2", "q3", "q4"], "xyzw"),
    "empty brackets": (["q_w []", "q_x []", "q_y []", "q_z []"], "wxyz"),
    "a scalar by name": (["qs [1]", "qi [1]", "qj [1]", "qk [1]"], "wxyz"),
    "letters that come in another order": (
        ["orientation.w", "orientation.x", "orientation.y", "orientation.z"],
        "wxyz",
    ),
}


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("what", FORMS)
def test_attitudes_come_out_scalar_first_and_body_to_reference(tmp_path, what, inverse):
    form, order = FORMS[what]
    path = written(tmp_path, attitudes(form, order, inverse))
    direction = "reference to body" if inverse else "body to reference"
    told = {"att": Quaternion([name.split(" ")[0] for name in form], order, direction)}
    _, columns = load(path, {}, quaternions=told)
    assert list(columns) == ["att.w", "att.x", "att.y", "att.z"]
    q = np.stack(list(columns.values()), 1)
    assert (TURNS.inv() * Rotation.from_quat(q, scalar_first=True)).magnitude().max() < 1e-5
    assert f"att: quaternion {order}, " in report(path, {}, quaternions=told)


def test_attitudes_stand_in_columns_of_arrays_too(tmp_path):
    frame = pandas.DataFrame({"time [s]": np.arange(6.0), "q_BN": TURNS.as_quat().tolist()})
    _, columns = load(written(tmp_path, frame), {}, quaternions={"q": Quaternion("q_BN", "xyzw", "body to reference")})
    q = np.stack(list(columns.values()), 1)
    assert (TURNS.inv() * Rotation.from_quat(q, scalar_first=True)).magnitude().max() < 1e-12


@pytest.mark.parametrize(
    ("columns", "order", "direction", "message"),
    [
        (
            ["q_x", "q_y", "q_z", "q_w"],
            "wxyz",
            "body to reference",
            "order` must be that of the names, in which 'q_x' is x, but it is 'wxyz'",
        ),
        (["q[3]", "q[0]", "q[1]", "q[2]"], "xyzw", "body to reference", "order` must fit the numbers of the names"),
        (
            ["attX", "attY", "attZ", "attW"],
            "wxyz",
            "body to reference",
            "order` must be that of the names, in which 'attX' is x",
        ),
        (["q_x", "q_y", "q_z", "q_w"], "xyz", "body to reference", r"order` must be one of \('wxyz', 'xyzw'\)"),
        (["q_x", "q_y", "q_z", "q_w"], "xyzw", "B2N", "direction` must be one of"),
        (["q_x", "q_y", "q_z"], "xyzw", "body to reference", "columns` must be four different headers"),
    ],
)
def test_conventions_that_contradict_the_names_are_refused(tmp_path, columns, order, direction, message):
    path = written(tmp_path, attitudes(["q_x", "q_y", "q_z", "q_w"], "xyzw"))
    with pytest.raises(ValueError, match=message):
        load(path, {}, quaternions={"q": Quaternion(columns, order, direction)})


def test_names_in_another_order_are_refused_where_w_is_to_be_first():
    columns = dict(zip(["qx", "qy", "qz", "qw"], TURNS.as_quat().T))
    with pytest.raises(ValueError, match="`names` must be that of the names, in which 'qx' is x"):
        unit_quaternions(columns, list(columns))
    assert list(unit_quaternions(columns, ["qw", "qx", "qy", "qz"])) == ["qw", "qx", "qy", "qz"]


# several clocks, and recorders without a file


def test_instruments_on_their_own_clocks_become_one_recording(tmp_path):
    imu = written(tmp_path, PLAIN, "imu")
    star = written(tmp_path, lines(["t [ms]", "angle [deg]"], [[100 + 5, 1], [100 + 25, 2]]), "star")
    one, other = load(imu, DEG), load(star, {"angle": "deg"}, time="t", stamps="ms")
    t, columns = merged({"imu": one, "star": other}, offsets={"star": -0.1})
    np.testing.assert_allclose(t, [0, 0.005, 0.01, 0.02, 0.025, 0.05], atol=1e-15)
    np.testing.assert_array_equal(columns["x"], [0.1, np.nan, 0.15, 0.2, np.nan, 0.25])
    np.testing.assert_array_equal(columns["angle"], [np.nan, 1, np.nan, np.nan, 2, np.nan])
    assert resample(t, columns, dt=0.01)["angle"].valid.sum() == 2
    for given, offsets, message in (
        ({"imu": one, "star": other}, {}, "`recordings.'star'.` must have a time in common with 'imu' .see offsets."),
        (
            {"imu": one, "again": one},
            {},
            "`recordings` must have channels of different names, but it is of 'x' in 'imu' and 'again'",
        ),
        ({"imu": one}, {"star": 1.0}, "`offsets` must name recordings"),
    ):
        with pytest.raises(ValueError, match=message):
            merged(given, offsets)


def test_a_recorder_of_basilisk_needs_no_file():
    """Its times are whole nanoseconds, its vectors arrays (T, 3)."""
    recorder = SimpleNamespace(
        times=lambda: np.array([0, 500_000_000, 1_000_000_000], np.uint64), omega_BN_B=np.arange(9.0).reshape(3, 3)
    )
    t, columns = checked(recorder.times() * 1e-9, {"omega_BN_B": recorder.omega_BN_B})
    assert t.tolist() == [0, 0.5, 1] and columns["omega_BN_B.1"].tolist() == [1, 4, 7] and len(columns) == 3


def test_the_report_says_all_that_was_understood(tmp_path):
    text = lines(["time", "x [deg/s]", "star [1]", "note"],
                 [[f"2024-03-01 13:00:{i:02d}", i, "" if i % 2 else i, "a"] for i in (*range(10), *range(20, 30))])  # fmt: skip
    said = report(written(tmp_path, text), {"x": "rad/s", "star": "1"}, stamps="iso", zone="+01:00").splitlines()
    assert said == [
        "a.csv: 20 rows, 4 columns; separator ',', decimal sign '.'",
        "time: 'time' in iso, 2024-03-01T12:00:00.000+00:00 to 2024-03-01T12:00:29.000+00:00, zone +01:00, 29 s in 20 instants",
        "x: from 'x [deg/s]' [deg/s] x 0.0174532925; 0 to 0.506145, no sample missing",
        "star: from 'star [1]' [1]; 0 to 28, 10 samples",
        "x: 1 Hz, steps of 1 to 11 s, 1 gap: 11 s after 1709294409 s",
        "star: 0.5 Hz, steps of 2 to 12 s, 1 gap: 12 s after 1709294408 s",
        "left alone: note",
    ]
    with pytest.raises(TypeError, match="`layout` must be arguments of load, but it is seperator"):
        report(tmp_path / "a.csv", {}, seperator=";")
