"""Texts of a scan folder that are valid TOML, JSON and CSV and impossible in what they mean."""

import copy
import json
import re

LONG = "n" * 200_000  # more than a cell of a table may have, 131,072
NAN, INF = float("nan"), float("inf")
NO_NUMBER = {"NaN": NAN, "infinite": INF, "minus infinite": -INF, "huge": 1e300, "text": "x", "list": [], "object": {}}
NO_SIZE = {**NO_NUMBER, "zero": 0.0, "negative": -0.05}
NO_TEXT = {"number": 5, "list": [], "object": {}, "long": LONG}
MIRRORED = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
SCALED = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
NO_POSE = {"mirrored": MIRRORED, "scaled": SCALED, "rows": MIRRORED[:3], "number": 1.0, "text": "x"}
DESIGN = {
    "nodes/2/id": {"twice": 0, "text": "x", "fraction": 1.5, "list": [], "NaN": NAN},
    "nodes/2/centre/0": NO_NUMBER,
    "nodes/2/centre": {"two numbers": [1.0, 2.0], "number": 1.0, "text": "x"},
    "nodes/2/centre/2": {"6,000,000 km": 6e9},
    "nodes/2/radius": {**NO_SIZE, "tiny": 1e-300},
    "nodes": {"none": [], "text": "x", "object": {}},
    "members/1/a": {"unknown": 99, "negative": -1, "itself": 2, "text": "x", "fraction": 1.5, "list": []},
    "members/1/b": {"unknown": 99, "itself": 1, "text": "x"},
    "members/1": {"a second time": {"a": 1, "b": 0, "tube_diameter": 0.06}},
    "members/1/tube_diameter": {**NO_SIZE, "as wide as a hall": 6.0, "four times as wide as its ball": 0.4},
    "members": {"text": "x", "object": {}, "number": 5},
    "units": {**NO_TEXT, "unknown": "parsec"},
    "kind": {**NO_TEXT, "unknown": "tower"},
}
STATIONS = {
    "S1/position/1": NO_NUMBER,
    "S1/position": {"two numbers": [1.0, 2.0], "text": "x"},
    "S1/pose": NO_POSE,
    "S1": {"number": 5, "text": "x", "list": []},
}
PROJECT = {
    "name": {"number": "5", "list": "[]", "long": f'"{LONG}"'},
    "kind": {"unknown": '"tower"', "number": "5", "empty": '""', "long": f'"{LONG}"'},
    "units": {"unknown": '"parsec"', "number": "5", "list": "[]", "long": f'"{LONG}"'},
    "design": {"none": '"none.json"', "outside": '"../design.json"', "absolute": '"/etc/passwd"', "number": "5"},
    "temperature_C": {"NaN": "nan", "infinite": "inf", "cold": "-300.0", "molten": "1e6", "text": '"x"', "list": "[]"},
    "file": {"none": '"none.xyz"', "outside": '"../a.xyz"', "absolute": '"/etc/passwd"', "number": "5"},
    "station": {"number": "5", "list": "[]", "long": f'"{LONG}"'},
    "sigma_mm": {"NaN": "nan", "infinite": "inf", "negative": "-1.0", "text": '"x"', "list": "[]", "tiny": "1e-300"},
    "position": {
        "two numbers": "[1.0, 2.0]",
        "NaN": "[nan, 0.0, 0.0]",
        "huge": "[1e300, 0.0, 0.0]",
        "text": '"x"',
        "1,000 km": "[1e6, 0.0, 0.0]",
    },
    "pose": {"mirrored": str(MIRRORED), "scaled": str(SCALED), "rows": str(MIRRORED[:3]), "number": "1.0"},
    "standard": {"unknown": '"none"', "number": "5"},
    "root_gap_mm": {"NaN": "nan", "infinite": "inf", "text": '"x"'},
}
CSV_NUMBER = {"NaN": "nan", "infinite": "inf", "huge": "1e300", "text": "x", "empty": ""}
CSV_NAME = {"empty": "", "long": LONG}
CONTROL = {
    "0/name": {**CSV_NAME, "twice": "T2"},
    **{f"0/{axis}": CSV_NUMBER for axis in "xyz"},
    "0/sd_mm": {**CSV_NUMBER, "negative": "-1", "zero": "0"},
    "2/name": {"unknown": "T9", "long": LONG},
    "2/scan": {"unknown": "z"},
    "2/z": CSV_NUMBER,
    "2/sd_mm": {"NaN": "nan", "infinite": "inf", "negative": "-1", "text": "x"},
}
PICKS = {
    "0/scan_a": {"unknown": "z", "itself": "b", "empty": ""},
    "0/scan_b": {"unknown": "z", "itself": "a", "empty": ""},
    "0/point": {"long": LONG},
    "0/xa": CSV_NUMBER,
    "0/zb": CSV_NUMBER,
}


