"""Pushes: passing loads on one joint that no function of state and command explains; when, where and how hard.

The unexplained load is a sum of columns that state and command explain, of errors, and of pushes: bumps in time. Errors
grow with speed, acceleration and changes of the command, and neighbouring ones are correlated; the recording shows how
much. A bump is tried at every instant, in several widths, on every joint: a matched filter, by generalised least
squares (Kay 1998, Fundamentals of Statistical Signal Processing II, section 4.4). Those that stand out are fitted
together with all else, and those that then do not stand out clearly are dropped, the weakest first.

Where a joint is at rest, dry friction holds it with any load up to its size. This is a load of its own, smooth in time
and as large at random as the friction: errors of such a size, but independent from instant to instant, would let a load
that holds a cart for half a second pass for a push.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d, pad

from visadapt.diagnosis.result import Push
from visadapt.diagnosis.search.bumps import EDGE, Bump, bumps_at, overlapping, summed
from visadapt.diagnosis.search.unexplained import CLEAR_LOG_ODDS, SmoothFunction
from visadapt.diagnosis.search.unexplained_load import LoadTrack, load_tracks
from visadapt.recordings import Recording
from visadapt.world import World

WIDTHS = (0.12, 0.17, 0.24, 0.34)  # Deviations of the Gaussian bumps that are tried, in prediction times

SPACING = 0.3  # Distance between the bumps of a width that are tried, over that width

MIN_SCORE_FIRST, MIN_SCORE_FURTHER, MIN_SCORE_PUSH = 3.5, 3.0, 5.0
"""Height of a bump, over its standard deviation, from which the first one on a part is fitted with all else, from which
further ones are, and from which a bump is called a push: high, since errors of a model are not normally distributed."""

MAX_P_VALUE = 1e-3  # of a push that is named, with as many bumps as were tried counted in

MAX_BUMPS = 6  # Bumps on a part at most

COLUMN_PRIOR = 0.2
"""Prior standard deviation of the load that a column explains, over that of the unexplained load."""

EPISODE_PRIOR = 0.5
"""Prior standard deviation of an episode's weights about the common weights, in units of the common weights' prior
deviation."""

LAGS = 8  # Order of the autoregression of errors

ROUNDS, ROUNDS_AGAIN = 6, 3  # Rounds in which columns and errors are fitted in turn, at first and with another bump

NEIGHBOURS = 4  # Instants on either side over which the power of errors is averaged

OUTLIER = 2.5  # Errors, in deviations, above which they count less (Huber)

MAX_POWER = 9.0
"""Squared errors, over their median or over those expected, that count when the size of errors is fitted: larger ones
count as this."""

WHITE_SHARE = 0.03  # Share of the errors' variance that is taken as white, so that errors can be whitened

MIN_HELD = 0.01  # Least load that counts by which dry friction holds a joint, over that of the unexplained load

HELD_ERROR = 0.05
"""Deviation of the load that dry friction takes where a joint may be at rest, over the friction: the instant at which
the joint comes free is known to a period."""

MIN_WEIGHT = 1e-3  # of an instant at rest where the size of a moving joint's errors is fitted

MIN_DISTINCT = 0.15  # Least share of a bump's information that columns and other bumps leave to it

ANY_SHAPE_PRIOR = 5.0
"""Prior standard deviation of a push's load at an instant, over its peak, where its impulse is measured."""

BUMP_PRIOR = 7.0  # Prior standard deviation of a bump's height, over that of the unexplained load


