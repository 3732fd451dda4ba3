"""CSV files from practice: every dialect gives the same numbers, and ambiguity is refused."""

import gzip
import itertools
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nfriction.io.formats.text import parse_csv
from nfriction.recording import Recording, RecordingWarning

TIME = np.arange(20) / 1000
Q = np.random.default_rng(0).normal(size=(20, 2)) / 7


def written(separator: str, comma: bool, header: str = "time{0}q1{0}q2", units: str = "") -> str:
    rows = [header.format(separator), *([units.format(separator)] if units else [])]
    for t, q in zip(TIME.tolist(), Q.tolist(), strict=True):
        cells = [repr(x) for x in (t, *q)]
        rows.append(separator.join(c.replace(".", ",") if comma else c for c in cells))
    return "\n".join(rows) + "\n"


def read(folder: Path, content: str | bytes, **settings: object) -> Recording:
    path = folder / "run.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return Recording.read(path, **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("separator", "comma"),
    [p for p in itertools.product(",;\t ", (False, True)) if p != (",", True)],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_every_dialect_gives_the_same_numbers(
    tmp_path: Path, separator: str, comma: bool, encoding: str, ending: str
) -> None:
    text = written(separator, comma).replace("\n", ending)
    # A non-ASCII letter in an unused column.
    text = text.replace("q2", f"q2{separator}Übung", 1) if encoding == "latin-1" else text
    if encoding == "latin-1":
        lines = text.split(ending)
        text = ending.join([lines[0], *(f"{x}{separator}1" for x in lines[1:-1]), ""])
    back = read(tmp_path, text.encode(encoding))
    assert np.array_equal(back.q, Q)
    assert np.array_equal(back.time, TIME)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize(
    ("header", "units"),
    [("time{0}q1{0}q2", "[s]{0}[deg]{0}[deg]"), ("time{0}q1{0}q2", "s{0}deg{0}°"),
     ("time [s]{0}q1 [deg]{0}q2 (deg)", "")],
)  # fmt: skip
def test_units_in_the_file_are_converted(
    tmp_path: Path, separator: str, header: str, units: str
) -> None:
    back = read(tmp_path, written(separator, separator != ",", header, units))
    # Two roundings, of the factor and of the quotient.
    np.testing.assert_allclose(back.q, np.deg2rad(Q), rtol=4e-16)
    assert np.array_equal(back.time, TIME)
    # The option repeats the unit of the file, which changes nothing.
    again = read(tmp_path, written(separator, separator != ",", header, units), degrees=True)
    assert again.digest() == back.digest()


def test_columns_are_mapped_with_their_units(tmp_path: Path) -> None:
    text = written(";", True, "t{0}enc_1{0}enc_2").replace("t;", "remark;", 1)
    text = text.replace("remark;", "t;", 1)
    mapping = {"time": "t:ms", "q1": "enc_1:deg", "q2": "enc_2:counts/8192"}
    back = read(tmp_path, text, columns=mapping)
    np.testing.assert_allclose(back.q, Q * [np.pi / 180, 2 * np.pi / 8192], rtol=4e-16)
    np.testing.assert_allclose(back.time, TIME / 1000, rtol=1e-15)
    # A header may be given with or without its unit, and may contain a colon.
    text = written(";", True, "t [ms]{0}axis:1 [deg]{0}axis:2 [deg]")
    for names in ({"time": "t", "q1": "axis:1", "q2": "axis:2"},
                  {"time": "t [ms]:ms", "q1": "axis:1 [deg]", "q2": "axis:2:deg"}):  # fmt: skip
        np.testing.assert_allclose(read(tmp_path, text, columns=names).q, np.deg2rad(Q), rtol=4e-16)


