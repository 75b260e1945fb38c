"""How many joints or limits have which verdict, in words: "all 4 joints pass", "1 of 4 joints fails: J3"."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from processor.language.messages import Message, Text, label, text
from processor.model import Verdict

MOST_NAMED = 3  # of a headline, which is one line
JOINTS = {
    Verdict.PASS: "all {count} joints pass",
    Verdict.FAIL: "{part} of {count} {count:?joint|joints} {part:?fails|fail}: {named}",
    Verdict.INDETERMINATE: "{part} of {count} {count:?joint|joints} {part:?is|are} indeterminate: {named}",
}
LIMITS = {
    Verdict.PASS: "all {count} limits are kept",
    Verdict.FAIL: "{part} of {count} {count:?limit|limits} {part:?is|are} not kept: {named}",
    Verdict.INDETERMINATE: "{part} of {count} {count:?limit|limits} {part:?is|are} indeterminate: {named}",
}
SINGLE = {JOINTS[Verdict.PASS]: "the joint passes", LIMITS[Verdict.PASS]: "the limit is kept"}
EACH = {
    Verdict.PASS: text("{count} pass"),
    Verdict.FAIL: text("{count} fail"),
    Verdict.INDETERMINATE: text("{count} indeterminate"),
}
FURTHER = {Verdict.INDETERMINATE: "{part} indeterminate", Verdict.PASS: "{part} {part:?passes|pass}"}


def each(verdicts: Sequence[Verdict]) -> list[Text]:
    """Return how many of ``verdicts`` there are of each kind."""
    return [Text(said.template, {"count": count}) for one, said in EACH.items() if (count := verdicts.count(one))]


def summary(phrases: Mapping[Verdict, str], names: Sequence[str], verdicts: Sequence[Verdict]) -> Message:
    """Return how many of the things with ``names`` have which verdict, and the names of the worst.

    ``phrases`` are JOINTS or LIMITS. Things without a verdict are not counted among those that pass.
    """
    count = len(verdicts)
    rows = {one: [i for i, verdict in enumerate(verdicts) if verdict is one] for one in phrases}
    if count and len(rows[Verdict.PASS]) == count:
        return text(SINGLE[phrases[Verdict.PASS]] if count == 1 else phrases[Verdict.PASS], count=count)
    counted: list[Message] = []
    for verdict in (Verdict.FAIL, Verdict.INDETERMINATE, Verdict.PASS):
        if not rows[verdict]:
            continue
        if counted or verdict is Verdict.PASS:
            counted.append(text(FURTHER[verdict], part=len(rows[verdict])))
            continue
        named: list[Message] = [label(one) for one in dict.fromkeys(names[i] for i in rows[verdict])]
        if len(named) > MOST_NAMED:
            named = [*named[:MOST_NAMED], text("and {count} more", count=len(named) - MOST_NAMED)]
        counted.append(text(phrases[verdict], part=len(rows[verdict]), count=count, named=named))
    return text("{verdicts:;}", verdicts=counted or [text("none has a verdict")])
