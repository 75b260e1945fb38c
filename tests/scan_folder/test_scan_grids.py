"""Rows and columns of a scanner's grid, from its files to step stitch."""

import dataclasses

import numpy as np
import pye57
import pytest
from pye57 import libe57

from designgen.export import formats
from processor import readers
from processor.scan_folder import folder, scanner_grid
from processor.stitching.planes import scan_planes
from processor.writers import e57
from processor.writers.cloud import of_scan
from tests.support.clouds import stitch_clouds
from tests.support.files.scan_bytes import DATA, needs_data
from tests.support.scenes.exported_scenes import exported, merged
from tests.support.scenes.stitched_rooms import reordered

PTX_POSE = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
HOLE = "0 0 0 0.5\n"


def numbers(scan):
    return scan.grid_row.tolist(), scan.grid_column.tolist()


def swept(rows=20, columns=60, seed=0):
    """Points of a whole turn, m, with their rows and columns, column by column; a fifth did not come back."""
    rng = np.random.default_rng(seed)
    column, row = (x.ravel() for x in np.mgrid[:columns, :rows])
    came = rng.random(len(row)) > 0.2
    row, column = row[came].astype(np.int32), column[came].astype(np.int32)
    turn, up = 2.0 * np.pi * column / columns, 0.04 * row - 0.5
    R = rng.uniform(2.0, 30.0, len(row))
    points = R[:, None] * np.stack([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)], axis=1)
    return points, row, column


# --- PTX -----------------------------------------------------------------------------------------------------------


def test_ptx_is_read_column_by_column(tmp_path):
    # Three columns of four cells: x the column, y the row, both from 1; the fifth and others had no return.
    cells = [[f"{c} {r} 7 0.5\n" for r in (1, 2, 3, 4)] for c in (1, 2, 3)]
    cells[0][0] = cells[1][0] = cells[1][2] = cells[2][3] = HOLE
    grid = "3\n4\n" + PTX_POSE + "".join(cell for one in cells for cell in one)
    empty_columns = "3\n2\n" + PTX_POSE + HOLE * 3 + "1 2 3 0.5\n" + HOLE * 2
    line = "4\n1\n" + PTX_POSE + "1 2 3 0.5\n" * 4
    (tmp_path / "a.ptx").write_text(grid + empty_columns + line)
    first, second, third = readers.read(tmp_path / "a.ptx")
    assert first.points[:, :2].tolist() == [[1, 2], [1, 3], [1, 4], [2, 2], [2, 4], [3, 1], [3, 2], [3, 3]]
    assert numbers(first) == ([1, 2, 3, 1, 3, 0, 1, 2], [0, 0, 0, 1, 1, 2, 2, 2])
    assert numbers(second) == ([1], [1])
    assert numbers(third) == ([], [])  # four points in a line are no grid


def test_ptx_larger_than_a_piece(tmp_path):
    """Pieces of a file begin anywhere within a column."""
    rows, columns = 701, 997
    hole = np.random.default_rng(1).random(rows * columns) < 0.3
    lines = [HOLE if hole[i] else f"{i // rows} {i % rows} 1 0.5\n" for i in range(rows * columns)]
    (tmp_path / "a.ptx").write_text(f"{columns}\n{rows}\n" + PTX_POSE + "".join(lines))
    (scan,) = readers.read(tmp_path / "a.ptx")
    assert len(scan.points) == (~hole).sum()
    np.testing.assert_array_equal(scan.grid_column, scan.points[:, 0])
    np.testing.assert_array_equal(scan.grid_row, scan.points[:, 1])


# --- E57 -----------------------------------------------------------------------------------------------------------


def write_e57(path, scans):
    """Write scans, each a table of names to columns, or to a node and its column."""
    image = libe57.ImageFile(str(path), "w")
    image.extensionsAdd("", libe57.E57_V1_0_URI)
    vector = libe57.VectorNode(image, True)
    image.root().set("formatName", libe57.StringNode(image, "ASTM E57 3D Imaging Data File"))
    image.root().set("data3D", vector)
    for number, columns in enumerate(scans):
        prototype, node = libe57.StructureNode(image), libe57.StructureNode(image)
        kept, buffers = [], libe57.VectorSourceDestBuffer()
        for name, column in columns.items():
            floating = column.dtype == np.float64
            prototype.set(name, libe57.FloatNode(image) if floating else libe57.IntegerNode(image, 0, -(2**62), 2**62))
            kept.append(column if floating else column.astype(np.longlong))
            buffers.append(libe57.SourceDestBuffer(image, name, kept[-1], len(column), True, True))
        points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
        node.set("guid", libe57.StringNode(image, f"{{{number}}}"))
        node.set("points", points)
        vector.append(node)
        writer = points.writer(buffers)
        writer.write(len(kept[0]))
        writer.close()
    image.close()


