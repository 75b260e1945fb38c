"""Attitudes of a bridge's parts by the truth: the search for them takes longer than most of what follows it."""

import numpy as np

from processor.geometry import rigid
from processor.model import Status
from processor.preassembly.parts import attitude
from processor.registration import pose_search


def attitude_of(points, part, T):
    """The attitude that the search would find: the best of the poses by principal axes, and the true one."""
    hypotheses = pose_search.by_principal_axes(points, attitude.sample_surface(part))
    turns = [rigid.rotation_angle(one[:3, :3] @ T[:3, :3].T) for one in hypotheses]
    return attitude.Attitude(hypotheses[int(np.argmin(turns))], T, Status.OK)


def find_by(truth, searched=""):
    """What stands for :func:`processor.preassembly.parts.attitude.find` for scans of a bridge with this truth.

    That of the part ``searched`` is searched for.
    """
    poses, search = dict(zip(truth.arch.names, truth.arch.T_bridge_scan, strict=True)), attitude.find

    def find(points, part, surface=None):
        return search(points, part, surface) if part.name == searched else attitude_of(points, part, poses[part.name])

    return find
