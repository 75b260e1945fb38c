"""Numbers in text: rounding against float(), tables against NumPy, and tables that could be read in two ways."""

import io
import random
import struct

import numpy as np
import pytest

from processor import readers
from processor.model import InputError
from processor.readers import ascii_rows as rows_module
from processor.readers.ascii_rows import Rows


def numbers(text, columns=(0, 1, 2), most=2**62, **how):
    pieces = [piece.copy() for piece in Rows(io.BytesIO(text.encode()), **how).pieces(columns, most)]
    return np.concatenate(pieces) if pieces else np.empty((0, len(columns)))


def written(rng):
    """A number, in one of the ways programs write them."""
    way = rng.randrange(8)
    x = rng.uniform(-1.0, 1.0) * 10.0 ** rng.randint(-12, 12)
    if way == 0:
        return repr(struct.unpack("<d", rng.randbytes(8))[0])
    if way == 1:
        return str(rng.randrange(10 ** rng.randint(1, 25)))
    if way == 2:
        return f"{x:.{rng.randint(17, 30)}e}"
    return (repr(x), f"{x:.6f}", f"{x:+.18e}", f"{x:.3E}", f"{abs(x) % 1:.5f}".lstrip("0"))[way - 3]


def test_every_number_is_rounded_as_by_float():
    rng = random.Random(5)
    words = [written(rng) for _ in range(12_000)]  # a thousand and more in each of the ways
    text = "\n".join(" ".join(words[i : i + 3]) for i in range(0, len(words), 3))
    found, expected = numbers(text).ravel(), np.array([float(word) for word in words])
    wrong = np.flatnonzero(found.view(np.int64) != expected.view(np.int64))
    wrong = [i for i in wrong if not (np.isnan(found[i]) and np.isnan(expected[i]))]
    assert not wrong, [(words[i], found[i]) for i in wrong[:5]]


@pytest.mark.parametrize("separator", [None, ",", ";", "\t"])
@pytest.mark.parametrize(("pieces", "workers"), [(1_000, 1), (20_000, 3), (1 << 20, 4)])
def test_tables_against_numpy(monkeypatch, separator, pieces, workers):
    monkeypatch.setattr(rows_module, "PIECE_BYTES", pieces)  # the smallest end within a line
    monkeypatch.setattr(rows_module, "LEAST_PART", 200)
    monkeypatch.setattr(rows_module.os, "cpu_count", lambda: workers)
    rng = random.Random(7)
    join, lines = (separator or " "), []
    for _ in range(800):
        cells = [f"{rng.uniform(-9, 9):.{rng.randint(0, 9)}f}" for _ in range(rng.randint(4, 6))]
        line = (join + rng.choice(("", " "))).join(cells)
        lines.append(
            rng.choice(("", "  ", "\t" if separator != "\t" else "")) + line + rng.choice(("", " ", " # more"))
        )
        if rng.random() < 0.1:
            lines.append(rng.choice(("", "# 1 2 3")))
    expected = np.loadtxt(io.StringIO("\n".join(lines)), delimiter=separator, usecols=(3, 0, 1))
    for end in ("\n", "\r\n", "\r"):
        text = end.join(lines) + rng.choice(("", end))
        assert np.array_equal(numbers(text, (3, 0, 1), separator=separator), expected)
        assert np.array_equal(numbers(text, (3, 0, 1), most=300, separator=separator), expected[:300])


@pytest.mark.parametrize(
    ("text", "how", "why"),
    [
        ("1 2 3\r\n\r\n4 5", {}, "line 3: expected 3 columns or more, found 2"),
        ("1 2 1.2.3", {}, "found '1.2.3'"),
        ("1_0 2 3", {}, "found '1_0'"),
        ("0x10 2 3", {}, "found '0x10'"),
        ("1 2 3\n1e 2 3", {}, "found '1e'"),
        ("1,5 2 3", {}, "found '1,5'"),
        ("1 2 -", {}, "found '-'"),
        ("1 2,3 4,5", {"separator": ","}, "found '1 2'"),
        ("1,,3", {"separator": ","}, "found ''"),
        ("1 2 3" + " " * (1 << 21), {}, "longer than"),
    ],
)
def test_non_numeric_text_is_refused_with_its_line(monkeypatch, text, how, why):
    monkeypatch.setattr(rows_module, "PIECE_BYTES", 4)
    with pytest.raises(ValueError, match=why):
        numbers(text, **how)


