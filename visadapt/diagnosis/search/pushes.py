"""Passing loads on one joint that no function of state and command explains: when, where and how hard.

The unexplained load is a sum of columns that state and command explain, errors, and pushes: bumps in time. Errors grow
with speed, acceleration and changes of the command, and neighbouring ones are alike; how much, the recording shows
itself. A bump is tried at every instant, in several widths, on every joint (a matched filter, in the generalised least
squares that the errors call for; Kay 1998, Fundamentals of Statistical Signal Processing II, section 4.4); the one that
stands out most is kept, and all is fitted again beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.diagnosis.search.unexplained_load import LoadTrack

WIDTHS = (0.06, 0.085, 0.12, 0.17)  # s, deviations of the Gaussian bumps

REACH = 2.45  # Deviations of a bump from its middle at which it has 5 % of its peak: there a push starts and ends

PRIOR = 0.3  # Deviation of the loads that a column explains, over that of the joints' unexplained loads

CUT = 9.0  # Squared errors over their median above which they are cut off when the errors' size is fitted

LAGS = 8  # Order of the autoregressive errors

ROUNDS = 6  # Rounds in which errors and columns are fitted

OUTLIER = 2.5  # Errors in deviations above which they count less (Huber)

WHITE = 0.03  # Share of the errors' variance that is taken as white at least, so that they can be whitened

MOST = 8  # Pushes in an episode at most


@dataclass(frozen=True)
class Bump:
    """A Gaussian bump of load on a joint."""

    episode: int
    joint: int
    middle: float  # s
    width: float  # s, deviation
    height: float  # in the load's unit
    deviation: float  # of the height
    score: float  # height over its deviation

    @property
    def impulse(self) -> float:
        return self.height * self.width * math.sqrt(2 * math.pi)


class Detector:
    """Columns, errors and bumps fitted to all tracks together."""

    def __init__(self, tracks: Sequence[LoadTrack], threshold: float) -> None:
        self.tracks = tracks
        self.threshold = threshold
        self.bumps: list[Bump] = []
        size = torch.cat([t.load for t in tracks]).square().mean().sqrt()
        self.base = [PRIOR * size * t.columns for t in tracks]
        self.reaction = [PRIOR * size * t.reaction for t in tracks]
        self.left = [torch.zeros_like(t.load) for t in tracks]
        self.spread = [t.load.abs().median(0).values.expand_as(t.load) + 1e-12 for t in tracks]
        joints = tracks[0].load.shape[1]
        self.ar = torch.zeros(joints, LAGS, dtype=torch.float64)
        self.innovation = torch.ones(joints, dtype=torch.float64)

    def whitened(self, k: int, values: Tensor) -> Tensor:
        """Values (..., N, J) over their errors' deviation, less what the errors before foretell."""
        values = values / self.spread[k]
        out = values.clone()
        for lag in range(1, LAGS + 1):
            out[..., lag:, :] -= self.ar[:, lag - 1] * values[..., :-lag, :]
        return out / self.innovation

    def design(self, k: int) -> Tensor:
        """(K, N, J) columns of an episode: common to all, its own, and its bumps."""
        track = self.tracks[k]
        common = self.base[k] - torch.einsum('knij,nj->kni', self.reaction[k], self.left[k])
        own = [one for one in self.bumps if one.episode == k]
        shapes = [bump(track, one.joint, one.middle, one.width) * 10 for one in own]
        return torch.cat((common, *[s[None] for s in shapes])) if shapes else common

    def fit(self, rounds: int = ROUNDS) -> None:
        count = len(self.base[0])
        eye = torch.eye
        for r in range(rounds):
            # Common columns over all episodes, then each episode around these.
            parts = []
            for k, track in enumerate(self.tracks):
                design = self.design(k)
                white, target = self.whitened(k, design).flatten(1), self.whitened(k, track.load).flatten()
                weight = torch.ones_like(target)
                if r:
                    left = (target - white.T @ self.weights[k]).abs()
                    weight = (OUTLIER / left.clamp(min=1e-9)).clamp(max=1)
                parts.append((white, target, weight))
            normal, gradient = eye(count).double(), torch.zeros(count).double()
            for white, target, weight in parts:
                # bumps of the episode are projected out
                common, shapes = white[:count], white[count:]
                a, g = (common * weight) @ common.T, (common * weight) @ target
                if len(shapes):
                    c, d = (common * weight) @ shapes.T, (shapes * weight) @ shapes.T + 1e-9 * eye(len(shapes)).double()
                    a = a - c @ torch.linalg.solve(d, c.T)
                    g = g - c @ torch.linalg.solve(d, (shapes * weight) @ target)
                normal, gradient = normal + a, gradient + g
            mean = torch.linalg.solve(normal, gradient)
            several = len(self.tracks) > 1
            precision = (1 / OWN**2 if several else 1.0)
            self.weights, self.roots = [], []
            for white, target, weight in parts:
                prior = torch.full((len(white),), 1e-2, dtype=torch.float64)
                prior[:count] = precision
                start = torch.zeros(len(white), dtype=torch.float64)
                if several:
                    start[:count] = mean
                a = (white * weight) @ white.T + torch.diag(prior)
                g = (white * weight) @ target + prior * start
                root = torch.linalg.cholesky(a)
                self.roots.append(root)
                self.weights.append(torch.cholesky_solve(g[:, None], root)[:, 0])
            self.left = [t.load - torch.einsum('k,knj->nj', w, self.design(k)) for k, (t, w) in enumerate(zip(self.tracks, self.weights, strict=True))]
            if r + 1 < rounds:
                self._errors()

    def _errors(self) -> None:
        left, explained = [], []
        for k, track in enumerate(self.tracks):
            design = self.design(k)
            left.append(self.left[k])
            explained.append(torch.linalg.solve_triangular(self.roots[k], design.flatten(1), upper=False).reshape(design.shape))
        activity = torch.cat([t.activity for t in self.tracks])
        middle = activity.mean(0)
        basis = torch.cat((torch.ones(len(activity), 1).double(), activity - middle), 1)
        for j in range(self.ar.shape[0]):
            power = torch.cat([local_mean(e[:, j].square().clamp(max=CUT * e[:, j].square().median()) + x[..., j].square().sum(0)) for e, x in zip(left, explained, strict=True)])
            logs = (power + 1e-4 * power.mean()).log()
            ridge = torch.eye(basis.shape[1]).double() * 3.0
            ridge[0, 0] = 0
            coefficients = torch.linalg.solve(basis.T @ basis / 8 + ridge, basis.T @ logs / 8)
            coefficients[1:] = coefficients[1:].clamp(min=0)
            logs = basis @ coefficients
            # the level again, by the mean of the power over what is expected
            logs = logs + (power / logs.exp()).clamp(max=9).mean().log()
            deviation = (0.5 * logs).exp().split([len(t.load) for t in self.tracks])
            moments = torch.zeros(LAGS + 1, dtype=torch.float64)
            for k, (e, x) in enumerate(zip(left, explained, strict=True)):
                self.spread[k] = self.spread[k].clone()
                self.spread[k][:, j] = deviation[k]
                scaled, own = (e[:, j] / deviation[k]).clamp(-3, 3), x[..., j] / deviation[k]
                for lag in range(LAGS + 1):
                    moments[lag] += scaled[lag:] @ scaled[: len(scaled) - lag]
                    moments[lag] += (own[:, lag:] * own[:, : len(scaled) - lag]).sum()
            moments /= sum(len(t.load) for t in self.tracks)
            moments[0] *= 1 + WHITE
            index = (torch.arange(LAGS)[:, None] - torch.arange(LAGS)).abs()
            self.ar[j] = torch.linalg.solve(moments[index], moments[1:])
            self.innovation[j] = (moments[0] - self.ar[j] @ moments[1:]).clamp(min=1e-6).sqrt()

    def scan(self, k: int) -> Bump | None:
        """The bump that stands out most in an episode."""
        track = self.tracks[k]
        white = self.whitened(k, self.design(k)).flatten(1)
        left = self.whitened(k, track.load).flatten() - white.T @ self.weights[k]
        best: Bump | None = None
        for width in WIDTHS:
            middles = torch.arange(float(track.time[0]) + width, float(track.time[-1]) - width, 0.3 * width, dtype=torch.float64)
            for j in range(track.load.shape[1]):
                shapes = torch.stack([bump(track, j, float(m), width) for m in middles])
                tried = self.whitened(k, shapes).flatten(1)
                shared = torch.linalg.solve_triangular(self.roots[k], white @ tried.T, upper=False)
                information = (tried.square().sum(1) - shared.square().sum(0)).clamp(min=1e-9)
                height = tried @ left / information
                score = height * information.sqrt() * (information > 0.15 * tried.square().sum(1))
                i = int(score.abs().argmax())
                if best is None or abs(float(score[i])) > abs(best.score):
                    best = Bump(k, j, float(middles[i]), width, float(height[i]), float(information[i] ** -0.5), float(score[i]))
        return best

    def run(self, most: int = MOST) -> list[Bump]:
        self.fit()
        for _ in range(most):
            found = [one for k in range(len(self.tracks)) if (one := self.scan(k)) is not None and abs(one.score) > CANDIDATE]
            if not found:
                break
            self.bumps += found
            self.fit(3)
        while self.bumps:
            self.bumps = self.scored()
            weakest = min(range(len(self.bumps)), key=lambda i: abs(self.bumps[i].score))
            if abs(self.bumps[weakest].score) > self.threshold:
                break
            weakest_of = {}
            for i, one in enumerate(self.bumps):
                if abs(one.score) <= self.threshold and (one.episode not in weakest_of or abs(one.score) < abs(self.bumps[weakest_of[one.episode]].score)):
                    weakest_of[one.episode] = i
            gone = set(weakest_of.values())
            self.bumps = [one for i, one in enumerate(self.bumps) if i not in gone]
            self.fit(3)
        return self.bumps

    def scored(self) -> list[Bump]:
        out = []
        from dataclasses import replace
        for k in range(len(self.tracks)):
            own = [one for one in self.bumps if one.episode == k]
            if not own:
                continue
            inverse = torch.cholesky_inverse(self.roots[k])
            first = len(self.weights[k]) - len(own)
            for i, one in enumerate(own):
                height, deviation = 10 * float(self.weights[k][first + i]), 10 * float(inverse[first + i, first + i]) ** 0.5
                out.append(replace(one, height=height, deviation=deviation, score=height / deviation))
        return out


CANDIDATE = 2.8

OWN = 0.5  # Deviation of an episode's weights around those of all, in prior deviations


def bump(track: LoadTrack, joint: int, middle: float, width: float) -> Tensor:
    """(N, J) a bump of unit height, smoothed as the track is."""
    whole = math.hypot(width, track.smoothing)
    out = torch.zeros_like(track.load)
    out[:, joint] = width / whole * torch.exp(-0.5 * ((track.time - middle) / whole).square())
    return out


def local_mean(values: Tensor, reach: int = 4) -> Tensor:
    padded = torch.nn.functional.pad(values[None, None], (reach, reach), mode="replicate")
    return torch.nn.functional.avg_pool1d(padded, 2 * reach + 1, 1)[0, 0]
