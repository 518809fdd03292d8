from itertools import pairwise

import torch

from visadapt.estimation.kalman import Linear, backward
from visadapt.estimation.noise import Noise, UnknownNoise, most_probable_noise

ROWS, MISSED = 40, 11
STATED = 0.01


def wander(drift, measurement, seed=0):
    """A coordinate that integrates a load that walks at random, measured in all rows but one."""
    generator = torch.Generator().manual_seed(seed)
    step = torch.tensor([[1.0, 0.1], [0.0, 1.0]], dtype=torch.float64)
    places = [torch.zeros(2, dtype=torch.float64)]
    for _ in range(ROWS - 1):
        places.append(step @ places[-1] + torch.tensor([0.0, drift]) * torch.randn(1, generator=generator))
    value = torch.stack(places)[:, :1] + STATED * measurement * torch.randn(ROWS, 1, generator=generator)
    used = (torch.arange(ROWS) != MISSED).double()[:, None]
    system = Linear(
        transition=step.expand(1, ROWS - 1, 2, 2),
        drive=torch.zeros(1, ROWS - 1, 2, 1, dtype=torch.float64),
        sensing=(used[..., None] * torch.tensor([[1 / STATED, 0.0]], dtype=torch.float64))[None],
        reading=(used * value / STATED)[None, ..., None],
        start=torch.zeros(1, 2, 1, dtype=torch.float64),
        initial_variance=torch.ones(1, 2, dtype=torch.float64),
    )
    shapes = torch.tensor([[[0.0, 0.0], [0.0, 1.0]]], dtype=torch.float64)
    return UnknownNoise(system, used[None], shapes), value


def test_the_smoothed_path_is_the_least_squares_solution():
    """Against the same problem written as one big Gaussian over the first row and all the drifts."""
    episode, value = wander(0.3, 1.0)
    columns = [torch.eye(2, ROWS + 1, dtype=torch.float64)]
    for t, step in enumerate(episode.system.transition[0]):
        ahead = step @ columns[-1]
        ahead[1, 2 + t] += 1
        columns.append(ahead)
    maps = torch.stack(columns)
    prior = torch.cat((torch.ones(2), torch.full((ROWS - 1,), 0.3))).double().square()
    there = torch.arange(ROWS) != MISSED
    seen, noise = maps[there, 0], (2.0 * STATED) ** 2
    covariance = torch.linalg.inv(torch.diag(1 / prior) + seen.T @ seen / noise)
    mean = covariance @ seen.T @ value[there, 0] / noise
    filtered = episode.filtered(Noise(torch.tensor([[0.3]]).double(), torch.tensor([2.0]).double()))
    path = backward(filtered)[0][0, ..., 0]
    torch.testing.assert_close(path, maps @ mean, rtol=1e-6, atol=1e-8)


def test_the_most_probable_noise_is_near_the_true_one():
    noise = most_probable_noise([wander(0.3, 2.0, seed=seed)[0] for seed in range(6)])
    # The search stops at a grid of a fifth of a decade.
    assert 0.15 < float(noise.process) < 0.6
    assert 1.6 < float(noise.measurement) < 2.5


def test_a_load_that_drifts_more_is_distinguished_from_one_that_drifts_less():
    found = [float(most_probable_noise([wander(drift, 1.0)[0]]).process) for drift in (0.01, 0.1, 1.0)]
    assert all(less < more for less, more in pairwise(found))
