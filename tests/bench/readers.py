"""Readers beside the libraries of their formats, and under damaged files.

    python -m tests.bench.readers --speed [--points 10000000] [--formats e57,las] --output bench-readers.json
    python -m tests.bench.readers --mutations 2000 [--formats e57,las] --output bench-mutations.json
    python -m tests.bench.readers --corpus FOLDER [--suffix .h5] --output bench-corpus.json

``--speed``: seconds to float64 coordinates and intensities, each in a process of its own with everything imported and
compiled, in turns, the least of three rounds or more, beside processor seconds (on a busy machine look at these); and
by how much the memory of the process and its helper rises at most (proportional set size) beside 24 bytes a point.
``--mutations``: damaged files of each format, always the same ones, each read in a watched process with 2 GB and 10 s;
exits 1 where one of them crashes, hangs, takes memory, raises anything but a plain error, or comes out empty.
``--corpus``: the same for all files of a folder, as of the HDF Group's own tests (``apt-get source hdf5``): none of
those is a scene, so that all are to be refused.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np

from tests.support.files.damaged_files import good_files
from tests.support.processes import watched_reading

ROUNDS, MOST_ROUNDS, ENOUGH_S = 3, 9, 20.0
LEAST_RATIO, MOST_MEMORY = 1.3, 2.5


# --- files ---------------------------------------------------------------------------------------------------------


def cloud(count):
    """Points as a scanner has them: by direction after direction, to a tenth of a millimetre."""
    k = np.arange(count)
    azimuth, elevation = 2e-3 * (k // 2_000), 7e-4 * (k % 2_000) - 0.6
    distance = 8.0 + 3.0 * np.sin(3.0 * azimuth) + np.random.default_rng(1).normal(0.0, 0.002, count)
    level = distance * np.cos(elevation)
    points = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)])
    return points.round(4), (k % 251).astype(np.uint8)


def write_e57(path, points, intensity):
    from processor.model import Scan
    from processor.writers import e57
    from processor.writers.cloud import of_scan

    e57.write(path, [of_scan(Scan("S1", points * 1_000.0, intensity=intensity.astype(float)))], spherical=False)


def write_las(path, points, intensity):
    import laspy

    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales, header.offsets = np.full(3, 1e-4), np.zeros(3)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.intensity = intensity
    las.write(str(path))


def write_ply(path, points, intensity):
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz") + "property uchar intensity\nend_header\n"
    rows = np.empty(len(points), [("p", "<f8", 3), ("i", "u1")])
    rows["p"], rows["i"] = points, intensity
    path.write_bytes(head.encode() + rows.tobytes())


def _pcd_head(count, data):
    return (
        "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {data}\n"
    ).encode()


def write_pcd(path, points, intensity):
    rows = np.column_stack([points, intensity]).astype("<f4")
    path.write_bytes(_pcd_head(len(points), "binary") + rows.tobytes())


def write_packed_pcd(path, points, intensity):
    import lzf

    columns = np.column_stack([points, intensity]).astype("<f4").T.tobytes()
    packed = lzf.compress(columns, 2 * len(columns))
    sizes = np.array([len(packed), len(columns)], "<u4").tobytes()
    path.write_bytes(_pcd_head(len(points), "binary_compressed") + sizes + packed)


def _table(file, points, intensity, separator=" "):
    import pandas

    for start in range(0, len(points), 1_000_000):
        frame = pandas.DataFrame(points[start : start + 1_000_000])
        if intensity is not None:
            frame[3] = intensity[start : start + 1_000_000] / 256.0
        frame.to_csv(file, sep=separator, header=False, index=False)


def write_xyz(path, points, _):
    with path.open("w", newline="\n") as file:
        _table(file, points, None)


def write_ptx(path, points, intensity):
    identity = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    with path.open("w", newline="\n") as file:
        file.write(f"{len(points) // 100}\n100\n{identity}")
        _table(file, points, intensity)


# --- peers: path -> coordinates and intensity; Open3D knows no intensity --------------------------------------------


def peer_pye57(path):
    import pye57

    return pye57.E57(str(path)).read_scan_raw(0)


def peer_laspy(path):
    import laspy

    las = laspy.read(str(path))
    return las.xyz, las.intensity.astype(np.float64)


def peer_plyfile(path):
    import plyfile

    vertex = plyfile.PlyData.read(str(path))["vertex"].data
    return np.stack([vertex[axis] for axis in "xyz"], axis=1), vertex["intensity"].astype(np.float64)


def peer_open3d(path):
    import open3d

    return np.asarray(open3d.io.read_point_cloud(str(path)).points)


def peer_pypcd4(path):
    import pypcd4

    return pypcd4.PointCloud.from_path(str(path)).numpy(("x", "y", "z", "intensity")).astype(np.float64)


def peer_pandas(path):
    import pandas

    skipped = 10 if path.suffix == ".ptx" else 0
    return pandas.read_csv(path, sep=" ", header=None, skiprows=skipped, dtype=np.float64).to_numpy()


FORMATS = {
    "e57": ("a.e57", write_e57, [peer_pye57]),
    "las": ("a.las", write_las, [peer_laspy]),
    "laz": ("a.laz", write_las, [peer_laspy]),
    "ply": ("a.ply", write_ply, [peer_plyfile, peer_open3d]),
    "pcd": ("a.pcd", write_pcd, [peer_pypcd4, peer_open3d]),
    "pcd-compressed": ("b.pcd", write_packed_pcd, [peer_pypcd4, peer_open3d]),
    "xyz": ("a.xyz", write_xyz, [peer_pandas, peer_open3d]),
    "ptx": ("a.ptx", write_ptx, [peer_pandas]),
}


# --- measuring, in a process of its own -----------------------------------------------------------------------------


def ours(path):
    from processor import readers

    return readers.read(path)


def _family():
    """Ids of this process and of those it started."""
    found = [Path("/proc/self").resolve().name]
    for one in found:
        for task in Path(f"/proc/{one}/task").glob("*/children"):
            found += task.read_text().split()
    return found


def _memory():
    total = 0
    for one in _family():
        try:
            lines = Path(f"/proc/{one}/smaps_rollup").read_text().splitlines()
            total += next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
        except (OSError, StopIteration):
            continue  # it ended meanwhile
    return 1024 * total


def _busy():
    """Processor seconds of this process and those it started, finished ones too."""
    total = 0
    for one in _family():
        try:
            total += sum(int(x) for x in Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split()[11:15])
        except OSError:
            continue
    return total / os.sysconf("SC_CLK_TCK")


def measure(what, path, warm, memory):
    """Print seconds and processor seconds of a read, or bytes that memory rises by."""
    function = globals()[what]
    if warm:
        function(Path(warm))  # imports, compiles, starts
    if not memory:
        began, busy = time.perf_counter(), _busy()
        kept = function(Path(path))
        print(time.perf_counter() - began, _busy() - busy)
        return
    before, peak, done = _memory(), [0], threading.Event()

    def watch():
        while not done.wait(0.02):
            peak[0] = max(peak[0], _memory())

    thread = threading.Thread(target=watch)
    thread.start()
    kept = function(Path(path))
    done.set()
    thread.join()
    print(max(peak[0], _memory()) - before)
    del kept


def _apart(what, path, warm, memory):
    command = [sys.executable, "-m", "tests.bench.readers", "--measure", what, str(path), str(warm)]
    done = subprocess.run(command + ["--memory"] * memory, check=True, capture_output=True, text=True)
    return [float(word) for word in done.stdout.split()]


def speed(count, formats):
    """Print and return seconds and memory of ours and of each peer."""
    points, intensity = cloud(count)
    found = {}
    print("format          ours s (busy)   best peer s (busy)             ratio (busy)  memory  passed", flush=True)
    for name in formats:
        file, write, peers = FORMATS[name]
        with tempfile.TemporaryDirectory() as folder:
            path, warm = Path(folder) / file, Path(folder) / f"warm{Path(file).suffix}"
            write(path, points, intensity)
            write(warm, points[:1_000], intensity[:1_000])
            took = {}
            began = time.monotonic()
            for done in range(MOST_ROUNDS):
                if done >= ROUNDS and time.monotonic() - began > ENOUGH_S:
                    break
                for one in ("ours", *(peer.__name__ for peer in peers)):
                    took.setdefault(one, []).append(_apart(one, path, warm, False))
            seconds = {one: np.min(all_, axis=0).tolist() for one, all_ in took.items()}
            best = min((one for one in seconds if one != "ours"), key=lambda one: seconds[one][0])
            memory = _apart("ours", path, warm, True)[0] / (24.0 * count)
            size = path.stat().st_size
        ratio, busy = (seconds["ours"][i] / seconds[best][i] for i in (0, 1))
        passed = ratio <= LEAST_RATIO and memory <= MOST_MEMORY
        found[name] = {"seconds": seconds, "ratio": ratio, "busy_ratio": busy, "memory": memory, "bytes": size}
        found[name]["passed"] = passed
        mine, theirs = (f"{seconds[one][0]:.2f} ({seconds[one][1]:.2f})" for one in ("ours", best))
        print(
            f"{name:<15} {mine:<15} {theirs + ' ' + best.removeprefix('peer_'):<30} "
            f"{ratio:5.2f} ({busy:.2f})  {memory:6.2f}  {passed}",
            flush=True,
        )
    return found


def watched(runs):
    """Print and return what became of files: ``runs`` are names and functions that read the files of each."""
    found = {}
    for name, run in runs.items():
        began = time.monotonic()
        counts, faults, slowest = run()
        found[name] = {"counts": dict(counts), "faults": faults, "slowest_s": slowest}
        said = ", ".join(f"{what} {n}" for what, n in sorted(counts.items()))
        print(f"{name:<6} {said}; slowest {slowest:.1f} s; {time.monotonic() - began:.0f} s in all", flush=True)
    return found


def main():
    """Run, print tables and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--speed", action="store_true")
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--mutations", type=int, default=0)
    parser.add_argument("--formats", default="")
    parser.add_argument("--corpus", type=Path)
    parser.add_argument("--suffix", default=".h5")
    parser.add_argument("--keep", type=Path, help="folder for the files that made trouble")
    parser.add_argument("--measure", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--memory", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        measure(*arguments.measure, arguments.memory)
        return
    asked = [one for one in arguments.formats.split(",") if one]
    found = {}
    if arguments.speed:
        found["speed"] = speed(arguments.points, asked or list(FORMATS))
    keep = arguments.keep
    if keep:
        keep.mkdir(parents=True, exist_ok=True)
    if arguments.mutations:
        names = asked or list(good_files())
        found["mutations"] = watched(
            {name: partial(watched_reading.run, name, arguments.mutations, keep, print) for name in names}
        )
    if arguments.corpus:
        corpus = partial(watched_reading.run_corpus, arguments.corpus, arguments.suffix, keep, print)
        found["corpus"] = watched({arguments.suffix: corpus})
    if arguments.output:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        arguments.output.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    slow = not all(one["passed"] for one in found.get("speed", {}).values())
    sys.exit(
        bool(slow or any(one["faults"] for what in ("mutations", "corpus") for one in found.get(what, {}).values()))
    )


if __name__ == "__main__":
    main()