def columns_of(points, **more):
    return {**{f"cartesian{axis}": points[:, i].copy() for i, axis in enumerate("XYZ")}, **more}


def test_e57_of_another_library_keeps_rows_and_columns(tmp_path):
    points = np.arange(12.0).reshape(4, 3) + 1.0
    columns = columns_of(points, cartesianInvalidState=np.array([0, 2, 0, 0], np.int8))
    columns |= {"rowIndex": np.array([3, 1, 2, 0], np.uint16), "columnIndex": np.array([7, 9, 8, 65_000], np.uint16)}
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        file.write_scan_raw(columns)
        file.write_scan_raw({key: value for key, value in columns.items() if key != "rowIndex"})
    first, second = readers.read(tmp_path / "a.e57")
    assert numbers(first) == ([3, 2, 0], [7, 8, 65_000])
    assert numbers(second) == ([], [])
    assert len(second.points) == 3


@pytest.mark.parametrize(
    ("row", "kept"),
    [
        (np.arange(300_000, 300_006), True),  # more than 16 bits
        (np.arange(6.0), True),  # whole numbers as doubles
        (np.array([0, 1, 2, 3, 4, -1]), False),
        (np.array([0, 1, 2, 3, 4, 2**31]), False),
        (np.array([0, 1, 2, 3, 4, 2**60]), False),
        (np.array([0.0, 1, 2, np.nan, 4, 5]), False),
        (np.array([0.0, 1, 2, np.inf, 4, 5]), False),
    ],
)
def test_invalid_row_numbers_in_e57_drop_the_grid_and_keep_the_points(tmp_path, row, kept):
    points = np.arange(18.0).reshape(6, 3) + 1.0
    good = columns_of(points, rowIndex=np.arange(6), columnIndex=np.arange(6))
    write_e57(tmp_path / "a.e57", [columns_of(points, rowIndex=row, columnIndex=np.arange(6)), good])
    odd, other = readers.read(tmp_path / "a.e57")
    assert odd.grid_row.tolist() == (row.tolist() if kept else [])
    assert len(odd.grid_column) == len(odd.grid_row)
    assert odd.points.tolist() == points.tolist()
    assert numbers(other) == ([0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 4, 5])


@needs_data
def test_a_real_scan_has_its_grid():
    (scan,) = folder.read_input(DATA / "e57/pumpAVisualReferenceImage.e57").scans
    assert len(scan.grid_row) == len(scan.points)
    # A merged cloud that was written in rows of 71 is no scanner's.
    (cloud,) = folder.read_input(DATA / "ptx_pts/1.2-with-color.ptx").scans
    assert not len(cloud.grid_row)


# --- what is taken for a scanner's grid ------------------------------------------------------------------------------


def test_sweep_is_recognised_as_a_grid_for_any_scanner_position():
    points, row, column = swept()
    at = np.array([5.0, -3.0, 1.0])
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    for moved, scanner in ((points, np.zeros(3)), (points @ turn.T + at, at)):
        kept = scanner_grid.of_scanner(moved, row, column, scanner)
        assert np.array_equal(kept[0], row)
        assert np.array_equal(kept[1], column)
    assert not len(scanner_grid.of_scanner(points + at, row, column, np.zeros(3))[0])


