"""Records of fitted spheres, and the argument tuples of the compiled fits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from processor.model import Checked, Floats, Ints, Reason, column, described, reasons, words
from processor.space_frame.result import Evidence, Flag

OF_ALL = 5  # first columns of shared changes: a shift along three axes, an offset of ranges, a wide beam
AMBIGUOUS = 14.0  # in chi-square: below it the runner-up's size is more than a thousandth as likely
POINTS, CELLS, STATIONS, RMS, SCALE, DEGREES, CENTRE_CHI2, FITTED = range(8)  # columns of ``Fits.numbers``


class Masks(NamedTuple):
    """Where spheres' own surfaces cannot be seen: member ends of node i are rows ``start[i]`` to ``start[i + 1]``."""

    start: Ints  # (k + 1,)
    axis_points: Floats  # (m, 3) on the axis, relative to the node, mm
    axes: Floats  # (m, 3) unit vectors away from the node
    keep_off: Floats  # (m,) distance from the axis within which sleeves and flats hide the sphere, mm
    tube_off: Floats  # (m,) the same of the member's tube
    hole: float  # radius of the cap about the lowest point that the process hole takes, mm
    least_cosine: float  # of incidence

    def of_nodes(self, nodes: slice) -> Masks:
        """Return the masks of some nodes."""
        start = self.start[nodes.start : nodes.stop + 1]
        ends = slice(start[0], start[-1])
        return self._replace(
            start=start - start[0],
            axis_points=self.axis_points[ends],
            axes=self.axes[ends],
            keep_off=self.keep_off[ends],
            tube_off=self.tube_off[ends],
        )


class StochasticModel(NamedTuple):
    """Parts (3,) of a range's variance, mm^2, and the covariance (s, 3, 3) of each station's unknown shift."""

    noise: Floats
    shift_covariance: Floats


class Sizes(NamedTuple):
    """What is tried for k nodes: a catalogue's sizes, and the priors of centre and size."""

    sizes: Floats  # (m,) radii, mm
    weight: float  # 1 / variance of a radius about its size; 0 where radii are free
    nominal: Floats  # (k,) nominal radii, NaN = none
    other_size_penalty: float  # by which the energy of a size other than the nominal one is raised
    free: bool  # radii are free: sizes are starts only
    centre_weight: Floats  # (k, 3, 3) inverse covariances of the nodes


class SizeChoice(NamedTuple):
    """Of k nodes the best state (x, y, z, r), its size and energy, and size and energy of the runner-up."""

    states: Floats
    sizes: Floats
    energy: Floats
    second: Floats
    second_energy: Floats


class Priors(NamedTuple):
    """Priors of k fits: inverse covariances (k, 3, 3) of centres, sizes (k,) and their weights (k,)."""

    centre_weight: Floats
    sizes: Floats
    size_weights: Floats


class Residuals(NamedTuple):
    """Of n gathered points the residual (corrected for leverage, mm), cosine of incidence and robust weight."""

    errors: Floats
    cosines: Floats
    weights: Floats


class Finished(NamedTuple):
    """Output of the final fit of k nodes; columns of ``numbers`` (k, 8) are named at the top of this module."""

    states: Floats
    covariances: Floats
    bounds: Floats
    numbers: Floats
    residuals: Residuals


@dataclass(frozen=True)
class Fits:
    """Results of the compiled fits of k nodes: states (x, y, z, r) relative to the node's position, mm."""

    states: Floats
    covariance: Floats
    bound: Floats
    sizes: Floats
    energy: Floats
    second: Floats
    second_energy: Floats
    numbers: Floats  # (k, 8)

    @property
    def fitted(self) -> npt.NDArray[np.bool_]:
        """Whether each node (k,) has a fit."""
        converged: npt.NDArray[np.bool_] = np.asarray(self.numbers[:, FITTED] > 0)
        return converged

    @property
    def margin(self) -> Floats:
        """Energy (k,) by which the runner-up loses; infinite without one."""
        with np.errstate(invalid="ignore"):
            margin: Floats = np.where(np.isfinite(self.energy), self.second_energy - self.energy, 0.0)
        return margin

    @property
    def clear(self) -> npt.NDArray[np.bool_]:
        """Spheres (k,) that are well seen and of no doubtful size."""
        return self.fitted & (self.numbers[:, POINTS] >= 30) & (self.margin > AMBIGUOUS)

    @property
    def final_size(self) -> npt.NDArray[np.bool_]:
        """Spheres (k,) whose size no better estimate of the noise will change."""
        return self.clear & (self.margin > 5.0 * AMBIGUOUS)


@dataclass(frozen=True)
class ViewErrors:
    """Errors of k spheres by errors of views: covariances (k, 4, 4) of states, mm^2.

    ``shared`` (k, 4, q) are the changes of states by standard normal variates that spheres have in common: their
    products are part of the covariances. ``sd`` is that of a displacement along the normal, mm, and ``common_sd`` its
    part common to all spheres. ``offset_sd`` is that of an offset of all ranges, mm. ``seen`` are the points used of
    all spheres in each of the cells of normals.
    """

    covariance: Floats
    shared: Floats
    sd: float
    common_sd: float
    offset_sd: float
    seen: Floats

    @property
    def of_all(self) -> Floats:
        """Covariances (k, 4, 4) by the shift of all views, the offset of all ranges and the width of the beam."""
        shared = self.shared[:, :, :OF_ALL]
        return shared @ np.swapaxes(shared, 1, 2)


@dataclass(frozen=True)
class Spheres(Checked):
    """Spheres at k nodes, mm: centres relative to the source's origin.

    ``covariance`` is of x, y, z and radius. ``bound`` is the least covariance of any unbiased estimate from these
    points and priors (Cramér and Rao), the stations being fixed; ``efficiency_*`` is the bound's standard deviation
    over the stated one. ``reasons`` are those of each sphere, ``messages`` those of all.
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
    scale: Floats = column("k")  # of the residuals, over the noise model of all spheres
    sizes: Floats = column("k")  # of the catalogue; NaN = none
    second_sizes: Floats = column("k")
    margin: Floats = column("k")  # energy by which the second size loses
    nominal: Floats = column("k")  # nominal radii given, NaN = none
    evidence: tuple[Evidence, ...] = words("k", Evidence)
    flag: tuple[Flag, ...] = words("k", Flag)
    reasons: tuple[tuple[Reason, ...], ...] = reasons("k")
    noise: Floats = column(3)  # variance of a range: constant, by range^2 / cosine, by tangent^2
    radius_sd: float = float("nan")  # scatter of radii about their sizes
    station_sd: float = float("nan")  # of each station's place along each axis, from the spheres; NaN = it was given
    messages: tuple[Reason, ...] = described((), reasons="")
    views: ViewErrors | None = None  # where a merged cloud does not name its views
