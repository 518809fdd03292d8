"""The filter against the same Gaussian written out as one big vector."""

import math

import pytest
import torch

from visadapt.estimation.kalman import Linear, backward, forward, log_likelihood, noise_scores, respond, weights

N, T, STATES, CHANNELS, COLUMNS = 3, 7, 4, 2, 3


@pytest.fixture
def problem():
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return Linear(
        torch.eye(STATES, dtype=torch.float64) + 0.2 * draw(N, T - 1, STATES, STATES),
        draw(N, T - 1, STATES, COLUMNS),
        draw(N, T, CHANNELS, STATES),
        draw(N, T, CHANNELS, COLUMNS),
        draw(N, STATES, COLUMNS),
        torch.tensor([1.0, 2.0, 0.5, 3.0], dtype=torch.float64).expand(N, -1),
    )


PROCESS = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64).expand(N, -1)
DIRECTIONS = torch.randn(N, T - 1, STATES, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
MEASUREMENT = torch.tensor([0.5, 0.2], dtype=torch.float64).expand(N, -1)


def process_of(variances):
    """Covariances of noises with variances (N, 3), which enter the states by DIRECTIONS."""
    return (DIRECTIONS * variances[:, None, None]) @ DIRECTIONS.mT


def dense(problem, n, column):
    """Mean and covariance of all states, and the matrix, of system n, as one Gaussian."""
    mean = [problem.start[n, :, column]]
    maps = [torch.eye(STATES, dtype=torch.float64)]
    blocks = [torch.diag(problem.initial_variance[n])]
    rows = [[maps[0]]]
    for t in range(T - 1):
        a = problem.transition[n, t]
        mean.append(a @ mean[-1] + problem.drive[n, t, :, column])
        rows.append([a @ m for m in rows[-1]] + [torch.eye(STATES, dtype=torch.float64)])
        blocks.append(process_of(PROCESS)[n, t])
    whole = torch.zeros(T * STATES, T * STATES, dtype=torch.float64)
    for i, row in enumerate(rows):
        for j, m in enumerate(row):
            whole[i * STATES : (i + 1) * STATES, j * STATES : (j + 1) * STATES] = m
    covariance = whole @ torch.block_diag(*blocks) @ whole.T
    return torch.cat(mean), covariance


def test_likelihood_is_that_of_the_whole_gaussian(problem):
    filtered = forward(problem, process_of(PROCESS), MEASUREMENT)
    found = log_likelihood(filtered, torch.ones(N, T, CHANNELS))
    for n in range(N):
        mean, covariance = dense(problem, n, 0)
        h = torch.block_diag(*problem.sensing[n])
        s = h @ covariance @ h.T + torch.diag(MEASUREMENT[n].repeat(T))
        error = problem.reading[n, :, :, 0].flatten() - h @ mean
        expected = -0.5 * (error @ torch.linalg.solve(s, error) + torch.logdet(s) + len(error) * math.log(2 * math.pi))
        torch.testing.assert_close(found[n], expected)


def test_smoothed_states_are_the_conditional_mean_for_every_column(problem):
    smoothed, _ = backward(forward(problem, process_of(PROCESS), MEASUREMENT))
    for n in range(N):
        for column in range(COLUMNS):
            mean, covariance = dense(problem, n, column)
            h = torch.block_diag(*problem.sensing[n])
            s = h @ covariance @ h.T + torch.diag(MEASUREMENT[n].repeat(T))
            error = problem.reading[n, :, :, column].flatten() - h @ mean
            expected = mean + covariance @ h.T @ torch.linalg.solve(s, error)
            torch.testing.assert_close(smoothed[n, :, :, column].flatten(), expected)


def test_smoothed_states_follow_the_model_with_the_smoothed_disturbances(problem):
    smoothed, adjoint = backward(forward(problem, process_of(PROCESS), MEASUREMENT))
    disturbance = -process_of(PROCESS) @ adjoint[:, 1:]
    carried = problem.transition @ smoothed[:, :-1] + problem.drive + disturbance
    torch.testing.assert_close(carried, smoothed[:, 1:])


def test_without_process_noise_the_smoothed_states_follow_the_model(problem):
    smoothed, _ = backward(forward(problem, torch.zeros(N, T - 1, STATES, STATES).double(), MEASUREMENT))
    torch.testing.assert_close(problem.transition @ smoothed[:, :-1] + problem.drive, smoothed[:, 1:])


def test_inputs_pass_through_the_gains_like_columns(problem):
    filtered = forward(problem, process_of(PROCESS), MEASUREMENT)
    quiet = Linear(
        problem.transition,
        problem.drive,
        problem.sensing,
        problem.reading,
        torch.zeros_like(problem.start),
        problem.initial_variance,
    )
    expected = forward(quiet, process_of(PROCESS), MEASUREMENT).white
    torch.testing.assert_close(respond(filtered, problem.drive, problem.reading), expected)


def test_noise_scores_are_the_derivatives_of_the_likelihood(problem):
    process, noise = (x.clone().requires_grad_() for x in (PROCESS.log(), MEASUREMENT.log()))
    filtered = forward(problem, process_of(process.exp()), noise.exp())
    log_likelihood(filtered, torch.ones(N, T, CHANNELS)).sum().backward()
    _, adjoint = backward(filtered)
    weight = weights(filtered, filtered.white, adjoint)
    by_process, by_noise = noise_scores(filtered, adjoint[..., 0], weight[..., 0], DIRECTIONS, PROCESS, MEASUREMENT)
    torch.testing.assert_close(by_process.sum(1), process.grad)
    torch.testing.assert_close(by_noise.sum(1), noise.grad)


def test_weighted_variances_are_what_the_smoothed_states_leave_of_the_readings(problem):
    filtered = forward(problem, process_of(PROCESS), MEASUREMENT)
    smoothed, adjoint = backward(filtered)
    noise = MEASUREMENT[:, None, :, None] * weights(filtered, filtered.white, adjoint)
    torch.testing.assert_close(noise, problem.reading - problem.sensing @ smoothed)


def test_states_of_an_unstable_system_are_found_over_many_precise_readings():
    """Rounding errors of the covariance that are not symmetric would grow as fast as the system does."""
    # Cart and pole near upright, each pushed by a load that drifts; held at rest, as a policy holds them.
    rate = torch.zeros(6, 6, dtype=torch.float64)
    rate[0, 1] = rate[2, 3] = rate[1, 4] = rate[3, 5] = 1.0
    rate[1, 2], rate[3, 2], rate[3, 4] = -0.7, 15.8, -1.5
    step, rows, precision = torch.linalg.matrix_exp(0.05 * rate), 1000, 5e4
    sensing = torch.zeros(2, 6, dtype=torch.float64)
    sensing[0, 0] = sensing[1, 0] = sensing[1, 2] = precision
    problem = Linear(
        step.expand(1, rows - 1, 6, 6),
        torch.zeros(1, rows - 1, 6, 1, dtype=torch.float64),
        sensing.expand(1, rows, 2, 6),
        torch.zeros(1, rows, 2, 1, dtype=torch.float64),
        torch.tensor([0.1, 0.0, 0.1, 0.0, 0.0, 0.0], dtype=torch.float64)[None, :, None],
        torch.tensor([[2.25, 25.0, 0.1, 100.0, 100.0, 0.1]], dtype=torch.float64),
    )
    process = torch.diag(torch.tensor([0.0, 0, 0, 0, 1e-2, 1e-5], dtype=torch.float64))
    smoothed, _ = backward(forward(problem, process.expand(1, rows - 1, 6, 6), torch.full((1, 2), 10.0).double()))
    assert smoothed[0, :, [0, 2]].abs().max() < 10 / precision
