"""What results.json says of preassembly."""

from __future__ import annotations

from typing import Any

import numpy as np

from processor.model import ENDS, KEY_POINTS, NORMAL_95, Floats
from processor.preassembly import step as preassembly_step
from processor.preassembly.verdicts.joints import Verdict

TRADE_OFF = ("splicing_mean", "splicing_max", "linear_mean", "linear_max")


def written(result: preassembly_step.Result) -> dict[str, Any]:
    """Write a bridge put together."""
    found = {
        "status": result.status,
        "method": result.method,
        "message": result.message,
        "components": [
            {
                "name": name,
                "status": result.component_status[i],
                "message": result.component_message[i],
                "scans": result.component_scans[i] if result.component_scans else "",
                "T_bridge_scan": result.T_bridge_scan[i],
                "covariance": result.covariance[i],
                "key_points_scan": _ends(result.key_points_scan[i]),
                "key_points_sd": _ends(result.key_points_sd[i]),
            }
            for i, name in enumerate(result.components)
        ],
        "joints": [
            {
                "name": name,
                "left": result.joint_left[j],
                "right": result.joint_right[j],
                "points": {
                    key: {"gap": result.gaps[j, k], "ci95": result.gap_ci95[j, k]} for k, key in enumerate(KEY_POINTS)
                },
                "verdict": result.verdict[j],
            }
            for j, name in enumerate(result.joints)
        ],
        "splicing_error": {"mean": result.splicing_mean, "max": result.splicing_max, **_halves(result, 0)},
        "linear_error": {
            "mean": result.linear_mean,
            "max": result.linear_max,
            **_halves(result, 2),
            "gauge": result.gauge,
            "stations": result.linear_station,
            "edge": list(result.linear_edge),
            "deviation": result.linear_deviation,
            "ci95": result.linear_ci95,
            "foot1_best_fit": {
                "mean": result.best_fit_linear_mean,
                "max": result.best_fit_linear_max,
                **_halves(result, 4),
                "deviation": result.best_fit_linear_deviation,
                "ci95": result.best_fit_linear_ci95,
            },
        },
        "trade_off": [
            {"lambda": weight, **dict(zip(TRADE_OFF, figures, strict=True))}
            for weight, figures in zip(result.trade_lambda, result.trade_figures, strict=True)
        ],
    }
    return found | _adjusted(result) if result.measures else found


def _adjusted(result: preassembly_step.Result) -> dict[str, Any]:
    """Write what the adjustment alone says; the records of measures, verdicts and proposals as they are."""
    judged = []
    for joint, measures, verdict, proposal in zip(
        result.joints, result.measures, result.judged, result.proposals, strict=True
    ):
        rows = zip(
            measures.name, measures.value, measures.ci95, measures.low, measures.high, measures.unit, strict=True
        )
        half = NORMAL_95 * np.sqrt(np.maximum(np.diag(measures.covariance), 0.0)).reshape(8, 3)
        judged.append(
            {
                "name": joint,
                "gaps_joint_axes": dict(zip(KEY_POINTS, measures.gaps, strict=True)),
                "gaps_joint_axes_ci95": dict(zip(KEY_POINTS, half, strict=True)),
                "measures": {
                    name: {"value": value, "ci95": ci95, "low": low, "high": high, "unit": unit}
                    for name, value, ci95, low, high, unit in rows
                },
                "limits": _limits(verdict),
                "probability": verdict.probability,
                "proposal": {
                    "action": proposal.action,
                    "cut": dict(zip(KEY_POINTS, proposal.cut, strict=True)),
                    "build_up": dict(zip(KEY_POINTS, proposal.build_up, strict=True)),
                    "probability": proposal.probability,
                    "probability_as_is": proposal.probability_as_is,
                    "sentence": proposal.sentence,
                },
            }
        )
    ambiguous = [i for i in range(len(result.components)) if np.isfinite(result.T_rival_scan[i]).all()]
    return {
        "lambda": result.weight,
        "joint_measures": judged,
        "chain_limits": [
            {"verdict": one.verdict, "limits": _limits(one), "said": one.said} for one in result.chain_judged
        ],
        "limits_not_held": list(result.not_held),
        "span": {"departure": result.span_departure, "ci95": result.span_ci95},
        "closure": {
            "mm": result.closure[:3],
            "mrad": result.closure[3:],
            "ci95_mm": result.closure_ci95[:3],
            "ci95_mrad": result.closure_ci95[3:],
        },
        "linear_offset": {"left_up": result.linear_offset, "ci95": result.linear_offset_ci95},
        "ambiguous": {result.components[i]: {"T_rival_scan": result.T_rival_scan[i]} for i in ambiguous},
        "limiting": result.limiting,
        "advice": result.advice,
        "budget_sd": dict(zip(result.budget_source, result.budget_sd, strict=True)),
    }


def _limits(verdict: Verdict) -> list[dict[str, Any]]:
    """Write what was held against each limit."""
    keys = (
        "limit", "what", "value", "ci95", "low", "high", "verdict", "probability", "clause", "edition", "source",
    )  # fmt: skip
    rows = zip(
        verdict.key, verdict.what, verdict.value, verdict.ci95, verdict.low, verdict.high, verdict.each,
        verdict.each_probability, verdict.clause, verdict.edition, verdict.source, verdict.verified, strict=True,
    )  # fmt: skip
    return [{**dict(zip(keys, row[:-1], strict=True)), "verified": bool(row[-1])} for row in rows]


def _ends(points: Floats) -> dict[str, Any]:
    """Name the points (2, 8, 3) of both ends; an end without any is empty."""
    return {
        end: dict(zip(KEY_POINTS, points[i], strict=True)) if np.isfinite(points[i]).any() else {}
        for i, end in enumerate(ENDS)
    }


def _halves(result: preassembly_step.Result, first: int) -> dict[str, Any]:
    """Half-widths of a mean and a largest error, of a method that states them."""
    own = result.errors_ci95[first : first + 2]
    return dict(zip(("mean_ci95", "max_ci95"), own, strict=True)) if len(own) else {}
