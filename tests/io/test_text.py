"""CSV in the wild: every dialect gives the same numbers, and what is ambiguous is refused."""

import gzip
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nfriction.recording import Recording

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
    # A letter beyond ASCII in a column that nobody asks for.
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
def test_units_in_the_file_are_followed(
    tmp_path: Path, separator: str, header: str, units: str
) -> None:
    back = read(tmp_path, written(separator, separator != ",", header, units))
    # Two roundings, of the factor and of the quotient.
    np.testing.assert_allclose(back.q, np.deg2rad(Q), rtol=4e-16)
    assert np.array_equal(back.time, TIME)
    # The option says the same again, no more.
    again = read(tmp_path, written(separator, separator != ",", header, units), degrees=True)
    assert again.digest() == back.digest()


def test_columns_are_mapped_with_their_units(tmp_path: Path) -> None:
    text = written(";", True, "t{0}enc_1{0}enc_2").replace("t;", "remark;", 1)
    text = text.replace("remark;", "t;", 1)
    mapping = {"time": "t:ms", "q1": "enc_1:deg", "q2": "enc_2:counts/8192"}
    back = read(tmp_path, text, columns=mapping)
    np.testing.assert_allclose(back.q, Q * [np.pi / 180, 2 * np.pi / 8192], rtol=4e-16)
    np.testing.assert_allclose(back.time, TIME / 1000, rtol=1e-15)
    # A header may be given with or without the unit that it holds, and own a colon.
    text = written(";", True, "t [ms]{0}axis:1 [deg]{0}axis:2 [deg]")
    for names in ({"time": "t", "q1": "axis:1", "q2": "axis:2"},
                  {"time": "t [ms]:ms", "q1": "axis:1 [deg]", "q2": "axis:2:deg"}):  # fmt: skip
        np.testing.assert_allclose(read(tmp_path, text, columns=names).q, np.deg2rad(Q), rtol=4e-16)


def test_lengths_make_a_sliding_axis(tmp_path: Path) -> None:
    text = written(",", False, "time{0}x{0}y")
    back = read(tmp_path, text, columns={"q1": "x:mm", "q2": "y:m"})
    assert back.unit == "m"
    np.testing.assert_allclose(back.q, Q * [1e-3, 1.0], rtol=4e-16)
    with pytest.raises(ValueError, match="all be angles or all be lengths"):
        read(tmp_path, text, columns={"q1": "x:mm", "q2": "y:deg"})
    with pytest.raises(ValueError, match="`unit` is 'rad', but the columns are in 'm'"):
        read(tmp_path, text, columns={"q1": "x:mm", "q2": "y:m"}, unit="rad")


@pytest.mark.parametrize("separator", [",", ";", " "])
def test_only_whole_lines_are_comments(tmp_path: Path, separator: str) -> None:
    text = written(separator, False, "time{0}enc#1{0}enc#2").replace("\n", "\n  # noted\n", 4)
    text = "# convention: absolute,hanging\n  # remark: none\n" + text
    back = read(tmp_path, text, columns={"q1": "enc#1", "q2": "enc#2"})
    assert np.array_equal(back.q, Q)
    assert str(back.convention) == "absolute,hanging"


def test_degrees_said_of_the_whole_file_are_converted_when_asked(tmp_path: Path) -> None:
    text = "# unit: deg\n" + written(",", False)
    with pytest.raises(ValueError, match="got 'deg'; degrees are converted by"):
        read(tmp_path, text)
    back = read(tmp_path, text, degrees=True)
    assert back.unit == "rad"
    np.testing.assert_allclose(back.q, np.deg2rad(Q), rtol=4e-16)


def test_an_ending_separator_is_no_column(tmp_path: Path) -> None:
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
        ("time;q1\n0;1.234,5\n1;1.235,5\n", r"column q1, row 0 .* got '1\.234,5'"),
        ("time;q1;q1\n0;1;2\n1;2;3\n", "q1 is there more than once"),
        ("time;q1;q1 \n0;1;2\n1;2;3\n", "q1 is there more than once"),
        ("time;q1\n[s];[bar]\n0;1\n1;2\n", r"column q1: '\[bar\]' is no unit of q"),
        ("time;q1\n[s];[ms]\n0;1\n1;2\n", r"'\[ms\]' is no unit of q"),
        ("time;q1\nx;y\n0;1\n", "row 0 .* must be a number, got 'x'"),
        ("# only: a comment\n", "no header"),
        ("time;q1\n0;\0\n", "NUL bytes"),
        ("time;q1\n" + '0;"1\n', "EOF inside string"),
    ],
)  # fmt: skip
def test_what_can_be_read_in_two_ways_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        read(tmp_path, text)
    assert "run.csv" in str(caught.value)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"q1": "enc:grad"}, "enc:grad is missing.* 'grad' is no unit known"),
        ({"q1": "enc:ms"}, "column enc: 'ms' is no unit of q"),
        ({"q1": "absent:deg"}, "absent:deg is missing; found time, enc"),
        ({"q1": "enc:rad", "time": "time [ms]:s"}, "is missing"),
        ({"joint": "enc"}, "`columns` maps time, q1"),
    ],
)
def test_mappings_that_lead_nowhere_are_named(
    tmp_path: Path, columns: dict[str, str], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        read(tmp_path, "time,enc\n" + "".join(f"{k},0\n" for k in range(9)), columns=columns)


def test_units_that_contradict_are_refused(tmp_path: Path) -> None:
    text = written(",", False, "time [s]{0}q1 [rad]{0}q2 [rad]")
    with pytest.raises(ValueError, match=r"`degrees=True`, but column q1 \[rad\]"):
        read(tmp_path, text, degrees=True)
    with pytest.raises(ValueError, match="given as 'deg', but the file says"):
        read(tmp_path, text, columns={"q1": "q1 [rad]:deg"})


def test_a_german_row_of_units_is_read_and_own_words_give_way(tmp_path: Path) -> None:
    rows = "".join(f"{k};{10 * k},5;{k}\n" for k in range(9))
    columns = {"time": "Zeit", "q1": "Winkel", "q2": "Arm:mrad"}
    found = read(tmp_path, "Zeit;Winkel;Arm\nms;Grad;Striche\n" + rows, columns=columns)
    np.testing.assert_allclose(found.time[:2], [0, 1e-3])
    np.testing.assert_allclose(np.rad2deg(found.q[1, 0]), 10.5)
    np.testing.assert_allclose(found.q[8, 1], 8e-3)
    with pytest.raises(ValueError, match="'Striche' is no unit of q"):
        read(tmp_path, "Zeit;Winkel;Arm\nms;Grad;Striche\n" + rows, columns=columns | {"q2": "Arm"})


def test_what_unpacks_to_far_more_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.csv.gz"
    path.write_bytes(gzip.compress(b"time,q1\n" + b"0,0\n" * 100_000))
    monkeypatch.setattr("nfriction.io.formats.files.LARGEST", 100_000)
    with pytest.raises(ValueError, match="unpacked bytes, more than 100000 are read"):
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
def test_bytes_of_any_kind_are_read_or_refused(tmp_path: Path, content: bytes) -> None:
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
