"""Runs of one structure compared: each component over the epochs, and what their errors have in common."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from processor.epochs import change
from processor.epochs.change import Component, Finding
from processor.epochs.epoch import Epoch
from processor.epochs.quantity_series import Kind, Series
from processor.model import InputError, Reason, reason
from processor.pipeline import module_of, step_modules

BEYOND = (Finding.CHANGED, Finding.DOUBTFUL)


@dataclass(frozen=True, kw_only=True)
class History:
    """The epochs in the order of their days, the components, and what is common to the epochs."""

    name: str
    epochs: tuple[Epoch, ...]
    components: tuple[Component, ...]
    remarks: tuple[Reason, ...]

    def count(self, finding: Finding) -> int:
        """Return how many components have this finding; one that follows others does not count."""
        return sum(component.finding is finding and not component.follows for component in self.components)

    def of_kind(self, kind: Kind) -> list[Component]:
        """Return the components of a kind."""
        return [component for component in self.components if component.kind is kind]


def compare(epochs: Sequence[Epoch]) -> History:
    """Compare epochs, in the order of their days. Raises InputError where no component is in two of them."""
    components: list[Component] = []
    remarks = list(_common(epochs))
    others = np.array([epoch.facts.get("design") != epochs[0].facts.get("design") for epoch in epochs], np.bool_)
    for step in step_modules():
        results = [epoch.result(step) for epoch in epochs]
        module = module_of("epochs", step)  # none of stitch: places of scanners are others each time
        if module is None or sum(result is not None for result in results) < 2:
            continue
        by_name: dict[str, list[Series]] = {}
        for one in module.series(results):
            # Values by another design are doubtful
            doubtful = one.doubtful | others if module.BY_DESIGN else one.doubtful
            by_name.setdefault(one.component, []).append(replace(one, doubtful=doubtful))
        components += [change.of_component(step, name, of_it) for name, of_it in by_name.items()]
        remarks += module.remarks(results)
    if not components:
        raise InputError(
            f"{epochs[0].folder} and {epochs[-1].folder}: no step has results of one component in two runs; "
            "expected runs of one structure"
        )
    # Say of components that changed by the places of balls alone which balls these are: it is one movement. Where
    # something else changed too, that is the component's leading change.
    moved = {one.name for one in components if one.kind is Kind.BALL and one.finding in BEYOND}
    followed = tuple(_following(one, moved) if one.finding in BEYOND else one for one in components)
    return History(
        name=str(epochs[-1].facts.get("name", "")), epochs=tuple(epochs), components=followed,
        remarks=tuple(remarks),
    )  # fmt: skip


def _following(component: Component, moved: set[str]) -> Component:
    sure = [one for one in component.changes if one.surely]
    own = [one for one in sure if not moved.intersection(one.series.between)]
    if own:
        return replace(component, leading=change.leading([one for one in own if not one.doubtful] or own))
    balls = (ball for one in sure for ball in one.series.between if ball in moved)
    return replace(component, follows=tuple(dict.fromkeys(balls)))


def _common(epochs: Sequence[Epoch]) -> Iterator[Reason]:
    """Say what design, scanner and temperature of the epochs have in common."""
    designs = {epoch.facts.get("design", "") for epoch in epochs}
    if len(designs) > 1:
        yield reason("epochs.other-design")
    elif designs != {""}:
        yield reason("epochs.same-design")
    scanners = {(epoch.facts.get("scanner", ""), epoch.facts.get("serial", "")) for epoch in epochs}
    if any(not serial for _, serial in scanners):
        yield reason("epochs.scanner-unknown")
    elif len(scanners) == 1:
        yield reason("epochs.same-scanner")
    else:
        yield reason("epochs.other-scanners")
    warm = [float(epoch.facts.get("temperature_C", np.nan)) for epoch in epochs]
    if np.isnan(warm).any():
        yield reason("epochs.temperature-unknown")
    elif max(warm) - min(warm) > 0.0:
        yield reason("epochs.temperatures-differ", kelvin=max(warm) - min(warm))