@pytest.mark.parametrize(
    ("head", "row"),
    [
        (",time,q1\n-,s,rad\n", "{k},{k}.0,0.5\n"),
        ("time,q1,,tau1\n[s],[rad],[-],[Nm]\n", "{k},0.5,7,1.5\n"),
        ("time,q1,tau1,state\n", "{k},0.5,1.5,ok\n"),
        ("time;q1;\n", "{k},5;1.234,6;1.234,7\n"),
        ("Range;0;10\nDate;29.11.2026\ntime;q1\n", "{k},5;0,5\n"),
    ],
)
def test_first_row_of_names_above_numbers_is_the_header(
    tmp_path: Path, head: str, row: str
) -> None:
    text = head + "".join(row.format(k=k) for k in range(12))
    assert {"time", "q1"} <= {*parse_csv(text).columns}
    # Also with a line of text at the end, which may have more cells.
    assert {"time", "q1"} <= {*parse_csv(text + "end\n").columns}


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_titles_above_the_header_are_skipped(tmp_path: Path, separator: str) -> None:
    title = f"Bench 7{2 * separator}\n\nsecond run\n"
    assert np.array_equal(read(tmp_path, title + written(separator, False)).q, Q)
    settings = f"Rate [Hz]{separator}1000\nStarted{separator}29.11.2026\n\n"
    assert np.array_equal(read(tmp_path, settings + written(separator, False)).q, Q)
    units = f"{separator}".join(["s", "rad", "rad"])
    name = written(separator, False).split("\n", 1)
    assert np.array_equal(read(tmp_path, f"{name[0]}\n{units}\n{name[1]}").q, Q)
    assert np.array_equal(read(tmp_path, f"{settings}{name[0]}\n{units}\n{name[1]}").q, Q)
    # A single word is no header of a table, and neither are numbers.
    with pytest.raises(ValueError, match=r"header|missing"):
        read(tmp_path, written(separator, False, header="time"))


def test_column_may_be_named_without_its_unknown_unit(tmp_path: Path) -> None:
    text = written(";", False, header="time{0}enc [inc]{0}enc2 (left)")
    columns = {"q1": "enc:counts/1000", "q2": "enc2"}
    assert np.array_equal(read(tmp_path, text, columns=columns).q[:, 1], Q[:, 1])
    text = written(";", False, header="time{0}enc (left){0}enc (right)")
    with pytest.raises(ValueError, match="enc"):
        read(tmp_path, text, columns={"q1": "enc"})


def test_length_units_define_a_sliding_axis(tmp_path: Path) -> None:
    text = written(",", False, "time{0}x{0}y")
    back = read(tmp_path, text, columns={"q1": "x:mm", "q2": "y:m"})
    assert back.unit == "m"
    np.testing.assert_allclose(back.q, Q * [1e-3, 1.0], rtol=4e-16)
    with pytest.raises(ValueError, match="all be angles or all be lengths"):
        read(tmp_path, text, columns={"q1": "x:mm", "q2": "y:deg"})
    with pytest.raises(ValueError, match="`unit` is 'rad', but the columns are in 'm'"):
        read(tmp_path, text, columns={"q1": "x:mm", "q2": "y:m"}, unit="rad")


def test_unit_suffix_applies_unless_another_unit_is_stated(tmp_path: Path) -> None:
    text = written(",", False, "t_ms{0}x_mm{0}y_mm")
    back = read(tmp_path, text, columns={"time": "t_ms", "q1": "x_mm", "q2": "y_mm:m"})
    np.testing.assert_allclose(back.q, Q * [1e-3, 1.0], rtol=4e-16)
    np.testing.assert_allclose(back.time, TIME / 1000, rtol=1e-15)


@pytest.mark.parametrize("separator", [",", ";", " "])
def test_only_whole_lines_are_comments(tmp_path: Path, separator: str) -> None:
    text = written(separator, False, "time{0}enc#1{0}enc#2").replace("\n", "\n  # noted\n", 4)
    text = "# convention: absolute,hanging\n  # remark: none\n" + text
    back = read(tmp_path, text, columns={"q1": "enc#1", "q2": "enc#2"})
    assert np.array_equal(back.q, Q)
    assert str(back.convention) == "absolute,hanging"


def test_degrees_option_converts_the_whole_file(tmp_path: Path) -> None:
    text = "# unit: deg\n" + written(",", False)
    with pytest.raises(ValueError, match=r"got 'deg'; .*converts degrees"):
        read(tmp_path, text)
    back = read(tmp_path, text, degrees=True)
    assert back.unit == "rad"
    np.testing.assert_allclose(back.q, np.deg2rad(Q), rtol=4e-16)


