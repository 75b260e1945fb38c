"""Read what ``processor run`` wrote, with the json and h5py modules alone.

    python examples/read_results.py RESULTS

results.json holds the answers by name, results.h5 the same records as arrays of full precision. The latter opens in
MATLAB, Julia, HDFView and all that reads HDF5.
"""

import json
import sys
from pathlib import Path

import h5py


def main(folder: Path) -> None:
    """Print the steps, the balls where there are any, and every array of results.h5."""
    results = json.loads((folder / "results.json").read_text("utf-8"))
    print(f"{results['input']}, read as {results['units']['read_as']}; lengths in {results['units']['written_as']}")
    for name, step in results["steps"].items():
        print(f"step {name}: {step['status']}, method {step['method']}")
    for ball in results["steps"].get("spheres", {}).get("balls", []):
        x, y, z = ball["centre"]
        print(f"  ball {ball['id']}: {x:.2f} {y:.2f} {z:.2f}, radius {ball['radius']:.2f}, {ball['flag']}")

    with h5py.File(folder / "results.h5") as file:
        print(f"results.h5, format {file.attrs['format_version'].decode()}")
        for number, run in file["results"].items():  # one group for each step and method that was run
            print(f"  {number}: step {run['step'][()].decode()}, method {run['method'][()].decode()}")
            run["result"].visititems(show)


def show(name: str, item: h5py.Dataset | h5py.Group) -> None:
    """Print the name, shape and type of an array; tables such as ``balls`` are groups of columns."""
    if isinstance(item, h5py.Dataset) and item.shape:
        print(f"    {name} {item.shape} {item.dtype}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