MORE = {
    "design.json a key twice": ("design.json", '"units": "m",', '"units": "m", "units": "mm",', "units"),
    "stations.json a key twice": ("stations.json", '"S2"', '"S1"', "S1"),
    "project.toml a key of 20,000 parts": ("project.toml", "[tolerance]", f"{'a.' * 20_000}a = 1\n[tolerance]", "parts"),  # noqa: E501
    "project.toml a table of 20,000 parts": ("project.toml", "[tolerance]", f"[{'a . ' * 20_000}a]\n[tolerance]", "parts"),  # noqa: E501
    "project.toml 5,001 boxes": (
        "project.toml", "[tolerance]", "[[clip]]\nbox = [[0, 0, 0], [1, 1, 1]]\n" * 5_001 + "[tolerance]", "[[clip]]",
    ),
    "project.toml of 5 MB": ("project.toml", "[tolerance]", "# \n" * 1_700_000 + "[tolerance]", "bytes"),
    "design.json of 40 MB": ("design.json", '"m"', f'"m", "x": [{"[]," * 14_000_000}0]', "bytes"),
    "design.json 100,001 nodes": (
        "design.json", '"nodes": [', '"nodes": [' + "".join(
            f'{{"id": {k}, "centre": [0, 0, 0], "radius": 0.05}},' for k in range(10, 100_011)
        ), "ids",
    ),
}  # fmt: skip


def _in_json(text, path, value):
    content = json.loads(text)
    place = content
    *above, last = path.split("/")
    for key in above:
        place = place[int(key) if isinstance(place, list) else key]
    place[int(last) if isinstance(place, list) else last] = copy.deepcopy(value)
    return json.dumps(content)


def _in_toml(text, key, value):
    changed, count = re.subn(rf"^{key} = .*$", lambda _: f"{key} = {value}", text, count=1, flags=re.MULTILINE)
    assert count == 1, key
    return changed


def _in_csv(text, path, value):
    row, column = path.split("/")
    lines = text.splitlines()
    cells = lines[1 + int(row)].split(",")
    cells[lines[0].split(",").index(column)] = value
    return "\n".join([*lines[: 1 + int(row)], ",".join(cells), *lines[2 + int(row) :]]) + "\n"


def impossible_texts(files):
    """Yield the name of each case, the file, its text, and the field and the value, one of which the error names."""
    for name, (file, old, new, named) in MORE.items():
        assert old in files[file], name
        yield name, file, files[file].replace(old, new, 1), (named,)
    for file, fields, change in (
        ("design.json", DESIGN, _in_json),
        ("stations.json", STATIONS, _in_json),
        ("project.toml", PROJECT, _in_toml),
        ("control.csv", CONTROL, _in_csv),
        ("picks.csv", PICKS, _in_csv),
    ):
        for path, values in fields.items():
            field = [part for part in path.split("/") if not part.isdigit()][-1]
            for name, value in values.items():
                yield (
                    f"{file} {path}: {name}",
                    file,
                    change(files[file], path, value),
                    (field, str(value)[:20].strip('"')),
                )