def test_trailing_separator_is_no_column(tmp_path: Path) -> None:
    text = written(";", True).replace("\n", ";\n")
    assert np.array_equal(read(tmp_path, text).q, Q)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,q1\n0,0,1,5\n0,1,1,6\n", "more cells than its header; with decimal commas"),
        ("time,q1\n0,0;1,5\n0,1;1,6\n", "header is separated by commas, its rows by semicolons"),
        ("time,q1\n0\t1\n1\t2\n", "header is separated by commas, its rows by tabs"),
        ("time;q1;q2\n0,1;1,5;1.5\n0,2;1,6;1.6\n", "decimal commas and column q2 decimal points"),
        ("time;q1\n0,1;1,5\n0,2;1.6\n", "must be a number, got '1,5'|decimal commas"),
        ("time;q1\n0;1.23,5\n1;1.235,5\n", r"column q1, row 0 .* got '1\.23,5'"),
        ("time;q1;q1\n0;1;2\n1;2;3\n", "q1 occurs more than once"),
        ("time;q1;q1 \n0;1;2\n1;2;3\n", "q1 occurs more than once"),
        ("time;q1\n[s];[bar]\n0;1\n1;2\n", r"column q1: '\[bar\]' is not a unit of q"),
        ("time;q1\n[s];[ms]\n0;1\n1;2\n", r"'\[ms\]' is not a unit of q"),
        ("time;q1\nx;y\n0;1\n", "row 0 .* must be a number, got 'x'"),
        ("time,q1\n2026-01-02T10:00:00,1\n2026-01-02T10:00:01,2\n", "dates and clock times in"),
        ("time,q1\n00:00:00.5,1\n00:00:01.0,2\n", "dates and clock times in seconds"),
        ("# only: a comment\n", "no header"),
        ("time;q1\n0;\0\n", "NUL bytes"),
        ("time;q1\n" + '0;"1\n', "EOF inside string"),
    ],
)  # fmt: skip
def test_ambiguous_numbers_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        read(tmp_path, text)
    assert "run.csv" in str(caught.value)


def thousands(value: float, separator: str) -> str:
    return f"{value:,}".replace(",", separator)


def log(q1: list[str], time: list[str] | None = None, separator: str = ";") -> str:
    time = [str(k) for k in range(len(q1))] if time is None else time
    rows = [separator.join(pair) for pair in zip(time, q1, strict=True)]
    return "\n".join([separator.join(("time", "q1")), *rows]) + "\n"


COUNTS = np.rint(35_000 + 1200 * np.cos(np.arange(40) / 7)).astype(int)
IN_COUNTS = {"time": "time:ms", "q1": "q1:counts/40000"}
# The only numbers that would settle the decimal sign are in unused columns or in a unit.
BY_COLUMN = {
    "more than a million": ([0, 999, 12_345, 1_234_567, 1_234_000, 8, 9, 10], None),
    "a point elsewhere": (COUNTS.tolist(), [f"{k / 1000:.3f}" for k in range(40)]),
}


@pytest.mark.parametrize("separator", [",", "."])
@pytest.mark.parametrize("case", BY_COLUMN)
def test_thousands_separators_are_recognised_from_the_whole_file(
    tmp_path: Path, separator: str, case: str, recwarn: pytest.WarningsRecorder
) -> None:
    values, time = BY_COLUMN[case]
    if time and separator == ".":
        time = [stamp.replace(".", ",") for stamp in time]
    back = read(tmp_path, log([thousands(x, separator) for x in values], time), unit="m")
    assert np.array_equal(back.q[:, 0], values)
    assert not [w for w in recwarn if "thousands" in str(w.message)]


@pytest.mark.parametrize("separator", [",", "."])
def test_counters_are_integers(
    tmp_path: Path, separator: str, recwarn: pytest.WarningsRecorder
) -> None:
    text = log([thousands(int(x), separator) for x in COUNTS])
    back = read(tmp_path, text, columns=IN_COUNTS)
    np.testing.assert_allclose(back.q[:, 0], COUNTS * 2 * np.pi / 40_000, rtol=1e-15)
    assert np.array_equal(read(tmp_path, text.replace("q1", "q1 [counts/40000]"),
                               columns={"time": "time:ms", "q1": "q1"}).q, back.q)  # fmt: skip
    assert not recwarn


