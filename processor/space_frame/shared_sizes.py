"""Sizes that the balls of a frame share, estimated from their radii where no catalogue is stated.

Balls are made in few sizes, each for many nodes. Where the radii of many balls lie at places that neither the sizes of
a plausible catalogue nor an error common to all ranges explain, these places are the sizes.
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc

from processor.adjustment import scanner_class_errors
from processor.model import Floats
from processor.space_frame.ball_catalogue import DESIGNED, ESTIMATED, Catalogue

WELL_KNOWN = 0.5  # sd of a radius by its points, by the scatter of a size, up to which the ball shows its size
GAP = 4.0  # scatters of a size between neighbouring radii, beyond which they are of two sizes: 1 in 15,000 of one size
SHARED = 3  # balls of a size: two alike may both be wrong ones
UNLIKELY = 1e-3  # probability of the radii by the catalogue, below which their sizes are estimated


def estimated(radii: Floats, variances: Floats, catalogue: Catalogue, nominal: Floats) -> Catalogue | None:
    """Return the sizes that balls share; None where the sizes of a catalogue explain their radii.

    Where a design has sizes that the catalogue lacks and these explain the radii, they are the sizes, with those of
    balls that are of none of them: sizes of two catalogues are often too close to each other to be told apart.

    Parameters
    ----------
    radii, variances : (k,) of the balls by their points alone, mm and mm^2
    catalogue : sizes that balls may have; those of the design, ``nominal`` (k,), NaN = none, belong to them
    """
    sd = catalogue.sd_mm
    designed = np.unique(nominal[np.isfinite(nominal)])
    listed = np.isclose(designed[:, None], catalogue.radii).any(axis=1).all()
    known = np.sort(radii[np.isfinite(radii) & (variances < (WELL_KNOWN * sd) ** 2)])
    if not len(known):
        return None if listed else Catalogue(designed, sd, DESIGNED, True)
    groups = np.split(known, np.flatnonzero(np.diff(known) > GAP * sd) + 1)
    count = np.array([len(group) for group in groups])
    size = np.array([group.mean() for group in groups])
    shared = count >= SHARED
    if not listed and explained(size[shared], count[shared], designed, sd):
        other = np.abs(size[:, None] - designed).min(axis=1) > GAP * sd
        return Catalogue(np.union1d(designed, size[other]), sd, DESIGNED, True)
    if explained(size[shared], count[shared], np.union1d(catalogue.radii, designed), sd):
        return None
    return Catalogue(size, sd, ESTIMATED, False)


def explained(size: Floats, count: Floats, sizes: Floats, sd: float) -> bool:
    """Whether the means (g,) of groups of radii are those of given sizes, all off by one error of the ranges.

    The balls of one batch may be off their size together, by as much as radii scatter.
    """
    if not len(size):
        return True
    weight = 1.0 / (sd**2 * (1.0 + 1.0 / count))
    least, of_class = np.inf, scanner_class_errors.known().view_mm ** 2
    for start in (size[:, None] - sizes).ravel():  # each places a group at a size
        nearest = sizes[np.abs(size[:, None] - start - sizes).argmin(axis=1)]
        ratio = weight @ (size - nearest) / (1.0 + of_class * weight.sum())  # of the common error to its variance
        least = min(least, weight @ (size - of_class * ratio - nearest) ** 2 + of_class * ratio**2)
    return bool(chdtrc(len(size), least) > UNLIKELY)
