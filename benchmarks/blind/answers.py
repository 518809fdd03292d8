"""The baselines' fits as answers in the JSON of docs/diagnosis.md."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.blind.fitting import Data, Fit
from benchmarks.blind.onestep import Steps, Values
from benchmarks.blind.scoring import Answer, region_of
from visadapt.effects import EFFECTS
from visadapt.effects.catalogue import catalogue, twins
from visadapt.systems import SYSTEMS


def answer_of(data: Data, fits: Sequence[Fit], verdict: str) -> Answer:
    """The fit with the lowest BIC is the answer; probabilities go as exp(-BIC / 2); fits[0] is the source.

    `closed` is in sample and one step ahead, as these methods predict no further: the share of the root mean squared
    residual beyond the noise (1) that the fit removes.
    """
    ordered = sorted(fits, key=lambda f: f.bic)
    best, n = ordered[0], data.size
    weights = np.exp(-0.5 * np.array([f.bic - best.bic for f in ordered]))
    weights /= weights.sum()
    before, after = (float(np.sqrt(f.chi2 / n)) for f in (fits[0], best))
    causes: list[dict[str, Any]] = []
    if verdict == "identified":
        causes = [cause_of(e, best.values, best.deviations, data, float(weights[0])) for e in best.effects]
        if any(cause["indistinguishable_from"] for cause in causes):
            verdict = "ambiguous"
    return {
        "schema": 2,
        "system": data.system,
        "verdict": verdict,
        "where": {"regions": [region for cause in causes for region in _region(cause)]},
        "causes": causes,
        "ranking": [
            {"effects": f.effects, "probability": float(w), "gap_closed": None}
            for f, w in zip(ordered[:10], weights, strict=False)
        ],
        "gap": {
            "measure": "one-step residual over its noise, RMS, in sample",
            "before": before,
            "after": after,
            "floor": 1.0,
            "closed": (before - after) / (before - 1.0) if before > 1.0 else None,
        },
    }


def cause_of(effect: str, values: Values, deviations: Values, data: Data, probability: float) -> dict[str, Any]:
    """One cause; its intervals are 1.645 standard deviations to each side, and None where nothing was fitted."""
    own = {name.split(".")[1]: v for name, v in values.items() if name.startswith(f"{effect}.")}
    spread = {name.split(".")[1]: d for name, d in deviations.items() if name.startswith(f"{effect}.")}
    if effect == "periodic_force":
        # A cos(wt + phi) = A cos(phi) cos(wt) - A sin(phi) sin(wt).
        own["amplitude"], own["phase"] = (
            float(np.hypot(own["cosine"], own["sine"])),
            -float(np.arctan2(own["sine"], own["cosine"])),
        )
        spread["amplitude"] = max(spread.get("cosine", 0.0), spread.get("sine", 0.0))
    elif effect == "spring":
        own["rest"] = own["pull"] / own["stiffness"] if own["stiffness"] else 0.0
    elif effect == "dropout" and isinstance(data, Steps):
        own["rate"], spread["rate"] = data.rate, float(np.sqrt(data.rate * (1 - data.rate) / data.commands.size))
    elif effect == "frozen_zone" and isinstance(data, Steps):
        own["start"], own["end"] = data.zone or (0.0, 0.0)
    parameters: dict[str, Any] = {}
    for parameter in EFFECTS[effect].table:
        name = parameter.name
        interval = [own[name] - 1.645 * spread[name], own[name] + 1.645 * spread[name]] if name in spread else None
        parameters[name] = {"value": own[name], "unit": parameter.unit, "ci90": interval}
    system = SYSTEMS[data.system]()
    alike = [twin.name for twin in twins(EFFECTS[effect], catalogue(system), system)]
    return {
        "effect": effect,
        "parameters": parameters,
        "probability": probability / (1 + len(alike)),
        "gap_closed": None,
        "indistinguishable_from": alike,
    }


def _region(cause: dict[str, Any]) -> list[dict[str, Any]]:
    region = region_of(cause["effect"])
    if region is None:
        return []
    variable, *edges = region
    start, end = (cause["parameters"][name]["value"] for name in edges)
    return [{"variable": variable, "from": start, "to": end, "share": 1.0, "p_value": None}]
