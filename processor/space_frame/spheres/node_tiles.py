"""Size selection and final fit of many spheres: tiles of nodes, each with the points about them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from processor import tiles
from processor.model import Bools, Floats
from processor.space_frame.spheres import final_fit, size_selection
from processor.space_frame.spheres.records import (
    CropsWithRays,
    Finished,
    Masks,
    Priors,
    Residuals,
    SizeChoice,
    Sizes,
    StochasticModel,
)

NODES = 200  # of a tile


class _ToChoose(NamedTuple):
    """Arguments of :func:`size_selection.choose` for some nodes."""

    crops: CropsWithRays
    masks: Masks
    model: StochasticModel
    sizes: Sizes
    vote_half_width: float
    first_reach_mm: float
    wanted: Bools
    threads: int


def choose(
    crops: CropsWithRays,
    masks: Masks,
    model: StochasticModel,
    sizes: Sizes,
    reaches: tuple[float, float],
    wanted: Bools,
    threads: int = 0,
) -> SizeChoice:
    """Choose the size of each node's sphere; ``reaches`` are ``vote_half_width`` and ``first_reach_mm``, mm.

    See :func:`processor.space_frame.spheres.size_selection.choose`.
    """
    parts = tiles.mapped(
        _chosen,
        [
            _ToChoose(
                crops=_crops(crops, at),
                masks=_masks(masks, at),
                model=model,
                sizes=_sizes(sizes, at),
                vote_half_width=reaches[0],
                first_reach_mm=reaches[1],
                wanted=wanted[at],
                threads=threads,
            )
            for at in _nodes(len(wanted))
        ],
    )
    return SizeChoice(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _chosen(tile: _ToChoose) -> SizeChoice:
    return size_selection.choose(*tile)


def fit_final(nodes_to_fit: final_fit.NodesToFit) -> Finished:
    """Fit every node whose state is finite; see :func:`processor.space_frame.spheres.final_fit.fit_final`."""
    crops, nodes = nodes_to_fit.crops, _nodes(len(nodes_to_fit.states))
    parts = tiles.mapped(
        final_fit.fit_final,
        [
            nodes_to_fit._replace(
                crops=_crops(crops, at),
                masks=_masks(nodes_to_fit.masks, at),
                priors=Priors(*(column[at] for column in nodes_to_fit.priors)),
                states=nodes_to_fit.states[at],
            )
            for at in nodes
        ],
    )
    residuals = Residuals(*(np.empty(len(crops.points)) for _ in Residuals._fields))
    of_nodes = list[tuple[Floats, ...]]()
    for at, part in zip(nodes, parts, strict=True):
        for column, one in zip(residuals, part.residuals, strict=True):
            column[crops.start[at.start] : crops.start[at.stop]] = one
        of_nodes.append(part[:-1])
    states, covariances, bounds, numbers = (np.concatenate(column) for column in zip(*of_nodes, strict=True))
    return Finished(states, covariances, bounds, numbers, residuals)


def _nodes(count: int) -> list[slice]:
    """Return the nodes of each tile; one of none where there are none."""
    return tiles.ranges(count, NODES) or [slice(0, 0)]


def _crops(crops: CropsWithRays, nodes: slice) -> CropsWithRays:
    start = crops.start[nodes.start : nodes.stop + 1]
    rows = slice(start[0], start[-1])
    return CropsWithRays(
        start - start[0], crops.points[rows], crops.rays[rows], crops.ranges[rows], crops.station[rows]
    )


def _masks(masks: Masks, nodes: slice) -> Masks:
    start = masks.start[nodes.start : nodes.stop + 1]
    rows = slice(start[0], start[-1])
    return masks._replace(
        start=start - start[0],
        axis_points=masks.axis_points[rows],
        axes=masks.axes[rows],
        keep_off=masks.keep_off[rows],
        tube_off=masks.tube_off[rows],
    )


def _sizes(sizes: Sizes, nodes: slice) -> Sizes:
    return sizes._replace(nominal=sizes.nominal[nodes], centre_weight=sizes.centre_weight[nodes])
