"""Places less the motion that fits them best: SciPy's rotation, apart from the processor's own fits."""

import numpy as np
from scipy.spatial.transform import Rotation


def without_motion(places, nominal, weight=None):
    """What is left of places (n, 2 or 3) less nominal ones after their best fit by a rotation and a shift."""
    middle, goal = (np.average(x, axis=0, weights=weight) for x in (places, nominal))
    source, target = ([*np.pad(x, ((0, 0), (0, 3 - x.shape[1])))] for x in (places - middle, nominal - goal))
    turn, _ = Rotation.align_vectors(target, source, weights=weight)
    return (turn.apply(source) - target)[:, : places.shape[1]]
