"""Stitching in results.json, and its poses as a file that other programs read."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np

from processor.stitching.result import GLCS, Held, Result

POSES = "stitch.csv"


def written(result: Result) -> dict[str, Any]:
    """Write the result of step ``stitch``."""
    return {
        "status": result.status,
        "method": result.method,
        "message": result.message,
        "reference": result.reference,
        "scans": [
            {
                "name": name,
                "status": result.scan_status[i],
                "message": result.scan_message[i],
                "T_project_scan": result.T_project_scan[i],
                "covariance": result.covariance[i],
                "position": result.position[i],
                "position_sd": result.position_sd[i],
                "rotation_sd": result.rotation_sd[i],
                "rivalry": result.rivalry[i],
                "T_rival_scan": result.T_rival_scan[i] if np.isfinite(result.T_rival_scan[i]).all() else None,
                "from": f"SOCS({name})",
                "to": result.frame,
            }
            for i, name in enumerate(result.scans)
        ],
        "pairs": [
            {
                "a": a,
                "b": result.pair_b[i],
                "overlap": result.overlap[i],
                "residual": result.residual[i],
                "used": bool(result.used[i]),
                "message": result.pair_message[i],
                "shared": int(result.pair_pieces[i]),
                "T_a_b": result.T_a_b[i],
                "covariance": result.pair_covariance[i],
                "scale": result.scale[i],
                "scale_sd": result.scale_sd[i],
                "from": f"SOCS({result.pair_b[i]})",
                "to": f"SOCS({a})",
            }
            for i, a in enumerate(result.pair_a)
        ],
        "closures": [
            {
                "loop": loop.split(" > "),
                "mm": result.closure_mm[i],
                "mrad": result.closure_mrad[i],
                "ratio": result.closure_ratio[i],
            }
            for i, loop in enumerate(result.loops)
        ],
        "noise_mm": result.noise_mm,
        "patch_mm": result.patch_mm,
        "ends_share": result.ends_share,
        "frame": result.frame,
        **({"T_GLCS_PRCS": result.reference_pose} if result.frame == GLCS else {}),
        **({} if result.control is None else {"control": _control(result.control)}),
    }


def _control(held: Held) -> dict[str, Any]:
    return {
        "holds": bool(held.holds),
        "redundancy": held.redundancy,
        "ratio": held.ratio,
        "loosened": held.loosened,
        "sightings": [
            {
                "name": name,
                "scan": held.scans[i],
                "off": held.off[i],
                "sd": held.sd[i],
                "share": held.share[i],
                "used": bool(held.used[i]),
            }
            for i, name in enumerate(held.points)
        ],
    }


def poses(result: Result) -> bytes:
    """Write poses as CSV: a row a scan, the 4 x 4 matrix row by row, mm, and which frames it leads from and to."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["scan", "status", *(f"m{i}{j}" for i in range(4) for j in range(4)), "from", "to"])
    for name, status, T in zip(result.scans, result.scan_status, result.T_project_scan, strict=True):
        # A name that a spreadsheet would take for a formula gets an apostrophe.
        safe = f"'{name}" if name.startswith(("=", "+", "-", "@")) else name
        matrix = [repr(float(x)) if np.isfinite(x) else "" for x in T.ravel()]
        writer.writerow([safe, status, *matrix, f"SOCS({name})", result.frame])
    return out.getvalue().encode("utf-8")
