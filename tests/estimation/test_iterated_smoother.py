"""States of a model that is not linear: those found are as probable as the true ones, where a joint comes to rest."""

from dataclasses import replace

import torch

from experiments.ball_beam import BallBeam, balanced, to_and_fro
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects.catalogue import catalogue
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.iterated_smoother import smoothed_states
from visadapt.estimation.likelihood import linear_problem, min_log_process, variances

(FRICTION,) = (effect for effect in catalogue(BallBeam()) if effect.name == "track.coulomb_friction")


def improbable(model, fits, state):
    """(W,) -2 log probability of states (W, T, n), up to a constant."""
    fits = replace(fits, state=state[None])
    problem = linear_problem([model], fits).data()
    process, noise = variances(model, fits, problem)
    drive, reading = problem.drive[..., 0], problem.reading[..., 0]
    of_drive = (drive * torch.linalg.solve(process, drive[..., None])[..., 0]).sum((1, 2))
    of_start = (problem.start[..., 0].square() / problem.initial_variance).sum(1)
    return of_drive + of_start + (reading.square() / noise[:, None]).sum((1, 2))


def test_states_are_as_probable_as_the_true_ones_where_a_joint_comes_to_rest():
    recording, true = balanced([FRICTION(force=0.015)], 3, 600, lambda time: to_and_fro(time + 1.19))
    rows = prepare(recording, BallBeam(), [FRICTION]).rows
    model = CandidateModel(BallBeam(), [FRICTION], rows)
    start = Search(BallBeam(), rows, [FRICTION]).single(FRICTION).fits
    least = torch.full_like(start.log_process, min_log_process(rows.period))
    start = replace(
        start,
        theta=start.theta.new_tensor([[0.015]]),
        log_process=least,
        log_noise=torch.tensor([[1e-6, 1e-8]], dtype=torch.float64).log(),
    )
    inside = (rows.inside > 0)[..., None]
    truth = torch.where(inside, true[(rows.time / rows.period).round().long().clamp(max=len(true) - 1)], 0.0)
    assert float(improbable(model, start, start.state[0]).max()) > 1000  # in one window, those of the fit do not stop
    found = smoothed_states(model, start)
    assert bool((improbable(model, start, found) < improbable(model, start, truth)).all())
    assert float(((found - truth) * inside)[..., 0].abs().max()) < 2e-3