def pushes(
    recording: Recording, world: World | Sequence[World], unexplained: Sequence[SmoothFunction] = ()
) -> tuple[Push, ...]:
    """The pushes in a recording beyond what a world, or one for each episode, explains; in the order of time.

    Of the loads that are `unexplained`, the most probable first, the first that is a clear function of states, or of a
    command, is no push.
    """
    functions = (one for one in unexplained if one.is_of_motion and one.log_odds > CLEAR_LOG_ODDS)
    worlds = [world] * len(recording.episodes) if isinstance(world, World) else world
    try:
        tracks = load_tracks(recording, worlds, next(functions, None))
        if not tracks:
            return ()
        widths = [width * worlds[0].system.prediction_time for width in WIDTHS]
        found = _Fit(tracks, widths).pushes()
    except torch.linalg.LinAlgError:  # type: ignore[attr-defined]
        return ()  # errors too small, or too large, for any push to stand out
    middles = sum(float(track.time[-1] - track.time[0]) / (SPACING * width) for track in tracks for width in widths)
    tries = round(middles) * tracks[0].load.shape[1]
    named = [summed(bumps, *impulse, tracks, worlds[0].system.loads, tries) for bumps, impulse in found]
    sure = [push for push in named if push.p_value <= MAX_P_VALUE and push.ci90[0] * push.ci90[1] > 0]
    return tuple(sorted(sure, key=lambda push: (push.episode, push.start)))


def _held(track: LoadTrack, friction: Tensor) -> Tensor:
    """(K, N, J) loads by which dry friction (N, J) may hold each joint where it is at rest, K times one instant of one
    joint: together a random load of the friction's size, smoothed as the track is."""
    size = friction * track.at_rest
    kernel = torch.exp(-0.5 * ((track.time - track.time[:, None]) / track.smoothing).square())
    kernel = kernel / kernel.square().sum(0).sqrt()
    instants, joints = (size > MIN_HELD).nonzero(as_tuple=True)
    held = torch.zeros(len(instants), *size.shape, dtype=torch.float64)
    held[torch.arange(len(instants)), :, joints] = kernel[instants] * size[instants, joints, None]
    return held


