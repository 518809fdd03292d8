"""What the diagnosis says of rotorpy's multirotor, beside what rotorpy publishes.

    python -m benchmarks.rotorpy_diagnosis

Needs the extra `rotorpy` (pip install 'visadapt[rotorpy]'). The policy of the source flies it in four kinds of air,
ten flights of 100 samples each, with a little noise on its commands, as the counted samples of an adaptation have it.
The states are given the measurement noise of the sealed check of flights (`datasets/blind/flights.py`). In order:

    1. `visadapt.diagnose` with the source's parameters and the whole catalogue of the quadrotor: the verdict, the most
       probable set, and the gap that it closes
    2. the same search among the effects alone that rotorpy's model is made of (`KNOWN`): how large they are, since an
       answer that something stays unexplained tells no sizes

Recordings and answers are kept in `out`, so started again it goes on; recordings may also be given to
`visadapt diagnose --system quadrotor --params <out>/source.toml`. Writes results/rotorpy_diagnosis.csv.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from datasets import quadrotor_references
from datasets.blind import flights as blind_flights
from experiments.endings import ends_in_one_line
from experiments.result_tables import write_csv
from experiments.rotorpy_published import published
from visadapt import diagnose
from visadapt.diagnosis.search.causes import Z_90
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects import MotorLag, RateDamping, RotorDrag, TranslationalLift, Wind
from visadapt.estimation.fit_states import posterior
from visadapt.policies import Policy
from visadapt.progress import reporting
from visadapt.recordings import Episode, load_recording, write_recording
from visadapt.setups.policy_file import load_policy
from visadapt.storage.run_folder import once, open_run
from visadapt.targets.rollout import run
from visadapt.targets.rotorpy import BREEZE, SOURCE, Air, RotorpyTarget
from visadapt.tasks.follow import Follow
from visadapt.weights import shipped
from visadapt.world import World

FLIGHTS = 10
EXPLORATION = 0.05
"""deviation of the noise on commands"""
STEADY = Air(steady=BREEZE.steady)
KINDS: dict[str, Air | None] = {"no air": None, "still air": Air(), "steady wind": STEADY, "gusty wind": BREEZE}
"""the air that is flown in; in none, motors and rate loop alone differ from the source"""

KNOWN = (RotorDrag, RateDamping, TranslationalLift, MotorLag, Wind)
"""what a reader of rotorpy's model would look for"""

MASS = float(SOURCE.mass)
FOUND: dict[str, tuple[str, float, tuple[tuple[str, str], ...]]] = {
    **{
        f"drag_{axis}": (
            "1/s",
            MASS,
            (("rotor_drag", f"coefficient_{axis}"), ("wind", "coefficient")),
        )
        for axis in "xyz"
    },
    **{f"damping_{axis}": ("1/s", 1.0, (("rate_damping", f"rate_{axis}"),)) for axis in "xyz"},
    "lift": ("1/m", MASS, (("translational_lift", "coefficient"),)),
    "lag": ("s", 1.0, (("motor_lag", "time_constant"),)),
    **{f"wind_{axis}": ("m/s", 1.0, (("wind", f"velocity_{axis}"),)) for axis in "xy"},
}
"""What rotorpy publishes, by the names of `published`: the unit, by what a parameter of ours is divided, and which
effects and parameters stand for it. Drags add."""


@dataclass(frozen=True)
class Settings:
    """What is flown and diagnosed, and where results go."""

    kinds: tuple[str, ...] = tuple(KINDS)
    seed: int = 7
    """of flights and noise"""
    out: Path = Path("runs/rotorpy_diagnosis")
    results: Path = Path("results/rotorpy_diagnosis.csv")


