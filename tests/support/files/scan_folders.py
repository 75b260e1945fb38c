"""Scan folders of a bridge of two parts, written with numpy alone."""

import numpy as np

BOX = np.array([[x, y, z] for x in (0.0, 4.0) for y in (-0.4, 0.4) for z in (0.0, 0.9)])  # a part in metres

TRIANGLES = [[0, 1, 3], [0, 3, 2], [4, 5, 7], [4, 7, 6], [1, 0, 5], [2, 3, 7]]


def surface(seed=0, n=4_000):
    """Points on the box's long faces, metres."""
    points = np.random.default_rng(seed).uniform([0, -0.4, 0], [4, 0.4, 0.9], (n, 3))
    points[: n // 2, 1] = 0.4
    points[n // 2 :, 2] = 0.9
    return points


def write_xyz(path, points):
    path.parent.mkdir(exist_ok=True, parents=True)
    np.savetxt(path, points, fmt="%.6f")


def write_ply(path, vertices, faces=TRIANGLES):
    path.parent.mkdir(exist_ok=True, parents=True)
    rows = [" ".join(map(repr, map(float, row))) for row in vertices]
    rows += [" ".join(map(str, (len(face), *face))) for face in faces]
    axes = "".join(f"property double {axis}\n" for axis in "xyz")
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n{axes}element face {len(faces)}\n"
        "property list uchar int vertex_indices\nend_header\n" + "\n".join(rows) + "\n"
    )


def part(name, shift):
    edge = [[shift, 400, 0], [shift + 4000, 400, 0]]
    return {"mesh": f"design/{name}.ply", "bottom_edge_left": edge, "bottom_edge_right": edge}


def arch_design():
    points = {f"P{i}": [4000.0, 10.0 * i, 5.0] for i in range(1, 9)}
    return {
        "units": "mm",
        "kind": "arch-bridge",
        "order": ["foot1", "rib1"],
        "components": {"foot1": part("foot1", 0), "rib1": part("rib1", 4000)},
        "joints": [{"name": "J1", "left": "foot1", "right": "rib1", "points": points}],
    }