@pytest.mark.parametrize("separator", [",", "."])
def test_ambiguous_thousands_separators_raise_an_error_with_remedy(
    tmp_path: Path, separator: str
) -> None:
    text = log([thousands(int(x), separator) for x in COUNTS])
    with pytest.warns(
        RecordingWarning, match=r"q1 .*assumed that .*3[56].* is a decimal sign; .*# decimal"
    ):
        assert np.array_equal(read(tmp_path, text, unit="m").q[:, 0], COUNTS / 1000)
    for decimal, scale in ((separator, 1000), ({",": ".", ".": ","}[separator], 1)):
        with warnings.catch_warnings():
            warnings.filterwarnings("error", "column", RecordingWarning)
            back = read(tmp_path, f"# decimal: {decimal}\n{text}", unit="m")
        assert np.array_equal(back.q[:, 0], COUNTS / scale)


@pytest.mark.parametrize("separator", [",", "."])
def test_motion_through_a_thousand_is_resolved_with_a_warning(
    tmp_path: Path, separator: str
) -> None:
    counts = COUNTS - 34_900
    text = log([thousands(int(x), separator) for x in counts])
    with pytest.warns(RecordingWarning, match=r"assumed that .* separates thousands"):
        assert np.array_equal(read(tmp_path, text, unit="m").q[:, 0], counts)


def test_thousands_and_decimal_separators_in_one_number_are_read(tmp_path: Path) -> None:
    values = [999.5, 1000.25, 1234.5, 0, 1, 2, 3, -12345.75]
    english = log([f"{x:,}" for x in values])
    german = english.translate({ord(","): ".", ord("."): ","})
    for text in (english, german):
        assert np.array_equal(read(tmp_path, text).q[:, 0], values)


def test_numbers_in_quotation_marks_may_contain_commas(tmp_path: Path) -> None:
    text = log([f'"{x:,}"' for x in [0, *COUNTS.tolist(), 1_234_567]], separator=",")
    assert np.array_equal(read(tmp_path, text, unit="m").q[:, 0], [0, *COUNTS, 1_234_567])
    # Unused columns have no influence.
    noted = written(",", False, "time{0}q1{0}q2{0}note").replace("\n", ',"0,5"\n')
    assert np.array_equal(read(tmp_path, noted.replace(',"0,5"', "", 1)).q, Q)


@pytest.mark.parametrize(
    "text",
    [log([f"{x / 1000:.3f}" for x in range(990, 1030)]),
     log([f"{x}.125" for x in range(10, 20)], [f"{k / 10}" for k in range(10)]),
     log([f"{x}.125" for x in range(1020, 1030)]),
     log([f"{x}.125" for x in range(20)])],
)  # fmt: skip
def test_decimal_points_before_three_digits_raise_no_warning(
    tmp_path: Path, text: str, recwarn: pytest.WarningsRecorder
) -> None:
    for written_so in (text, text.replace(".", ",")):
        back = read(tmp_path, written_so)
        cells = [line.split(";")[1] for line in text.splitlines()[1:]]
        assert np.array_equal(back.q[:, 0], np.array(cells, dtype=float))
    assert not [w for w in recwarn if "thousands" in str(w.message)]


