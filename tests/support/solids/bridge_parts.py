"""Meshes of the parts of a hollow box bridge, in closed form and with numpy alone.

Its four outer edges are curves over x; skew and leaning planes cut them. Nothing is shared with designgen.
"""

import numpy as np
from scipy.optimize import brentq

SPAN, RISE = 30_000.0, 5_000.0
TOP, BOTTOM, WEB = 22.0, 26.0, 18.0  # plates
ROWS = 60


def soffit(x):
    """Height of the soffit: a cosine arch."""
    return RISE * np.cos(np.pi * (x / SPAN - 0.5))


def edge(corner, x, inner=False):
    """Points (..., 3) at ``x`` (...) on the edge 0..3 (bottom-left, bottom-right, top-right, top-left); or inside."""
    half = 430.0 + 210.0 * abs(2.0 * x / SPAN - 1.0) ** 1.5
    high = 980.0 + 350.0 * (2.0 * x / SPAN - 1.0) ** 2
    if corner in (2, 3):
        half *= 0.93  # inclined webs
    low = BOTTOM if inner else 0.0
    up = high - (TOP if inner else 0.0)
    y = (half - (WEB if inner else 0.0)) * (1.0 if corner in (0, 3) else -1.0)
    return np.stack([x, y, soffit(x) + (low if corner < 2 else up)], axis=-1)


def cutting_planes(parts, seed):
    """Point and unit normal of each cut, the ends of the bridge among them: skew by some degrees and leaning."""
    rng = np.random.default_rng(seed)
    stations = np.linspace(0.02, 0.98, parts + 1) * SPAN
    stations[1:-1] += rng.uniform(-0.2, 0.2, parts - 1) * SPAN / parts
    planes = []
    for x in stations:
        slope = -RISE * np.pi / SPAN * np.sin(np.pi * (x / SPAN - 0.5))
        lean, skew = np.arctan(slope) + rng.uniform(-0.06, 0.06), rng.uniform(-0.12, 0.12)
        normal = np.array([np.cos(lean) * np.cos(skew), np.cos(lean) * np.sin(skew), np.sin(lean)])
        planes.append((np.array([x, 0.0, soffit(x)]), normal))
    return planes


def crossing(corner, point, normal, inner=False):
    """x at which an edge crosses a plane."""
    return brentq(lambda x: (edge(corner, x, inner) - point) @ normal, point[0] - 1500, point[0] + 1500, xtol=1e-10)


def section(point, normal):
    """P1..P8 (8, 3) in a plane."""
    four = np.array([edge(k, crossing(k, point, normal)) for k in range(4)])
    return np.vstack([four, 0.5 * (four + np.roll(four, -1, axis=0))])


def part(start, end, rows=ROWS):
    """Vertices and triangles of a part between two planes (point, normal)."""
    vertices, faces = [], []
    for inner in (False, True):
        ends = [[crossing(k, *plane, inner) for plane in (start, end)] for k in range(4)]
        loops = [edge(k, x, inner) for k, x in enumerate(np.linspace(*np.transpose(ends), rows).T)]
        first = 4 * rows * inner
        vertices.append(np.stack(loops, axis=1).reshape(-1, 3))
        for i in range(rows - 1):
            for k in range(4):
                a, b = first + 4 * i + k, first + 4 * i + (k + 1) % 4
                faces += [(a, b + 4, b), (a, a + 4, b + 4)] if inner else [(a, b, b + 4), (a, b + 4, a + 4)]
    for i, turned in ((0, False), (rows - 1, True)):
        for k in range(4):
            a, b = 4 * i + k, 4 * i + (k + 1) % 4
            quad = [(a, a + 4 * rows, b), (b, a + 4 * rows, b + 4 * rows)]
            faces += [face[::-1] for face in quad] if turned else quad
    return np.concatenate(vertices), np.array(faces)


def bridge(parts=5, seed=0, gap=0.0):
    """Meshes of the parts, and P1..P8 (parts - 1, 8, 3) midway between the ends at each joint, ``gap`` mm apart."""
    planes = cutting_planes(parts, seed)
    moved = [[(point + side * 0.5 * gap * normal, normal) for point, normal in planes] for side in (1, -1)]
    meshes = [part(moved[0][k], moved[1][k + 1]) for k in range(parts)]
    joints = [0.5 * (section(*moved[0][k]) + section(*moved[1][k])) for k in range(1, parts)]
    return meshes, np.array(joints)


def names(parts):
    """foot1, rib1, ..., foot2."""
    return ["foot1", *(f"rib{k}" for k in range(1, parts - 1)), "foot2"]


def write_obj(path, vertices, faces):
    """Write a mesh as OBJ, with all digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = ["v " + " ".join(map(repr, map(float, point))) for point in vertices]
    path.write_text("\n".join([*rows, *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces)]) + "\n", "utf-8")


def write_stl(path, vertices, faces):
    """Write a mesh as binary STL, in single precision."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.zeros(len(faces), np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")]))
    rows["corners"] = vertices[faces]
    path.write_bytes(bytes(80) + np.uint32(len(faces)).tobytes() + rows.tobytes())
