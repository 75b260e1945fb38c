"""Sightings of control points by bodies, which are scans or stations: residuals, derivatives, covariance.

A sighting compares the known place of a point with the place where a body saw it. Known places are observations too:
eliminated, they leave one equation a sighting, in which sightings of one point share the error of its known place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.model import Columns, Floats, Ints


@dataclass(frozen=True)
class Sightings(Columns):
    """Sightings of control points, a row per sighting; mm, along all axes alike.

    ``seen`` (m, 3) is in the frame of the ``body`` (m,) that saw it, ``known`` (m, 3) in that of the control points.
    Rows of one ``point`` (m,) share the known place and its error.
    """

    point: Ints
    body: Ints
    seen: Floats
    seen_sd: Floats
    known: Floats
    known_sd: Floats
    point_name: tuple[str, ...] = ()
    body_name: tuple[str, ...] = ()

    @property
    def covariance(self) -> Floats:
        """Covariance (3m, 3m) of known less seen places, without that of the bodies' poses."""
        shared = (self.point[:, None] == self.point) * np.outer(self.known_sd, self.known_sd)
        total: Floats = np.kron(shared + np.diag(self.seen_sd**2), np.eye(3))
        return total

    @property
    def places(self) -> Floats:
        """Known places (p, 3) of the points, each once."""
        return self.known[np.unique(self.point, return_index=True)[1]]

    def placed(self, T: Floats) -> Floats:
        """Return the seen places (m, 3) in the frame that the bodies' poses T (k, 4, 4) map to."""
        poses = T[self.body]
        placed: Floats = np.einsum("mij,mj->mi", poses[:, :3, :3], self.seen) + poses[:, :3, 3]
        return placed

    def derivative(self, arm: Floats, bodies: int, rays: Floats | None = None) -> Floats:
        """Return the derivative J (3m, 6k) of seen places by the motions of k ``bodies``, about their own origins.

        ``arm`` (m, 3) is from the origin of the body to what it saw. With unit ``rays`` (m, 3) J (3m, 7k) is by each
        body's range offset as well, which is subtracted from its ranges.
        """
        own = rigid.motion(arm) if rays is None else np.concatenate([rigid.motion(arm), -rays[:, :, None]], axis=2)
        J = np.zeros((len(arm), 3, bodies, own.shape[2]))
        J[np.arange(len(arm)), :, self.body] = own
        return J.reshape(3 * len(arm), -1)