@pytest.mark.parametrize(
    ("text", "message"),
    [("# decimal: .\ntime;q1\n0;0,5\n", "column q1 has ',' as its decimal sign, .* states '.'"),
     ("# decimal: comma\ntime;q1\n0;0,5\n", "must state , or . as the sign, got 'comma'"),
     ("time;q1;q2\n0;1,234,567;1.234.567\n", "column q2 has decimal commas and column q1")],
)  # fmt: skip
def test_contradictory_separators_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read(tmp_path, text)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"q1": "enc:grad"}, "enc:grad is missing.* 'grad' is not a known unit"),
        ({"q1": "enc:ms"}, "column enc: 'ms' is not a unit of q"),
        ({"q1": "absent:deg"}, "absent:deg is missing; found time, enc"),
        ({"q1": "enc:rad", "time": "time [ms]:s"}, "is missing"),
        ({"joint": "enc"}, "`columns` maps time, q1"),
    ],
)
def test_mappings_to_missing_columns_are_named(
    tmp_path: Path, columns: dict[str, str], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        read(tmp_path, "time,enc\n" + "".join(f"{k},0\n" for k in range(9)), columns=columns)


def test_unknown_unit_in_brackets_is_reported(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    text = written(",", False, "time{0}angle [gon]{0}joint[2]")
    columns = {"q1": "angle [gon]", "q2": "joint[2]"}
    with pytest.warns(
        RecordingWarning, match=r"angle \[gon\]: 'gon' is not a known unit"
    ) as caught:
        assert np.array_equal(read(tmp_path, text, columns=columns).q, Q)
    assert not [w for w in caught if "joint[2]" in str(w.message)]  # an index
    recwarn.clear()
    read(tmp_path, text, columns=columns | {"q1": "angle [gon]:mrad"})
    assert not [w for w in recwarn if "gon" in str(w.message)]


def test_contradictory_units_are_refused(tmp_path: Path) -> None:
    text = written(",", False, "time [s]{0}q1 [rad]{0}q2 [rad]")
    with pytest.raises(ValueError, match=r"`degrees=True`, but column q1 \[rad\]"):
        read(tmp_path, text, degrees=True)
    with pytest.raises(ValueError, match="given as 'deg', but the file says"):
        read(tmp_path, text, columns={"q1": "q1 [rad]:deg"})


def test_german_row_of_units_is_read_and_options_take_precedence(tmp_path: Path) -> None:
    rows = "".join(f"{k};{10 * k},5;{k}\n" for k in range(9))
    columns = {"time": "Zeit", "q1": "Winkel", "q2": "Arm:mrad"}
    found = read(tmp_path, "Zeit;Winkel;Arm\nms;Grad;Striche\n" + rows, columns=columns)
    np.testing.assert_allclose(found.time[:2], [0, 1e-3])
    np.testing.assert_allclose(np.rad2deg(found.q[1, 0]), 10.5)
    np.testing.assert_allclose(found.q[8, 1], 8e-3)
    with pytest.raises(ValueError, match="'Striche' is not a unit of q"):
        read(tmp_path, "Zeit;Winkel;Arm\nms;Grad;Striche\n" + rows, columns=columns | {"q2": "Arm"})


def test_decompression_bombs_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.csv.gz"
    path.write_bytes(gzip.compress(b"time,q1\n" + b"0,0\n" * 100_000))
    monkeypatch.setattr("nfriction.io.formats.LARGEST", 100_000)
    with pytest.raises(ValueError, match="unpacked bytes, more than the limit of 100000"):
        Recording.read(path)


# Damaged numbers may well look like degrees or milliseconds.
pytestmark = pytest.mark.filterwarnings("ignore::nfriction.recording.RecordingWarning")
fuzzing = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def survives(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    refused: ValueError | None = None
    try:
        back = Recording.read(path)
    except ValueError as error:
        refused = error
    if refused is not None:
        assert str(path) in str(refused)
    else:
        assert np.isfinite(back.q).all()
        assert math.isfinite(back.duration)


@fuzzing
@given(content=st.binary(min_size=1, max_size=400))
def test_arbitrary_bytes_are_read_or_refused(tmp_path: Path, content: bytes) -> None:
    survives(tmp_path / "run.csv", content)


@fuzzing
@given(
    dialect=st.sampled_from([(",", False), (";", True), ("\t", True), (" ", False)]),
    edits=st.lists(
        st.tuples(
            st.integers(0, 600),
            st.integers(0, 4),
            st.text("0,;.\t \n\"#'-eE[()naq1:s\r°", max_size=4),
        ),
        min_size=1, max_size=4,
    ),
)  # fmt: skip
def test_edited_files_are_read_or_refused(
    tmp_path: Path, dialect: tuple[str, bool], edits: list[tuple[int, int, str]]
) -> None:
    text = written(*dialect)
    for at, drop, put in edits:
        text = text[:at] + put + text[at + drop :]
    survives(tmp_path / "run.csv", text.encode())