class _Fit:
    """Columns, errors and bumps, fitted to all parts of a recording together."""

    tracks: Sequence[LoadTrack]  # P parts, of N instants each (N differs), with J joints and K columns
    widths: Sequence[float]  # s, of the bumps that are tried
    bumps: list[Bump]  # B on a part
    residual: list[Tensor]  # P times (N, J): the load less all that is fitted
    weights: list[Tensor]  # P times (M,): of the columns, the loads held by dry friction, and the bumps
    roots: list[Tensor]  # P times (M, M): Cholesky factors of the weights' precision
    held: list[Tensor]  # P times (H, N, J): loads by which dry friction may hold a joint at rest (H differs)
    spread: list[Tensor]  # P times (N, J): deviation of the errors
    autoregression: Tensor  # (J, LAGS) of the errors over their deviation
    innovation: Tensor  # (J,) deviation of what the autoregression leaves
    first: Tensor  # (J, LAGS, LAGS) Cholesky factors of the covariances of a part's first errors, which follow none

    def __init__(self, tracks: Sequence[LoadTrack], widths: Sequence[float]) -> None:
        self.tracks, self.widths = tracks, widths
        self.bumps = []
        joints = tracks[0].load.shape[1]
        # At first all of the load, so that `_design` takes the columns along the world's motion: along the measured
        # motion, one factor common to all columns would explain a push away.
        self.residual = [track.load.clone() for track in tracks]
        self.weights = [torch.zeros(0, dtype=torch.float64) for _ in tracks]
        self.roots = [torch.zeros(0, 0, dtype=torch.float64) for _ in tracks]
        self.held = [_held(track, track.friction) for track in tracks]
        self.spread = [torch.ones_like(track.load) for track in tracks]
        self.autoregression = torch.zeros(joints, LAGS, dtype=torch.float64)
        self.innovation = torch.ones(joints, dtype=torch.float64)
        self.first = torch.eye(LAGS, dtype=torch.float64).repeat(joints, 1, 1)

    def pushes(self) -> list[tuple[list[Bump], tuple[float, float]]]:
        """The bumps that stand out clearly, those that overlap together, with their impulse and its deviation."""
        self._fit(ROUNDS)
        searched: Sequence[int] = range(len(self.tracks))
        for k in range(MAX_BUMPS):
            needed = MIN_SCORE_FURTHER if k else MIN_SCORE_FIRST
            found = [one for part in searched if (one := self._highest(part)).score > needed]
            if not found:
                break
            self.bumps += found
            searched = [one.part for one in found]
            self._fit(ROUNDS_AGAIN)
        self._refine()
        while self.bumps:
            self.bumps = self._measured()
            weakest = {
                one.part: one for one in sorted(self.bumps, key=lambda one: -one.score) if one.score < MIN_SCORE_PUSH
            }
            if not weakest:
                break
            self.bumps = [one for one in self.bumps if one not in weakest.values()]
            self._fit(ROUNDS_AGAIN)
        return [(group, self._impulse(group)) for group in overlapping(self.bumps)]

    def _refine(self) -> None:
        """Choose middle and width of each bump that overlaps no other again: the errors are better known by now.

        In each step one bump of every part.
        """
        alone = [group[0] for group in overlapping(self.bumps) if len(group) == 1]
        while alone:
            chosen = list({one.part: one for one in alone}.values())
            alone = [one for one in alone if one not in chosen]
            self.bumps = [one for one in self.bumps if one not in chosen]
            self._weigh(robust=True)
            self.bumps += [self._highest(one.part, near=one) for one in chosen]
        if self.bumps:
            self._fit(ROUNDS_AGAIN)

    def _design(self, part: int) -> Tensor:
        """(K, N, J) loads of unit prior deviation: of columns, of dry friction at rest, and of this part's bumps."""
        track = self.tracks[part]
        columns = track.columns - torch.einsum("knij,nj->kni", track.reaction, self.residual[part])
        bumps = [BUMP_PRIOR * one.on(track) for one in self.bumps if one.part == part]
        return torch.cat((COLUMN_PRIOR * columns, self.held[part], *(one[None] for one in bumps)))

    def _whitened(self, part: int, values: Tensor) -> Tensor:
        """Loads (..., N, J) over the errors' deviation, less their autoregressive prediction; (..., N J)."""
        values = values / self.spread[part]
        out = values.clone()
        for lag, factor in enumerate(self.autoregression.unbind(1), 1):
            out[..., lag:, :] -= factor * values[..., :-lag, :]
        out = out / self.innovation
        first = values[..., :LAGS, :].movedim(-1, -2)[..., None]  # (..., J, LAGS, 1)
        out[..., :LAGS, :] = torch.linalg.solve_triangular(self.first, first, upper=False)[..., 0].movedim(-2, -1)
        return out.flatten(-2)

    def _fit(self, rounds: int) -> None:
        for k in range(rounds):
            self._weigh(robust=bool(self.weights[0].numel()) and k > 0)
            self._size_errors()
        self._weigh(robust=True)

    def _weigh(self, robust: bool) -> None:
        """Fit the weights of columns and bumps, given the size of the errors: a part's weights have a prior about those
        common to all parts."""
        count = len(self.tracks[0].columns)
        identity = torch.eye(count, dtype=torch.float64)
        several = len(self.tracks) > 1
        total, along = identity.clone(), torch.zeros(count, dtype=torch.float64)
        problems = []
        for part, track in enumerate(self.tracks):
            design, target = self._whitened(part, self._design(part)), self._whitened(part, track.load)
            weighted = design * self._huber(part) if robust else design
            normal, gradient = weighted @ design.T, weighted @ target
            problems.append((normal, gradient))
            if several:
                # With the bumps eliminated, and the part's own weights free to differ from those of all.
                bumps = normal[count:, count:] + torch.eye(len(normal) - count, dtype=torch.float64)
                gone = torch.linalg.solve(bumps, normal[count:, :count]).mT
                normal = normal[:count, :count] - gone @ normal[count:, :count]
                gradient = gradient[:count] - gone @ gradient[count:]
                inner = identity + EPISODE_PRIOR**2 * normal
                total, along = total + torch.linalg.solve(inner, normal), along + torch.linalg.solve(inner, gradient)
        common = torch.linalg.solve(total, along)
        for part, (normal, gradient) in enumerate(problems):
            precision = torch.ones(len(normal), dtype=torch.float64)
            if several:
                precision[:count] = EPISODE_PRIOR**-2
                gradient = gradient + pad(EPISODE_PRIOR**-2 * common, (0, len(normal) - count))
            self.roots[part] = torch.linalg.cholesky(normal + torch.diag(precision))
            self.weights[part] = torch.cholesky_solve(gradient[:, None], self.roots[part])[:, 0]
            explained = torch.einsum("k,knj->nj", self.weights[part], self._design(part))
            self.residual[part] = self.tracks[part].load - explained

    def _huber(self, part: int) -> Tensor:
        """(N J) weights of a part's errors, of which large ones count less."""
        error = self._whitened(part, self.residual[part]).abs()
        return (OUTLIER / error.clamp(min=1e-9)).clamp(max=1)

    def _size_errors(self) -> None:
        """How errors grow with activity, and their autoregression (Yule-Walker), joint by joint, where it moves.

        The residual is smaller than the errors, since the weights fit a part of them: the weights' covariance is added.
        """
        taken = [
            torch.linalg.solve_triangular(root, self._design(part).flatten(1), upper=False).unflatten(
                1, self.residual[part].shape
            )
            for part, root in enumerate(self.roots)
        ]
        activity = torch.cat([track.activity for track in self.tracks])
        basis = pad(activity - activity.mean(0), (1, 0), value=1.0)
        lengths = [len(track.time) for track in self.tracks]
        for j in range(len(self.innovation)):
            residual = [each[:, j] for each in self.residual]
            absorbed = [each[..., j] for each in taken]
            moving = (1 - torch.cat([track.at_rest[:, j] for track in self.tracks])).clamp(min=MIN_WEIGHT)
            most = MAX_POWER * torch.cat(residual).square()[moving >= moving.max() / 2].median()
            power = torch.cat(
                [
                    _local_mean(e.square().clamp(max=most) + v.square().sum(0))
                    for e, v in zip(residual, absorbed, strict=True)
                ]
            )
            deviations = (0.5 * _log_power(basis, power, moving)).exp().split(lengths)
            moments = torch.zeros(LAGS + 1, dtype=torch.float64)
            for part, (each, weight) in enumerate(zip(deviations, moving.split(lengths), strict=True)):
                track = self.tracks[part]
                held = HELD_ERROR * self._dry_friction(part)[:, j] * track.at_rest[:, j]
                self.spread[part] = self.spread[part].clone()
                self.spread[part][:, j] = torch.hypot(each, held)
                white, more = weight * (residual[part] / each).clamp(-3, 3), weight * absorbed[part] / each
                for lag in range(LAGS + 1):
                    end = len(each) - lag
                    moments[lag] += white[lag:] @ white[:end] + (more[:, lag:] * more[:, :end]).sum()
            moments = moments / moving.square().sum()
            moments[0] *= 1 + WHITE_SHARE
            lags = torch.arange(LAGS)
            covariance = moments[(lags[:, None] - lags).abs()]
            self.first[j] = torch.linalg.cholesky(covariance)
            self.autoregression[j] = torch.linalg.solve(covariance, moments[1:])
            self.innovation[j] = (moments[0] - self.autoregression[j] @ moments[1:]).clamp(min=1e-9).sqrt()
        self.held = [_held(track, self._dry_friction(part)) for part, track in enumerate(self.tracks)]

    def _dry_friction(self, part: int) -> Tensor:
        """(N, J) the size of each joint's dry friction: that of the world, and what is fitted beside it."""
        track, dry = self.tracks[part], list(self.tracks[part].dry)
        more = COLUMN_PRIOR * self.weights[part][dry].abs() * track.columns[dry].abs().amax((1, 2))
        return track.friction + more

    def _highest(self, part: int, near: Bump | None = None) -> Bump:
        """The bump on a part that stands out most beside what is fitted; if given, with its middle within `near`."""
        time, joints = self.tracks[part].time, self.tracks[part].load.shape[1]
        shape = (-1, len(time), joints)
        design = self._whitened(part, self._design(part)).unflatten(1, shape[1:])
        residual = self._whitened(part, self.residual[part]).unflatten(0, shape[1:])

        def best(joint: int, middles: Tensor, width: float) -> Bump:
            tried = bumps_at(self.tracks[part], middles, width)[..., None]
            shapes = self._whitened(part, pad(tried, (joint, joints - 1 - joint)))[:, joint::joints]
            shared = torch.linalg.solve_triangular(self.roots[part], design[..., joint] @ shapes.mT, upper=False)
            alone = shapes.square().sum(1)
            information = (alone - shared.square().sum(0)).clamp(min=MIN_DISTINCT * alone)
            height = shapes @ residual[:, joint] / information
            k = int((height.abs() * information.sqrt()).argmax())
            return Bump(part, joint, float(middles[k]), width, float(height[k]), float(information[k] ** -0.5))

        on = range(joints) if near is None else (near.joint,)

        def middles(width: float) -> Tensor:
            first, last = float(time[0]) + width, float(time[-1]) - width
            if near is not None:
                first, last = max(first, near.middle - 2 * near.width), min(last, near.middle + 2 * near.width)
            return torch.arange(first, last, SPACING * width, dtype=torch.float64)

        tried = (best(joint, middles(width), width) for width in self.widths for joint in on)
        return max(tried, key=lambda one: one.score)

    def _impulse(self, group: Sequence[Bump]) -> tuple[float, float]:
        """The impulse of some overlapping bumps on a part, over the load's root mean square, and its standard
        deviation: of a load of any shape in their place. Columns that a push makes large, by throwing states far out,
        would explain part of a bump."""
        part, joint = group[0].part, group[0].joint
        track, design = self.tracks[part], self._design(part)
        bumps = [one for one in self.bumps if one.part == part]  # the last rows of the design
        kept = torch.tensor([True] * (len(design) - len(bumps)) + [one not in group for one in bumps])
        during = torch.zeros(len(track.time), dtype=torch.bool)
        for one in group:
            during |= (track.time - one.middle).abs() <= EDGE * one.width
        step = float(track.time.diff().mean())
        prior = ANY_SHAPE_PRIOR * max(abs(one.height) for one in group)
        free = torch.zeros(int(during.sum()), *track.load.shape, dtype=torch.float64)
        free[..., joint] = prior * bumps_at(track, track.time[during], step / math.sqrt(2 * math.pi))
        design = self._whitened(part, torch.cat((design[kept], free)))
        weighted = design * self._huber(part)
        # Columns have no prior from the other parts, whose pushes the bumps may have left to them.
        root = torch.linalg.cholesky(weighted @ design.T + torch.eye(len(design), dtype=torch.float64))
        weights = torch.cholesky_solve((weighted @ self._whitened(part, track.load))[:, None], root)[:, 0]
        areas = pad(torch.full((len(free),), prior * step, dtype=torch.float64), (len(design) - len(free), 0))
        deviation = torch.linalg.solve_triangular(root, areas[:, None], upper=False).square().sum().sqrt()
        return float(areas @ weights), float(deviation)

    def _measured(self) -> list[Bump]:
        """The bumps with their heights as fitted together."""
        out = []
        for part in range(len(self.tracks)):
            bumps = [one for one in self.bumps if one.part == part]
            if not bumps:
                continue
            deviation = BUMP_PRIOR * torch.cholesky_inverse(self.roots[part]).diagonal().sqrt()
            heights = BUMP_PRIOR * self.weights[part]
            for k, one in enumerate(bumps, len(heights) - len(bumps)):
                out.append(replace(one, height=float(heights[k]), deviation=float(deviation[k])))
        return out


def _log_power(basis: Tensor, power: Tensor, weight: Tensor) -> Tensor:
    """Logs (N,) of an expected power that grows with the columns of `basis` (N, F), the first of which is 1; fitted
    with a weight (N,) for each row."""
    logs = (power + 1e-4 * power.mean()).log()
    ridge = torch.full((basis.shape[1],), 24.0, dtype=torch.float64)
    ridge[0] = 0.0
    weighted = weight[:, None] * basis
    slopes = torch.linalg.solve(basis.T @ weighted + torch.diag(ridge), weighted.T @ logs)
    expected = basis @ torch.cat((slopes[:1], slopes[1:].clamp(min=0)))
    return expected + ((power / expected.exp()).clamp(max=MAX_POWER) @ weight / weight.sum()).log()


def _local_mean(values: Tensor) -> Tensor:
    """Values (N,) averaged over NEIGHBOURS on either side."""
    padded = pad(values[None], (NEIGHBOURS, NEIGHBOURS), mode="replicate")
    return avg_pool1d(padded, 2 * NEIGHBOURS + 1, 1)[0]
