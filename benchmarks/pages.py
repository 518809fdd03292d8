"""Writes what the pages take from elsewhere into README.md and docs/*.md: `python -m benchmarks.pages`.

Each table stands between the lines `<!-- table: NAME -->` and `<!-- end -->`. Tables of results come from the CSVs
under results/; in docs/results.md and docs/paper.md each is followed by the commands that write its CSVs and, from
results/runs.json, the date and commit at which each was run. The effects of docs/effects.md come from the registry.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from benchmarks import (
    tables_adaptation as adaptation,
    tables_diagnosis as diagnosis,
    tables_paper as paper,
    tables_theorem as theorem,
)
from benchmarks.all import COMMANDS, stamps
from experiments.result_tables import read_rows
from visadapt.effects.catalogue import catalogue_markdown
from visadapt.storage.atomic_files import replacing
from visadapt.systems import SYSTEMS

PAGES = (Path("README.md"), *sorted(Path("docs").glob("*.md")))
"""Relative to the repository's root."""

RESULTS_PAGES = ("results.md", "paper.md")
"""The pages that state command, date and commit of each table."""

BLOCK = re.compile(r"<!-- table: (?P<name>[^>]+) -->\n.*?<!-- end -->", re.DOTALL)


@dataclass(frozen=True)
class Table:
    """A table of results and the commands that write its CSVs."""

    make: Callable[..., adaptation.Lines]
    """takes the rows of each CSV, in the order in which the commands first name them"""
    commands: tuple[str, ...]
    """names in `benchmarks.all.COMMANDS`"""

    @property
    def files(self) -> tuple[str, ...]:
        """The CSVs in results/."""
        return tuple(dict.fromkeys(BY_NAME[name].table for name in self.commands))


BY_NAME = {command.name: command for command in COMMANDS}

TABLES = {
    "headline": Table(adaptation.headline, ("cartpole_pixels", "cartpole_states", "flight", "rotorpy", "blind_hard")),
    "cartpole": Table(adaptation.cartpole, ("cartpole_pixels", "cartpole_states")),
    "curve": Table(adaptation.curve, ("cartpole_pixels", "cartpole_states")),
    "grounding": Table(adaptation.grounding, ("cartpole_pixels",)),
    "ablations": Table(adaptation.ablations, ("ablations",)),
    "ablations, states": Table(adaptation.ablations, ("ablations_states",)),
    "ablations, diagnosis": Table(
        diagnosis.parts, tuple(f"ablations_diagnosis{of}" for of in ("", "_large", "_rig", "_table", "_explained"))
    ),
    "ablations, flights": Table(adaptation.flight_ablations, ("ablations_flight",)),
    "other targets": Table(adaptation.other_targets, ("other_targets",)),
    "other targets, states": Table(adaptation.other_targets, ("other_targets_states",)),
    "pendulum": Table(adaptation.pendulum, ("inverted_pendulum",)),
    "dm_control": Table(adaptation.dm_control, ("dm_control",)),
    "vehicles": Table(adaptation.vehicles, ("flight",)),
    "residual": Table(adaptation.residual, ("residual_samples",)),
    "collection": Table(adaptation.collection, ("data_collection",)),
    "named": Table(adaptation.named, ("named_effects",)),
    "named control": Table(adaptation.named_control, ("named_control",)),
    "named control, frames": Table(adaptation.named_control, ("named_control_frames",)),
    "own system": Table(adaptation.own_system, ("own_system",)),
    "rotorpy": Table(adaptation.rotorpy, ("rotorpy",)),
    "loops": Table(adaptation.loops, ("power_loop",)),
    "swing": Table(adaptation.swing, ("swing_up",)),
    "action times": Table(adaptation.action_times, ("action_times",)),
    "renderers": Table(adaptation.renderers, ("renderers",)),
    "blind": Table(diagnosis.blind, ("blind_hard", "blind_easy", "blind_2029")),
    "blind strengths": Table(diagnosis.blind_strengths, ("blind_hard", "blind_2029")),
    "blind rigs": Table(diagnosis.blind_rigs, ("blind_rig", "blind_large", "blind_table")),
    "blind frames": Table(diagnosis.blind_frames, ("blind_frames",)),
    "blind flights": Table(diagnosis.blind_flights, ("blind_quadrotor", "blind_fixed_wing")),
    "planned experiments": Table(diagnosis.planned, ("planned_experiments",)),
    "sticking": Table(diagnosis.sticking, ("sticking",)),
    "vibrations": Table(diagnosis.vibrations, ("vibrations",)),
    "rotorpy diagnosis": Table(diagnosis.crazyflie, ("rotorpy_diagnosis",)),
    "baselines, constant": Table(paper.baselines_constant, ("baselines",)),
    "baselines, changing": Table(paper.baselines_changing, ("baselines",)),
    "baselines, PPO": Table(paper.ppo_curve, ("baselines", "baselines_frames")),
    "paper: table 1, CartPole": Table(paper.table_1_cartpole, ("cartpole_states", "baselines")),
    "paper: table 1, vehicles": Table(paper.table_1_vehicles, ("flight", "baselines_flight")),
    "paper: theorem 1": Table(theorem.theorem_1, ("theorem",)),
    "paper: Lipschitz constants": Table(theorem.lipschitz, ("theorem",)),
    "paper: table 2": Table(paper.table_2, ("cartpole_pixels", "baselines_frames")),
    "paper: table 4": Table(paper.table_4, ("power_loop",)),
    "paper: figures 2 and 6": Table(paper.collection, ("data_collection",)),
    "paper: figure 3": Table(paper.figure_3, ("baselines",)),
    "paper: figure 7": Table(paper.figure_7, ("baselines_flight",)),
    "paper: figure 8": Table(paper.figure_8, ("residual_samples",)),
    "paper: A.4": Table(paper.runtime, ("baselines", "action_times")),
    "paper: A.5": Table(paper.swing, ("swing_up", "swing_up_ppo")),
}
"""By name in the pages."""