def main(settings: Settings) -> None:
    """Fly, diagnose and write the table."""
    torch.set_num_threads(1)
    task = Follow(quadrotor_references.ready()[1])
    policy = load_policy(shipped("quadrotor"))
    open_run(settings.out, {"seed": settings.seed, "flights": FLIGHTS})
    parameters = "".join(f"{name} = {value!r}\n" for name, value in asdict(SOURCE).items())
    (settings.out / "source.toml").write_text(f"[parameters]\n{parameters}")
    rows: list[dict[str, str]] = []
    for kind in settings.kinds:
        air = KINDS[kind]
        target = RotorpyTarget(task, air or Air(), aero=air is not None)
        path = settings.out / f"{kind.replace(' ', '-')}.h5"
        if not path.exists():
            record(target, policy, settings.seed, path)
        answer = once(path.with_suffix(".json"), partial(asked, path))
        sizes = once(path.with_suffix(".sizes.json"), partial(sized, path))
        true = published(target)
        rows += rows_of(kind, answer, sizes, true if air is not None else {"lag": true["lag"]})
    write_csv(settings.results, list(rows[0]), rows)
    for row in rows:
        print(f"{row['air']:12} {row['what']:12} {row['value']} {row['unit']}  rotorpy: {row['published']}")


def record(target: RotorpyTarget, policy: Policy, seed: int, path: Path) -> None:
    """Flights as sensors read them."""
    policy.eval()
    generator = torch.Generator().manual_seed(seed)
    flown = run(target, policy, FLIGHTS, target.task.steps, generator, EXPLORATION)
    rng = np.random.default_rng(seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_recording(path, [_read(each.episode, rng) for each in flown], *_names())


def _read(episode: Episode, rng: np.random.Generator) -> Episode:
    assert episode.state is not None
    noise = rng.normal(size=episode.state.shape) * blind_flights.NOISE
    return replace(episode, state=(episode.state + noise).astype(np.float32))


def _names() -> tuple[list[str], list[str]]:
    return [variable.name for variable in SOURCE.states], [variable.name for variable in SOURCE.actions]


def asked(path: Path) -> dict[str, Any]:
    """What the command `visadapt diagnose` answers of a recording."""
    recording = load_recording([path], SOURCE)
    with reporting() as report:
        return diagnose(recording, World(SOURCE, period=recording.period), progress=report).to_json()


def sized(path: Path) -> dict[str, Any]:
    """The most probable set of KNOWN: parameters by effect, each with its value and 90 % interval."""
    recording = load_recording([path], SOURCE)
    with torch.inference_mode():
        search = Search(SOURCE, prepare(recording, SOURCE).rows, KNOWN)
        search.run()
        best = search.best
        spread = torch.linalg.inv(posterior(best.effects, best.fits)[1]).diagonal().sqrt().tolist()
    names = [(effect.name, parameter.name) for effect in best.effects for parameter in effect.table]
    out: dict[str, Any] = {name: {} for name in best.names}
    for (effect, name), value, deviation in zip(names, best.fits.theta[0].tolist(), spread, strict=True):
        out[effect][name] = {"value": value, "ci90": [value - Z_90 * deviation, value + Z_90 * deviation]}
    return out


def rows_of(
    kind: str, answer: Mapping[str, Any], sizes: Mapping[str, Any], true: Mapping[str, float]
) -> list[dict[str, str]]:
    """The answer, and each quantity that rotorpy publishes beside what was found."""
    rows = [
        _row(kind, "verdict", answer["verdict"]),
        _row(kind, "most probable", " + ".join(answer["ranking"][0]["effects"])),
        _row(kind, "gap closed", _number(answer["gap"]["closed"]), "1"),
    ]
    for what, (unit, divisor, places) in FOUND.items():
        own = [sizes[effect][name] for effect, name in places if effect in sizes]
        value = sum(one["value"] for one in own) / divisor if own else math.nan
        # Where several parameters add up to a quantity, none of their intervals is that of the sum.
        low, high = (_number(end / divisor) for end in own[0]["ci90"]) if len(own) == 1 else ("", "")
        found = _row(kind, what, _number(value), unit)
        rows.append({**found, "low": low, "high": high, "published": _number(true.get(what, 0.0))})
    return rows


def _row(kind: str, what: str, value: str, unit: str = "") -> dict[str, str]:
    return {"air": kind, "what": what, "value": value, "unit": unit, "low": "", "high": "", "published": ""}


def _number(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f"{value:.4g}"


if __name__ == "__main__":
    with ends_in_one_line("rotorpy_diagnosis"):
        main(tyro.cli(Settings, description=__doc__))