def read(tmp_path, name, text):
    (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return readers.read(tmp_path / name)


@pytest.mark.parametrize(
    "text",
    [
        "//X Y Z R G B\n1\n1 2 3 0 0 0\n",
        "X Y Z\n# written by hand\n1 2 3\n",
        "# range x\nrow col x y z i\n0 1 1 2 3 9\n",
        "Hochwert;Rechtswert;Höhe\n2,0;1,0;3,0\n".encode("latin-1"),
        "点号,北坐标,东坐标,高程\n甲,2,1,3\n".encode("gb18030"),
        "".join(["点号,北,东,高\n", *("甲" * k + ",2,1,3\n" for k in range(1, 300))]).encode(),  # beyond 64 KB
    ],
)
def test_a_header_is_read_by_the_meaning_of_its_names(tmp_path, text):
    (scan,) = read(tmp_path, "a.csv", text)
    assert scan.points[0].tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("range,theta,phi\n1,2,3\n", "found range, theta, phi, which are polar; export Cartesian"),
        ("# range theta phi\n1 2 3\n", "which are polar"),
        ("range,theta,phi\n1,2,3,4\n", "the header names 3 columns .* rows have 4"),
        ("lon,lat,height\n1,2,3\n", "which are geographic"),
        ("A,B,C\n1,2,3\n", "found A, B, C; correct"),
        ("X,Y,Z,Easting,Northing,Height\n1,2,3,1,2,3\n", "one column each of x, y, z"),
        ("".join(f"{i // 9} {i % 9} {i / 7:.2f} 2.5 3.5 7\n" for i in range(20)), r"first columns \(0 0, 0 1, 0 2"),
        ("".join(f"{3 * i} {i / 7:.2f} 2.5 3.5\n" for i in range(20)), r"first column \(0, 3, 6, ...\)"),
        ("P1,10.5,20.5,1.5\nP2,11.5,21.5,1.5\n", r"column 1 is text \('P1'\)"),
        ("10.5 20.5 1.5 S1\n11.5 21.5 1.5 S1\n", "column 4 is text"),
        ("ncols 3\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3\n4 5 6\n", "grid of heights"),
    ],
)
def test_columns_that_are_not_known_to_be_coordinates_are_refused_by_name(tmp_path, text, why):
    with pytest.raises(InputError, match=why):
        read(tmp_path, "a.asc", text)


@pytest.mark.parametrize(
    "text",
    [
        "# made by hand\n1 2 3\n4 5 6\n",
        "".join(f"{x} {y} 0.5 9\n" for x in range(3) for y in range(3)),  # a profile in whole millimetres
        "".join(f"{x} {y} 1 0.5 0.5 7\n" for x in range(3) for y in range(3)),
    ],
)
def test_the_first_three_columns_count_where_nothing_speaks_against_it(tmp_path, text):
    (scan,) = read(tmp_path, "a.xyz", text)
    assert len(scan.points) == text.count("\n") - text.count("#")


def test_decimal_commas_after_whole_numbers(tmp_path):
    for text in ("1;2;3\n1,5;2,5;3,5\n", "1 2 3\n1,5 2,5 3,5\n"):
        assert read(tmp_path, "a.csv", text)[0].points.tolist() == [[1, 2, 3], [1.5, 2.5, 3.5]]


def test_a_pts_file_of_several_scans(tmp_path):
    scans = read(tmp_path, "a.pts", "2\n1 2 3 9\n4 5 6 8\n1\n7 8 9 7\n")
    found = [(scan.name, scan.points.tolist()) for scan in scans]
    assert found == [("a-1", [[1, 2, 3], [4, 5, 6]]), ("a-2", [[7, 8, 9]])]
    assert scans[1].intensity.tolist() == [7]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("1,5,2,5,3,5\n1,6,2,6,3,6\n", "decimal signs of three"),
        ("".join(f"{i} {i * 0.1:.2f} 2.5 3.5\n" for i in range(1, 9)), r"in the first column \(1, 2, 3, ...\)"),
        ("2\n1 2 3\n4 5 6\n5\n7 8 9\n", "declares 5 points"),
    ],
)
def test_tables_that_can_be_read_in_two_ways_are_refused(tmp_path, text, why):
    with pytest.raises(InputError, match=why):
        read(tmp_path, "a.pts", text)


def test_utf16_and_old_line_ends(tmp_path):
    for text in ("x y z\r1 2 3\r4 5 6\r".encode("utf-16"), "1 2 3\r4 5 6\r"):
        assert read(tmp_path, "a.txt", text)[0].points.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_short_lines_after_long_ones(tmp_path, monkeypatch):
    """The room for rows is guessed from the first of them."""
    monkeypatch.setattr(rows_module, "PIECE_BYTES", 1_000)
    text = "".join(f"{i}.00000000 2.0000000000000 3.000000000000\n" for i in range(50)) + "1 2 3\n" * 5_000
    (scan,) = read(tmp_path, "a.xyz", text)
    assert len(scan.points) == 5_050
    assert scan.points[:, 0].tolist() == [*range(50), *[1] * 5_000]


def test_many_grids_in_one_ptx_are_separated_for_any_block_size(tmp_path):
    """Parts that threads take end in the middle of a grid, or hold the head of the next one."""
    rng = np.random.default_rng(5)
    grids = [rng.uniform(1.0, 9.0, (rows, 4)).round(4) for rows in (3000, 6001, 9000, 3, 7000)]
    head = "1\n{}\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    with (tmp_path / "many.ptx").open("w") as file:
        for grid in grids:
            file.write(head.format(len(grid)))
            np.savetxt(file, grid, fmt="%.4f")
    found = readers.read(tmp_path / "many.ptx")
    assert len(found) == len(grids)
    for scan, grid in zip(found, grids, strict=True):
        np.testing.assert_allclose(scan.points + scan.origin, 1e3 * grid[:, :3] if scan.unit == "mm" else grid[:, :3])


def test_a_row_of_more_columns_than_any_export_has_is_refused(tmp_path):
    (tmp_path / "a.xyz").write_text("1 " * 1_000_000 + "\n")
    with pytest.raises(InputError, match=r"a\.xyz: line 1: expected at most 1000 columns, found \d+"):
        readers.read(tmp_path / "a.xyz")
