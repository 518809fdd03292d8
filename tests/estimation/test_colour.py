"""Innovations that are not white."""

import pytest
import torch

from visadapt.estimation.colour import colour_of, whitened, whitened_adjoint

WINDOWS, ROWS, LONGEST = 8, 300, 15
MIXING = torch.tensor([[1.0, 0.0], [0.5, 0.8]], dtype=torch.float64)
RESONANCE = [0.9 * torch.tensor([[1.2, 0.3], [0.0, 0.9]]).double(), torch.tensor([[-0.8, 0.0], [0.1, -0.3]]).double()]


def drawn(coefficients):
    """Innovations (WINDOWS, ROWS, 2) of a vector autoregression."""
    noise = torch.randn(WINDOWS, ROWS + 100, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    noise = noise @ MIXING.T
    rows: list[torch.Tensor] = []
    for t in range(ROWS + 100):
        now = noise[:, t]
        for lag, matrix in enumerate(coefficients, 1):
            now = now + (rows[t - lag] @ matrix.T if t >= lag else 0.0)
        rows.append(now)
    return torch.stack(rows[100:], 1)


def colour(innovations, inside=None):
    inside = torch.ones(innovations.shape[:2]) if inside is None else inside
    return colour_of(innovations, inside, LONGEST, torch.zeros(1), torch.zeros(2))


def test_white_innovations_have_no_colour():
    assert colour(drawn([])) is None


def test_the_coefficients_of_an_autoregression_are_found_and_whiten_it():
    innovations = drawn(RESONANCE)
    found = colour(innovations)
    assert torch.allclose(found.coefficients[:2], torch.stack(RESONANCE), atol=0.08)
    white = found.whitened(innovations[..., None])[..., 0]
    for lag in range(6):
        covariance = (
            torch.einsum("wti,wtj->ij", white[:, 10 + lag :], white[:, 10 : ROWS - lag]) / white[:, 10:].numel() * 2
        )
        assert torch.allclose(covariance, torch.eye(2).double() if lag == 0 else torch.zeros(2, 2).double(), atol=0.06)


def test_rows_at_the_start_of_a_window_are_white_too():
    innovations = drawn(RESONANCE)
    found = colour(innovations)
    windows = innovations.unflatten(1, (-1, 30)).flatten(0, 1)
    white = found.whitened(windows[..., None])[..., 0]
    first = white[:, : len(found.coefficients)]
    assert float(first.square().mean()) == pytest.approx(1.0, abs=0.2), "far more if rows before it are taken as 0"


def test_padding_tells_nothing():
    innovations = drawn(RESONANCE)
    inside = torch.ones(WINDOWS, ROWS)
    inside[-1, 200:] = 0
    padded = innovations.clone()
    padded[-1, 200:] = 1e3
    assert torch.equal(colour(padded, inside).coefficients, colour(innovations, inside).coefficients)


@pytest.mark.parametrize("rows", [0, 1, 3])
def test_a_recording_of_few_rows_has_no_colour(rows):
    assert colour(drawn(RESONANCE)[:, :rows]) is None


def test_the_adjoint_of_whitening_is_its_transpose():
    innovations = drawn(RESONANCE)
    found, other = colour(innovations), torch.randn(*innovations.shape, 1).double()
    forwards = (whitened(innovations[..., None], found) * other).sum()
    assert float(forwards) == pytest.approx(float((innovations[..., None] * whitened_adjoint(other, found)).sum()))
