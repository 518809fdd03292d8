"""Which experiment settles what a recording cannot."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from visadapt.diagnosis.search.unexplained import TURN_SUFFIX, SmoothFunction
from visadapt.diagnosis.words import listed, plain
from visadapt.effects import Effect, Stage
from visadapt.effects.catalogue import separable
from visadapt.estimation.profiles import SystemProfile, profile_of
from visadapt.systems import System

MOTIONS: dict[Stage, str] = {
    Stage.ACTUATION: "steps and chirps of the command over its whole range",
    Stage.DYNAMICS: "free motions with the motor off, slow and fast, as far as the machine can be left to itself",
    Stage.SENSING: "known positions and angles, set by hand and held still",
    Stage.CAMERA: "a card with marks at known places, held still before the camera",
}
"""What to record to separate effects of a stage from others, for a system on a track."""

MOTIONS_IN_FLIGHT = {
    Stage.DYNAMICS: "slow and fast flights in all directions, at several heights, with and without turns"
}
"""Those that differ for an aircraft."""

MOTIONS_WITHOUT_JOINTS = {
    Stage.DYNAMICS: "runs in which every command rests, from several states on",
    Stage.SENSING: "each sensor beside one that is known to be right, while nothing changes",
}
"""Those that differ for a system that no force or torque moves, such as a tank."""

LOOK = (
    "Look at the frames where they are unexplained: if the scene itself is another one, train a renderer on frames of "
    "it; if light, lens or something that moves is the cause, film without it."
)
"""For frames that neither the renderer nor an effect of the camera explains."""

ALONG = (
    "These frames look the same from every place along the track: a camera_shift dx, or a position_offset, would not "
    "show; a card with marks at known places, held still before the camera, settles it."
)
"""For a film of a track without features."""


OF_ONE_MACHINE = (
    "The machine, or a sensor, was changed between the recordings: diagnose each by itself, or record all of them with "
    "one machine that is left as it is."
)
"""For recordings that are explained one by one, and not together."""

AS_IT_CHANGES = (
    "The size of an effect changes within the recording: make two recordings in which it does not, one as this one "
    "begins and one as it ends (a full and an empty battery, a cold and a warm bearing, with and without the load), "
    "and diagnose each by itself."
)
"""For a recording that is explained by effects whose sizes change within it."""

EVERY_COMMAND = (
    "Record every command, with the time at which it was sent: the controller is faster than the rows, and what it "
    "sends between them is not in the recording. A bag of ROS has it, and so has a file with rows as often as commands."
)
"""For a recording whose commands change between its rows."""

EVERY_SENT = (
    "Log every command that is sent, as PX4 does with SDLOG_PROFILE 17 (high rate). Where a log keeps only some of "
    "them, they act before they were logged, as here, and what was sent between them is unknown."
)
"""For a recording whose commands act before their own stamps."""

MIN_LOG_ODDS = 0.0  # Log odds above which the variable of an unexplained disturbance is named: likelier than not

SURE_LOG_ODDS = 4.0  # Log odds above which the disturbance is said to depend on it

AS_LIKELY = 3.0  # Difference of the log odds of two variables up to which both are named

LONGER = (
    "As far as predictions reach, nothing departs from the source beyond the noise. What is small shows in motions in "
    "which it is larger, what acts slowly in long runs under commands that stay the same for longer than the machine "
    "takes to settle."
)
"""For a gap that whole episodes show, and predictions do not."""


def separate(classes: Sequence[Collection[type[Effect]]], system: System) -> str:
    """The experiments that separate the members of each class; empty where every class has one member."""
    parts = []
    for members in classes:
        by_name = {effect.name: effect for effect in members}
        names = sorted(by_name)
        experiments, settled = [], set()
        for name in names:
            for other, experiment in by_name[name].settled_by.items():
                if other in by_name and not separable(by_name[name], by_name[other], system):
                    experiments.append(experiment)
                    settled |= {name, other}
        if len(names) > 1:
            every = settled == set(names)
            general = f"{_general(members, system)}; --plan says whether commands alone would do"
            advice = experiments if every else [*experiments, general]
            parts.append(f"To tell {listed(names)} apart: " + "; ".join(advice) + ".")
    return " ".join(parts)


def disturbance_in_words(functions: Sequence[SmoothFunction]) -> str:
    """The most probable of unexplained `functions` in words: a load, or an error of a state's reading, and what it
    depends on, with what it may depend on as well."""
    first = functions[0]
    port = plain(first.port)
    what = f"error of the reading of {port}" if first.of_reading else f"load ({port})"
    if not first.log_odds > MIN_LOG_ODDS:
        return f"an unexplained {what} depends on no single state, command or time"
    alike = dict.fromkeys(  # of one variable there are several functions, with and without a factor
        plain(one.variable)
        for one in functions
        if (one.port, one.of_reading) == (first.port, first.of_reading)
        and one.log_odds > max(MIN_LOG_ODDS, first.log_odds - AS_LIKELY)
    )
    depends = "depends" if first.log_odds > SURE_LOG_ODDS else "may depend"
    return f"an unexplained {what} {depends} on {listed(list(alike), 'or')}"


def explain(functions: Sequence[SmoothFunction], pushed: Collection[str] = ()) -> str:
    """The experiment that shows the most probable of unexplained `functions` more clearly; `pushed` are the loads with
    pushes."""
    function, said = functions[0], disturbance_in_words(functions)
    of_no_state = function.variable == "time" or not function.log_odds > MIN_LOG_ODDS
    if of_no_state and function.port in pushed and not function.of_reading:
        return untouched([function.port])
    if not function.log_odds > MIN_LOG_ODDS:
        runs = "the same commands twice, to see what returns, and motions of one kind at a time"
    elif function.variable == "time":
        runs = "several long runs under the same commands, to see what returns in each"
    else:
        angle = function.variable.removesuffix(TURN_SUFFIX)
        turns = angle != function.variable
        covered = f"whole turns of {plain(angle)}" if turns else f"the whole range of {plain(angle)}"
        runs = f"runs that cover {covered} slowly and fast, with all else as constant as possible"
    return f"{said[0].upper()}{said[1:]}: record {runs}, and add an effect of your own for it (--effects)."


def untouched(pushed: Collection[str]) -> str:
    """The experiment that shows whether what pushes these loads is a hand."""
    return (
        f"Pushes on {listed([plain(load) for load in sorted(pushed)])} were found: record runs in which nothing "
        "touches the machine, neither a hand nor a gust nor an end stop, to see whether they return."
    )


def more(profile: SystemProfile) -> str:
    """The experiment that could show a gap where none was found."""
    return (
        "Nothing departs from the source beyond the noise. A gap that shows only elsewhere needs other motions: larger "
        f"commands, higher speeds, other {'winds and heights' if profile.is_aircraft else 'positions'}."
    )


def finer(positions: Sequence[str]) -> str:
    """The experiment where the steps of these positions' readings are coarse for the motion."""
    return f"Read {listed(positions)} in finer steps, or record motions that are large against these steps."


def _general(members: Collection[type[Effect]], system: System) -> str:
    motions = MOTIONS | (MOTIONS_IN_FLIGHT if profile_of(system).is_aircraft else {})
    if not any(load.unit in ("N", "N m") for load in system.loads):
        motions |= MOTIONS_WITHOUT_JOINTS
    stages = sorted({effect.stage for effect in members})
    return "record " + ", then ".join(motions[stage] for stage in stages if stage in motions)
