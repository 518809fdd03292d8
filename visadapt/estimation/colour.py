"""Coloured innovations: those of a model that leaves something out.

What a model leaves out, such as the resonance of a belt, lasts for several rows. White process noise that is strong
enough for the resonance is as strong at every other frequency, so that the frequencies at which the model is wrong
outweigh those at which it is right. Here the whitened innovations e (m channels) are described as a vector
autoregression,

    e_t = A_1 e_{t-1} + ... + A_p e_{t-p} + L n_t,   n_t ~ N(0, I),

and parameters are fitted to n: generalised least squares (Cochrane and Orcutt 1949, Journal of the American Statistical
Association 44(245)), as prediction errors with a noise model are in system identification (Ljung 1999, System
Identification, section 4.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import pad

ORDERS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)  # that are tried, in rows

READINGS_PER_COEFFICIENT = 10  # At least

MIN_GAIN = 10.0  # Log likelihood, less the number of coefficients, that an order must gain over white innovations

BLOCK = 32  # Rows that are whitened by one product of matrices: faster than lag by lag


@dataclass(frozen=True)
class Colour:
    """Coloured noise: the noise variances of a filter, and the autoregression of its whitened innovations."""

    coefficients: Tensor  # (p, m, m) A
    whitening: Tensor  # (m, m) L^-1
    first: Tensor
    """(p m, p m) what whitens the first p rows of a window, which have none before them: the inverse Cholesky factor of
    the covariance of p successive rows"""
    log_process: Tensor  # (G,) log process noise variances of the filter, by group
    log_noise: Tensor  # (m,) log variances of its measurements

    def whitened(self, innovations: Tensor) -> Tensor:
        """n (N, T, m, M) of innovations (N, T, m, M)."""
        length, lags = innovations.shape[1], len(self.coefficients)
        padded = pad(innovations, (0, 0, 0, 0, lags, -length % BLOCK))
        blocks = [
            self._block @ padded[:, first : first + lags + BLOCK].flatten(1, 2) for first in range(0, length, BLOCK)
        ]
        later = torch.cat(blocks, 1).unflatten(1, (-1, innovations.shape[2]))[:, lags:length]
        first = self.first @ innovations[:, :lags].flatten(1, 2)
        return torch.cat((first.unflatten(1, (lags, -1)), later), 1)

    def log_density(self, weight: Tensor) -> Tensor:
        """(N,) log determinant of the whitening of rows with weights (N, T)."""
        lags = len(self.coefficients)
        first = self.first.logdet() / lags
        return first * weight[:, :lags].sum(1) + self.whitening.logdet() * weight[:, lags:].sum(1)

    @cached_property
    def _block(self) -> Tensor:
        """(BLOCK m, (p + BLOCK) m) the matrix that maps the innovations of BLOCK successive rows, and of the p rows
        before them, to n of the BLOCK rows."""
        lags, channels = self.coefficients.shape[:2]
        taps = torch.cat((torch.eye(channels).to(self.coefficients)[None], -self.coefficients))
        taps = torch.cat((self.whitening @ taps, taps.new_zeros(1, channels, channels)))  # the last is of other rows
        lag = lags + torch.arange(BLOCK)[:, None] - torch.arange(lags + BLOCK)
        lag = torch.where((lag >= 0) & (lag <= lags), lag, lags + 1)
        return taps[lag].movedim(2, 1).flatten(2).flatten(0, 1)


def whitened_adjoint(slopes: Tensor, colour: Colour | None) -> Tensor:
    """Derivatives by innovations (N, T, m, M), from those by the innovations that `whitened` makes of them."""
    if colour is None:
        return slopes
    lags = len(colour.coefficients)
    out = colour.whitening.mT @ slopes
    out[:, :lags] = 0.0
    later = out[:, lags:].clone()
    for lag, matrix in enumerate(colour.coefficients, 1):
        out[:, lags - lag : -lag] -= matrix.mT @ later
    out[:, :lags] += (colour.first.mT @ slopes[:, :lags].flatten(1, 2)).unflatten(1, (lags, -1))
    return out


def whitened(innovations: Tensor, colour: Colour | None) -> Tensor:
    """Innovations (N, T, m, M) with their `colour` taken out; as they are where they have none."""
    return innovations if colour is None else colour.whitened(innovations)


def colour_of(
    innovations: Tensor, inside: Tensor, longest: float, log_process: Tensor, log_noise: Tensor, own: bool = False
) -> Colour | None:
    """The colour of a filter's whitened innovations (N, T, m), `inside` (N, T) its windows; None where they are white.

    With `own`, each channel follows its own past alone.

    The order, `longest` at most, is the one with the largest log likelihood less the number of coefficients (Akaike
    1974, IEEE Transactions on Automatic Control 19(6)). `log_process` (G,) and `log_noise` (m,) are the noise of the
    filter.
    """
    channels = innovations.shape[2]
    orders = [p for p in ORDERS if p <= longest and p < innovations.shape[1] // 2]
    if not orders:
        return None
    first = orders[-1]
    here = inside[:, first:] > 0
    now = innovations[:, first:][here]
    white = _log_likelihood(now)
    best: tuple[float, Colour | None] = MIN_GAIN, None
    for order in orders:
        count = order * channels * (1 if own else channels)
        if count * READINGS_PER_COEFFICIENT > now.numel():
            break
        past = torch.cat([innovations[:, first - k : innovations.shape[1] - k] for k in range(1, order + 1)], -1)[here]
        weights = _by_own_past(past, now) if own else torch.linalg.lstsq(past, now, driver="gelsd").solution
        left = now - past @ weights
        gain = _log_likelihood(left) - white - count
        if gain > best[0]:
            root = torch.linalg.cholesky(left.T @ left / len(left))
            coefficients = weights.unflatten(0, (order, channels)).mT
            together = torch.cat((past.unflatten(1, (order, channels)).flip(1)[:, 1:].flatten(1), now), 1)
            start = torch.linalg.cholesky(together.T @ together / len(together))
            best = gain, Colour(coefficients, torch.linalg.inv(root), torch.linalg.inv(start), log_process, log_noise)
    return best[1]


def _by_own_past(past: Tensor, now: Tensor) -> Tensor:
    """(p m, m) least-squares weights of the past (N, p m) of channels (N, m), each of which follows its own alone."""
    channels = now.shape[1]
    lags = past.unflatten(1, (-1, channels)).movedim(2, 0)  # (m, N, p)
    weights = torch.linalg.lstsq(lags, now.T[..., None], driver="gelsd").solution[..., 0]  # (m, p)
    return torch.diag_embed(weights.T).flatten(0, 1)


def _log_likelihood(errors: Tensor) -> float:
    """Largest log likelihood of errors (N, m) as draws of one normal distribution, up to a constant."""
    return -0.5 * len(errors) * float(torch.linalg.slogdet(errors.T @ errors / len(errors))[1])
