"""Records of fitted balls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from processor.model import Checked, Floats, Ints, column, names

AMBIGUOUS = 14.0  # in chi-square: below it the runner-up's size is more than a thousandth as likely


@dataclass(frozen=True)
class Fits:
    """What the compiled fits say of k nodes: states (x, y, z, r) less the node's position, mm.

    ``numbers`` (k, 8): points, cells, stations, rms, scale about the noise model, degrees of freedom, chi-square of the
    centre's prior, whether it fitted.
    """

    states: Floats
    covariance: Floats
    bound: Floats
    sizes: Floats
    energy: Floats
    second: Floats
    second_energy: Floats
    numbers: Floats

    @property
    def margin(self) -> Floats:
        """Energy (k,) by which the runner-up loses; infinite without one."""
        with np.errstate(invalid="ignore"):
            found: Floats = np.where(np.isfinite(self.energy), self.second_energy - self.energy, 0.0)
        return found

    @property
    def beyond_doubt(self) -> npt.NDArray[np.bool_]:
        """Balls (k,) whose size no better knowledge of the noise will change."""
        found: npt.NDArray[np.bool_] = self.clear & (self.margin > 5.0 * AMBIGUOUS)
        return found

    @property
    def clear(self) -> npt.NDArray[np.bool_]:
        """Balls (k,) that are well seen and of no doubtful size."""
        found: npt.NDArray[np.bool_] = (self.numbers[:, 7] > 0) & (self.numbers[:, 0] >= 30) & (self.margin > AMBIGUOUS)
        return found


@dataclass(frozen=True)
class Balls(Checked):
    """Balls at k nodes, mm: centres less the source's origin.

    ``covariance`` is of x, y, z and radius. ``bound`` is the least covariance that any unbiased estimate from these
    points and priors may have (Cramér and Rao), the stations standing still; ``efficiency_*`` is the bound's standard
    deviation over the stated one. ``evidence``: ball (its points alone) | fused (with the axes) | axes (no points).
    """

    centres: Floats = column("k", 3)
    radii: Floats = column("k")
    lowest: Floats = column("k", 3)
    covariance: Floats = column("k", 4, 4)
    lowest_sd: Floats = column("k")
    bound: Floats = column("k", 4, 4)
    bound_lowest_sd: Floats = column("k")
    efficiency_centre: Floats = column("k")
    efficiency_radius: Floats = column("k")
    efficiency_lowest: Floats = column("k")
    points: Ints = column("k", dtype=np.int64)
    visible_fraction: Floats = column("k")
    stations: Ints = column("k", dtype=np.int64)
    axes: Ints = column("k", dtype=np.int64)
    rms: Floats = column("k")
    scale: Floats = column("k")  # of the residuals, over what the noise of all balls says
    sizes: Floats = column("k")  # of the catalogue; NaN = none
    second_sizes: Floats = column("k")
    margin: Floats = column("k")  # energy by which the second size loses
    expected: Floats = column("k")  # nominal radii given, NaN = none
    evidence: tuple[str, ...] = names("k")
    flag: tuple[str, ...] = names("k")  # ok | low-confidence | wrong-size | not-found
    reason: tuple[str, ...] = names("k")
    noise: Floats = column(3)  # variance of a range: constant, by range^2 / cosine, by tangent^2
    radius_sd: float = float("nan")  # scatter of radii about their sizes
    station_sd: float = float(
        "nan"
    )  # of each station's place along each axis, as the balls show it; NaN = it was given
    message: str = ""