def main() -> None:
    """Rewrite the pages in place."""
    for page in PAGES:
        text = filled(page)
        if text != page.read_text():
            with replacing(page) as temporary:
                temporary.write_text(text)
            print(f"{page}: rewritten")


def filled(page: Path) -> str:
    """The page's text with every block made anew.

    Raises:
        KeyError: a block of a name that there is no table of.
    """

    def block(match: re.Match[str]) -> str:
        name = match["name"]
        body = GENERATED[name]() if name in GENERATED else results_table(name, page.name in RESULTS_PAGES)
        return f"<!-- table: {name} -->\n{body}\n<!-- end -->"

    return BLOCK.sub(block, page.read_text())


def results_table(name: str, with_origin: bool) -> str:
    """A table of results, or that it is missing, and where asked for the commands, dates and commits of its CSVs."""
    table = TABLES[name]
    paths = [Path("results") / file for file in table.files]
    lines = "Not run in full yet."
    if all(path.exists() for path in paths):
        lines = markdown(table.make(*(read_rows(path) for path in paths)))
    return lines + "\n\n" + "\n".join(origins(table)) if with_origin else lines


def origins(table: Table) -> list[str]:
    """One line for each command: its CSV, when and at which commit it was run, and the command itself."""
    done = stamps()
    lines = []
    for name in table.commands:
        if name in done:
            made = f"run on {done[name].date} at commit {done[name].commit}"
        elif (Path("results") / BY_NAME[name].table).exists():
            made = "not run yet as a whole at one commit"
        else:
            made = "not run yet"
        lines.append(f"- `results/{BY_NAME[name].table}`, {made}: `{BY_NAME[name].shown}`")
    return lines


def markdown(lines: adaptation.Lines) -> str:
    """A table, its header first."""
    header, *body = lines
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), *body))


def commands() -> str:
    """Every command of `benchmarks.all`, its CSV and its minutes."""
    rows = [["name", "writes", "minutes, 2 cores", "needs", "command"]]
    for command in COMMANDS:
        needs = f"extra `{command.extra}`" if command.extra else ""
        table = f"`results/{command.table}`"
        rows.append([f"`{command.name}`", table, f"about {command.minutes}", needs, f"`{command.shown}`"])
    return markdown(rows)


def columns() -> str:
    """What a recording of each system holds."""
    rows = [["system", "states", "commands in [-1, 1]"]]
    for name, system in sorted(SYSTEMS.items()):
        states, actions = (
            ", ".join(f"`{one.name}` {'' if one.unit == '1' else one.unit}".strip() for one in variables)
            for variables in (system.states, system.actions)
        )
        rows.append([f"`{name}`", states, actions])
    return markdown(rows)


GENERATED = {"commands": commands, "columns": columns, "effects": catalogue_markdown}
"""Blocks that come from code, not from results."""


if __name__ == "__main__":
    main()
