"""What stitching answers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.model import Checked, Codes, Floats, Ints, column, names, newer

PRCS, GLCS = "PRCS", "GLCS"


@dataclass(frozen=True)
class Held(Checked):
    """What control points hold the scans by, a row a sighting; project's frame, mm. NaN = not placed, or not used."""

    points: tuple[str, ...] = names("c")
    scans: tuple[str, ...] = names("c")
    off: Floats = column("c", 3)  # known less seen place, once all is adjusted
    sd: Floats = column("c", 3)  # of it; where a sighting was left out, as the others predict it
    share: Floats = column("c")  # of an error of a sighting that shows in its residual; the rest goes into the poses
    used: Codes = column("c", dtype="uint8")  # type: ignore[arg-type]
    holds: int = 0  # 1 = the project's frame is theirs; 0 = too few, and it is the reference scan's
    redundancy: int = 0  # freedoms
    ratio: float = float("nan")  # squares of misfits by covariances, by the redundancy: 1 is usual
    loosened: float = 1.0  # standard deviations of control points were taken so many times as large


@dataclass(frozen=True)
class Result(Checked):
    """All scans in one frame, the project's. NaN = no answer.

    The project's frame is that of the reference scan (PRCS), or one given from outside (GLCS): that of the control
    points, or the one that scan's given pose leads to. Covariances: order (turn about x, y, z of the project's frame in
    rad; translation in mm), left perturbation T = exp(xi) T_project_scan, relative to the reference, which is held,
    unless control points hold all.
    """

    status: str  # ok | partial | failed
    method: str
    message: str = ""
    reference: str = ""
    # a row a scan
    scans: tuple[str, ...] = names("k")
    scan_status: tuple[str, ...] = names("k")  # ok | ambiguous | weak | failed
    scan_message: tuple[str, ...] = names("k")
    T_project_scan: Floats = column("k", 4, 4)
    covariance: Floats = column("k", 6, 6)
    position: Floats = column("k", 3)  # of the scanner, or of the middle of the points where it is not known; project
    position_sd: Floats = column("k", 3)
    rotation_sd: Floats = column("k", 3)  # rad, about the project's axes
    rivalry: Floats = column("k")  # score of the next best pose by the best one's
    T_rival_scan: Floats = column("k", 4, 4)
    # a row a pair
    pair_a: tuple[str, ...] = names("p")
    pair_b: tuple[str, ...] = names("p")
    overlap: Floats = column("p")  # share of both scans' faces that the other one sees too
    residual: Floats = column("p")  # rms, mm
    used: Codes = column("p", dtype="uint8")  # type: ignore[arg-type]
    pair_message: tuple[str, ...] = names("p")
    T_a_b: Floats = column("p", 4, 4)  # by the pair alone
    pair_covariance: Floats = column("p", 6, 6)  # in the frame of a
    pair_pieces: Ints = column("p", dtype="int64")  # type: ignore[arg-type]
    scale: Floats = column("p")  # three-point: of b in a; a diagnostic where six parameters were asked for
    scale_sd: Floats = column("p")
    # a row a loop; names joined by " > ", the first again at the end
    loops: tuple[str, ...] = names("l")
    closure_mm: Floats = column("l")
    closure_mrad: Floats = column("l")
    closure_ratio: Floats = column("l")  # by what the pairs' covariances let expect: chi-square by its 6 freedoms
    noise_mm: float = float("nan")  # of single points along the ray, as found
    patch_mm: float = float("nan")  # of what neighbouring points have in common, as found
    ends_share: float = float("nan")  # the same of ends of faces, by the standard deviation of a single one
    control: Held | None = newer()

    @property
    def by_control(self) -> bool:
        """Whether control points hold the frame."""
        return self.control is not None and bool(self.control.holds)

    @property
    def frame(self) -> str:
        """Name of the frame that T_project_scan leads to: PRCS, the reference scan's, or GLCS, given from outside."""
        given = self.reference in self.scans and not np.array_equal(self.reference_pose, np.eye(4))
        return GLCS if self.by_control or given else PRCS

    @property
    def reference_pose(self) -> Floats:
        """Pose (4, 4) of the reference scan, and so of PRCS, in the project's frame."""
        found: Floats = self.T_project_scan[self.scans.index(self.reference)]
        return found