OTHER_ORDERS = {
    "rows and columns swapped": lambda index, row, column: (column, row),
    "rows of a hundred": lambda index, row, column: (index % 100, index // 100),
    "all in one row": lambda index, row, column: (np.zeros_like(row), index),
    "all in one column": lambda index, row, column: (index, np.zeros_like(row)),
    "cells of gigabytes": lambda index, row, column: (row * 100_000, column * 10_000),
    "a cell twice": lambda index, row, column: (
        np.where(index == 5, row[4], row),
        np.where(index == 5, column[4], column),
    ),
}


@pytest.mark.parametrize("case", [*OTHER_ORDERS, "too few to tell"])
def test_rows_of_other_orders_are_not_recognised_as_a_grid(case):
    points, row, column = swept()
    if case in OTHER_ORDERS:
        row, column = (x.astype(np.int32) for x in OTHER_ORDERS[case](np.arange(len(points)), row, column))
    else:
        points, row, column = points[:50], row[:50], column[:50]
    assert [len(x) for x in scanner_grid.of_scanner(points, row, column, np.zeros(3))] == [0, 0]


def test_a_piece_cut_out_of_a_large_grid_counts_from_nought():
    points, row, column = swept()
    kept = scanner_grid.of_scanner(points, row + 70_000, column + 90_000, np.zeros(3))
    assert np.array_equal(kept[0], row)
    assert np.array_equal(kept[1], column)


def test_a_large_scan_is_judged_by_a_part_of_it():
    """Also where every k-th point of it is of one row."""
    points, row, column = swept(rows=20, columns=12_000)
    assert len(points) > 3 * scanner_grid.SAMPLE
    assert len(scanner_grid.of_scanner(points, row, column, np.zeros(3))[0]) == len(points)


def test_position_in_the_project_file_is_used_to_recognise_a_grid(tmp_path):
    points, row, column = swept()
    at = np.array([40_005.0, -3.0, 1.0])  # so far that an origin is taken off
    write_e57(tmp_path / "a.e57", [columns_of(points + at, rowIndex=row, columnIndex=column)])
    assert not len(folder.read_input(tmp_path).scans[0].grid_row)
    (tmp_path / "project.toml").write_text("[[scan]]\nfile = 'a.e57'\nposition = [40005, -3, 1]\n")
    assert numbers(folder.read_input(tmp_path).scans[0]) == (row.tolist(), column.tolist())


# --- round trips -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def room():
    scans = stitch_clouds.four(step_mrad=16.0)[1][:2]
    # Some rays of each scan do not come back, those of its first columns among them.
    rng = np.random.default_rng(4)
    kept = [np.flatnonzero((rng.random(len(s.points)) > 0.05) & (s.grid_column > 2)) for s in scans]
    return [dataclasses.replace(reordered(s, k), position=np.zeros(3)) for s, k in zip(scans, kept, strict=True)]


def test_e57_brings_the_grid_back(room, tmp_path):
    for spherical in (False, True):
        e57.write(tmp_path / "a.e57", [*map(of_scan, room)], spherical=spherical)
        for ours, theirs in zip(room, folder.read_input(tmp_path / "a.e57").scans, strict=True):
            np.testing.assert_array_equal(theirs.grid_row, ours.grid_row)
            np.testing.assert_array_equal(theirs.grid_column, ours.grid_column)


def test_ptx_brings_the_grid_back(room, tmp_path):
    for ours in room:
        formats.write_ptx(tmp_path / "a.ptx", ours, None)
        (theirs,) = folder.read_input(tmp_path / "a.ptx").scans
        order = np.lexsort((ours.grid_row, ours.grid_column))
        np.testing.assert_allclose(theirs.points, ours.points[order], atol=1e-4)  # it has seven decimals of a metre
        # The file begins with the first row and column that have a return.
        np.testing.assert_array_equal(theirs.grid_row, (ours.grid_row - ours.grid_row.min())[order])
        np.testing.assert_array_equal(theirs.grid_column, (ours.grid_column - ours.grid_column.min())[order])


def test_a_merged_cloud_has_no_grid_in_e57(tmp_path):
    _, out = exported(merged(np.zeros(3)), tmp_path, "e57")
    (raw,) = readers.read(out / "scans/scan.e57")
    assert not len(raw.grid_row)


def test_stitching_finds_the_same_ends_in_files_as_in_the_scene(room, tmp_path):
    ours = room[0]
    formats.write_ptx(tmp_path / "a.ptx", ours, None)
    e57.write(tmp_path / "b.e57", [of_scan(ours)], spherical=False)
    expected = scan_planes.extract(ours, 200.0)
    assert len(expected.ends.points) > 100
    for path in (tmp_path / "a.ptx", tmp_path / "b.e57"):
        (theirs,) = folder.read_input(path).scans
        found = scan_planes.extract(dataclasses.replace(theirs, sigma_mm=2.0), 200.0)
        want, got = expected.ends.points, found.ends.points
        assert abs(len(want) - len(got)) <= 3  # PTX rounds, and some points lie at a limit
        # Three of more than 100 ends, which are metres apart, come or go.
        np.testing.assert_allclose(got.mean(axis=0), want.mean(axis=0), atol=1.0)
