"""What a recording would show: simulated motion, separations of causes, information.

As discovery will, the simulated recording is cut into segments with uncertain initial states. Let
r be the difference between what cause a simulates and what b does, J the derivatives of b by its
parameters, C the covariance of the residuals with the initial states integrated out, and P the
precision of b's parameters after the recordings so far. With refitted parameters

    d² = (r − J s)ᵀ C⁻¹ (r − J s) + sᵀ P s,        s = (Jᵀ C⁻¹ J + P)⁻¹ Jᵀ C⁻¹ r

which adds to the squared separation along the recordings so far. The gain of information about the
parameters of one cause is ½ log det(P⁻¹ (Jᵀ C⁻¹ J + P)).
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.discovery.screening.permutation_tests import block_sums
from npdr_ppl.errors import DataError, NpdrError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.sites import SimulatorBlackBox
from npdr_ppl.planning.causes import Cause, Known, prior_of
from npdr_ppl.planning.limits import Limits
from npdr_ppl.planning.separations import Shown, apart, information_gain
from npdr_ppl.planning.settings import PLANNING
from npdr_ppl.preparation.data_options import DataOptions, default_segment_length
from npdr_ppl.preparation.initial_states import InitialStates
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.states import estimate_states

__all__ = ["Judge", "Played"]

Array = NDArray[np.float64]


_RANGE_OF_NOISE = 10.0
"""Standard deviations between the greatest and the least of a million measurements at rest."""


@dataclass(frozen=True)
class Played:
    """Candidates and what every cause simulates.

    Attributes:
        commands: The commands, ``(E, T, A)``.
        start: Measured values at the start, ``(E, C)``.
        readings: Simulated measurements after each step, ``(n, E, T, C)``.
    """

    commands: Array
    start: Array
    readings: Array

    def chosen(self, index: Sequence[int]) -> "Played":
        """Returns some of the candidates."""
        return Played(self.commands[index], self.start[index], self.readings[:, index])

    @classmethod
    def joined(cls, parts: Sequence["Played"]) -> "Played":
        """Returns the candidates of several parts, in their order."""
        return cls(
            np.concatenate([part.commands for part in parts]),
            np.concatenate([part.start for part in parts]),
            np.concatenate([part.readings for part in parts], axis=1),
        )


class Judge:
    """Simulates candidates in every cause and predicts what they would show.

    Args:
        known: The causes and what is known of them, at the time step of the limits.
        limits: The limits.
        seed: Seed of the simulated noise, from which the errors of initial states follow.

    Attributes:
        batch: Number of candidates that are judged together.
        most_shown: Greatest number of candidates whose segments are all judged, in both directions
            of every pair, for the best ones and for random ones.
        num_simulated: Number of simulations so far.
        failure: The last message of a simulator that failed; empty if none did.
    """

    def __init__(self, known: Known, limits: Limits, seed: int) -> None:
        self.known = known
        self.limits = limits
        self.channels = tuple(limits.channels)
        self.actions = tuple(limits.actions)
        self.scale = torch.tensor([c.noise for c in limits.channels.values()]).double()
        # Short recordings have shorter segments, but here several are judged together.
        self._options = DataOptions(
            embedding=None,
            initial_state="recorded",  # they are set by _starts
            commands_before="zero",
            segment_length=known.segment_length or self._default_length(),
        )
        shape = (PLANNING.num_noises, limits.num_steps + 1, len(self.channels))
        self._noise = np.random.default_rng(seed).standard_normal(shape) * self.scale.numpy()
        self._boxes = [_box(cause, known.time_step) for cause in known.causes]
        self.num_simulated = 0
        self.failure = ""
        self.batch, self._every, self.most_shown = self._work()
        self._start_errors: tuple[Array, ...] | None = None

    def _work(self) -> tuple[int, int, int]:
        """Returns how many candidates are judged together, each how many-th segment, and in full.

        The last is how many may be judged with all segments at the end.
        """
        num, limits = len(self.known.causes), self.limits
        comparisons = num if self.known.is_prior else num * (num - 1) // 2
        runs = 1 + max(len(cause.z) for cause in self.known.causes) + len(self.channels)
        steps = max(1, comparisons) * runs * limits.num_steps
        num_segments = len(self._first_steps)
        most = max(1, num_segments // PLANNING.fewest_segments)
        every = min(most, -(-PLANNING.batch * steps // PLANNING.most_steps))
        batch = min(PLANNING.batch, max(2, every * PLANNING.most_steps // steps))
        return batch, every, max(1, min(PLANNING.pool, PLANNING.most_steps // steps))

    def _default_length(self) -> int:
        """Returns the steps of a segment with which one such recording of a fast motion is cut."""
        steps = self.limits.num_steps
        return default_segment_length(
            self._recorded(
                np.zeros((1, steps + 1, len(self.channels))),
                np.zeros((1, steps, len(self.actions))),
            )
        )

    @property
    def _first_steps(self) -> NDArray[np.int64]:
        """The step at which each segment of a candidate begins, ``(S,)``."""
        length = self._options.segment_length
        assert isinstance(length, int)
        return np.arange(0, self.limits.num_steps, length)

    def played(self, commands: Array, start: Array) -> Played:
        """Simulates candidates in every cause; failed simulations are NaN.

        Args:
            commands: Commands, ``(E, T, A)``.
            start: Measured values at the start, ``(E, C)``.
        """
        inputs = self._inputs(commands, start)
        made = [self._simulated(box, inputs) for box in self._boxes]
        self.num_simulated += len(made) * len(commands)
        return Played(commands, start, np.stack(made))

    def violation(self, played: Played) -> Array:
        """Returns by how much the worst cause exceeds the limits, ``(E,)``; at most 0 if none.

        It is the greatest ratio of a quantity to its limit, less one; infinite if a simulation
        fails.
        """
        worst = np.full(len(played.commands), -1.0)
        step = self.limits.time_step
        for k, channel in enumerate(self.limits.channels.values()):
            path = self._paths(played)[..., k]
            rate = np.diff(path) / step
            acceleration = np.diff(rate) / step
            is_bounded = math.isfinite(channel.max - channel.min)
            middle = 0.5 * (channel.min + channel.max) if is_bounded else 0.0
            starts = np.array([channel.start_min, channel.start_max]) - middle
            for values, least, greatest, (first, last) in (
                (path - middle, channel.min - middle, channel.max - middle, starts),
                (rate, -channel.max_rate, channel.max_rate, (0.0, 0.0)),
                (acceleration, -channel.max_acceleration, channel.max_acceleration, (0.0, 0.0)),
            ):
                room = (1.0 - PLANNING.margin) * np.array([least, greatest])
                # A pose from which it may start keeps the limits, also without a margin.
                room = min(room[0], first), max(room[1], last)
                with np.errstate(invalid="ignore"):
                    ratio = np.maximum(
                        values.max((0, -1)) / max(room[1], 1e-300),
                        values.min((0, -1)) / min(room[0], -1e-300),
                    )
                worst = np.maximum(worst, np.nan_to_num(ratio, nan=math.inf) - 1.0)
        return np.where(np.isfinite(played.readings).all((0, 2, 3)), worst, math.inf)

    def differing_changes(self, played: Played, others: Known) -> Array:
        """Returns how differently causes change if each gets another model, ``(n, E)``.

        It is the size of a cause's change without the mean one, in standard deviations of the
        measurements, along the segments of a candidate; NaN where the other model fails.

        Args:
            played: The candidates.
            others: The causes with the other models.
        """
        changes = []
        for k, cause in enumerate(self.known.causes):
            simulated = []
            for each in (cause, others.causes[k]):
                segments = self._segments(each, played, k, 1)
                simulated.append(segments.simulate(each.z[None], segments.no_offsets[None])[0])
            scale = self.scale[[self.channels.index(name) for name in segments.channel_names]]
            changes.append(segments.whitened(simulated[0] - simulated[1], scale))
        every = torch.stack(changes).unflatten(1, (len(played.commands), -1))
        squares = (every - every.mean(0)).square().sum((-2, -1))
        return (self.known.share * squares).sqrt().numpy()

    def shown(self, played: Played) -> Shown:
        """Returns what candidates would show of every pair of causes, in both directions."""
        pairs = itertools.permutations(range(len(self.known.causes)), 2)
        return Shown(
            {(a, b): self._blocks(played, a, b, every=1) for a, b in pairs},
            [cause.precision for cause in self.known.causes],
        )

    def certainty(self, played: Played) -> Array:
        """Returns how well each candidate tells the causes apart, ``(E,)``; more is better.

        It is minus the log of a bound on the probability of choosing the wrong cause, the sum of

            √(p_a p_b) Π_k (1 + d_k²/8)⁻¹

        over all pairs. With the squared separation d², exp(-d²/8) would bound it (Bhattacharyya
        1943). But discovery resamples the evidence over blocks k of segments, and trusts little in
        evidence that few blocks have: E exp(-Σ w_k d_k²/8) with exponential weights w_k. A pair
        that no recording separates does not keep the others from being separated.
        """
        likely, every = self.known.probabilities, self._every
        with np.errstate(invalid="ignore"):  # of candidates that cannot be judged
            terms = [
                0.5 * math.log(likely[a] * likely[b])
                - every * np.log1p(self._separation(played, a, b, every=every) / 8.0).sum(0)
                for a, b in itertools.combinations(range(len(likely)), 2)
            ]
            return -np.logaddexp.reduce(terms, axis=0)

    def precisions(self, played: Played, cause: int, *, every: int = 1) -> Tensor:
        """Returns the precision of a cause's coordinates after each candidate, ``(E, d, d)``.

        Args:
            played: The candidates.
            cause: Index of the cause.
            every: Each how many-th segment is simulated; it stands for the others.
        """
        return self.information(played, cause, every=every) + self.known.causes[cause].precision

    def information(self, played: Played, cause: int, *, every: int = 1) -> Tensor:
        """Returns what each candidate adds to a cause's precision, ``(E, d, d)``."""
        products = every * self._products(played, cause, cause, every=every).sum(1)
        return self.known.share * products[:, :-1, :-1]

    def gains(self, played: Played) -> Array:
        """Returns the gain of information in nats, averaged over the causes, ``(E,)``."""
        total = np.zeros(len(played.commands))
        for index, cause in enumerate(self.known.causes):
            try:
                after = self.precisions(played, index, every=self._every)
            except NpdrError:
                return np.full(len(played.commands), -math.inf)
            total += information_gain(cause.precision, after).numpy() / len(self.known.causes)
        return total

    def _separation(self, played: Played, a: int, b: int, *, every: int) -> Array:
        """Returns the squared separation of b from a, ``(blocks, E)``, by block of segments."""
        try:
            products = self._blocks(played, a, b, every=every)
        except NpdrError:
            return np.full((1, len(played.commands)), -math.inf)
        return apart(products, self.known.causes[b].precision, every).mT.numpy()

    def _blocks(self, played: Played, a: int, b: int, *, every: int) -> Tensor:
        """Returns the products by block of segments, ``(E, blocks, d + 1, d + 1)``."""
        products = self.known.share * self._products(played, a, b, every=every)
        return block_sums(products.transpose(0, 1)).transpose(0, 1)

    def _products(self, played: Played, a: int, b: int, *, every: int) -> Tensor:
        """Returns (J r)ᵀ C⁻¹ (J r) of segments of each candidate, ``(E, S, d + 1, d + 1)``.

        J are the derivatives of cause b along what a simulates, and r is their difference.
        """
        refitted, made = self.known.causes[b], self.known.causes[a]
        segments = self._segments(refitted, played, a, every)
        if a != b:
            # From the same initial states, so that a cause does not differ from itself.
            own = self._segments(made, played, a, every)
            segments.observed = own.simulate(made.z[None], own.no_offsets[None])[0]
        scale = self.scale[[self.channels.index(name) for name in segments.channel_names]]
        now = segments.linearise(refitted.z, segments.no_offsets, scale, is_rough=True)
        if not now.is_finite:
            raise DataError(f"{refitted.name} cannot be simulated along a candidate.")
        both = torch.cat((now.by_parameters, now.residual[..., None]), dim=-1)
        joined = replace(now, by_parameters=both)
        products = joined.by_parameters.mT @ joined.weights()
        products = products.unflatten(0, (len(played.commands), -1))
        return self._trust(played, a)[:, None, None, None] * products

    def _trust(self, played: Played, cause: int) -> Tensor:
        """Returns the weights of candidates, less than 1 for tiny motions, ``(E,)``.

        Models are fitted to larger motions. Near standstill, friction differs from its models.
        """
        ranges = (self.known.recorded or {}).get("channels", {})
        reach = np.ptp(self._paths(played)[cause], axis=1)
        shares = []
        for k, (name, channel) in enumerate(self.limits.channels.items()):
            limit = channel.max - channel.min
            if name in ranges:
                recorded = ranges[name]["max"] - ranges[name]["min"]
                # Of a joint that rested, nothing says how far it usually moves.
                is_known = recorded > _RANGE_OF_NOISE * channel.noise
                usual = min(recorded, limit) if is_known else limit
                shares.append(reach[:, k] / max(usual, 1e-300))
        if not shares:
            return torch.ones(len(reach), dtype=torch.float64)
        moves = np.max(shares, axis=0) / PLANNING.least_motion
        return torch.tensor(np.minimum(1.0, moves) ** 2)

    def _segments(self, cause: Cause, played: Played, a: int, every: int) -> SegmentModel:
        """Returns a cause along segments of what cause a simulates."""
        paths = self._paths(played)[a]
        segments = SegmentModel(
            cause.model,
            self._recorded(paths, played.commands),
            self._options,
            self._starts(paths),
            is_complete=True,
        )
        chosen = torch.arange(segments.inputs.num_segments).unflatten(0, (len(paths), -1))
        # Those in the middle of the parts: at the beginning nothing moves.
        return segments.along(chosen[:, every // 2 :: every].flatten())

    def _starts(self, paths: Array) -> InitialStates:
        """Returns the initial states of all segments, with the errors of noisy measurements."""
        first = self._first_steps
        rates = np.gradient(paths, self.limits.time_step, axis=1)
        rates[:, 0] = 0.0  # at rest
        if self._start_errors is None:
            self._start_errors = self._smoothed_errors(paths[: PLANNING.num_smoothed])
        values, rates = (part[:, first].reshape(-1, paths.shape[-1]) for part in (paths, rates))
        return InitialStates(
            torch.tensor(values),
            torch.tensor(rates),
            *(torch.tensor(error).repeat(len(paths), 1) for error in self._start_errors),
        )

    def _smoothed_errors(self, paths: Array) -> tuple[Array, ...]:
        """Returns typical errors of values and rates at the start of each segment, ``(S, C)``.

        At the beginning of a rollout, states are estimated from one side only.

        Args:
            paths: Measurements of some candidates without noise, ``(n, T + 1, C)``.
        """
        first, step = self._first_steps, self.limits.time_step
        found = [estimate_states(path + self._noise[0], first, step) for path in paths]
        begun = [
            estimate_states(path + noise, first[:1], step)
            for path in paths
            for noise in self._noise
        ]
        result = []
        for name in ("value_errors", "rate_errors"):
            typical = np.median(np.concatenate([getattr(part, name) for part in found]), axis=0)
            errors = np.tile(typical, (len(first), 1))
            errors[0] = np.median(np.concatenate([getattr(part, name) for part in begun]), axis=0)
            result.append(errors)
        return tuple(result)

    def _recorded(self, paths: Array, commands: Array) -> Rollouts:
        """Returns a recording of measurements ``(E, T + 1, C)``."""
        return Rollouts.from_arrays(
            list(paths),
            list(commands),
            channel_names=self.channels,
            action_names=self.actions,
            time_step=self.limits.time_step,
        )

    def _paths(self, played: Played) -> Array:
        """Returns the measurements including those at the start, ``(n, E, T + 1, C)``."""
        num = len(played.readings)
        start = np.broadcast_to(played.start, (num, *played.start.shape))[:, :, None]
        return np.concatenate((start, played.readings), axis=2)

    def _inputs(self, commands: Array, start: Array) -> Inputs:
        """Returns one segment per candidate that starts at rest."""
        actions, values = torch.tensor(commands), torch.tensor(start)
        num, steps, _ = commands.shape
        before = torch.tensor([a.start for a in self.limits.actions.values()]).double()
        history = min(steps, round(1.0 / self.limits.time_step))
        return Inputs(
            actions=actions,
            action_names=self.actions,
            initial_readings=values,
            initial_values=values,
            channel_names=self.channels,
            past_actions=before.expand(num, history, -1),
            time_step=self.limits.time_step,
            mask=torch.ones(num, steps, dtype=torch.bool),
            rollout=torch.arange(num),
            start=torch.zeros(num, dtype=torch.long),
            initial_rates=torch.zeros_like(values),
        )

    def _simulated(self, box: SimulatorBlackBox, inputs: Inputs) -> Array:
        """Returns simulated measurements, ``(E, T, C)``, NaN if the simulation fails."""
        names = [sensor.name for sensor in box.simulator.sensors]
        try:
            simulated = box.simulator.simulate(box.parameters, inputs)
        except NpdrError as error:
            self.failure = str(error)
            return np.full((*inputs.actions.shape[:2], len(self.channels)), math.nan)
        simulated = simulated.reshape(inputs.num_segments, inputs.num_steps, len(names)).double()
        return simulated[..., [names.index(name) for name in self.channels]].numpy()


def _box(cause: Cause, time_step: float) -> SimulatorBlackBox:
    """Returns a cause's simulator with its parameters."""
    (box,) = prior_of(cause.model, time_step).black_boxes_at(cause.z[None]).values()
    assert isinstance(box, SimulatorBlackBox)
    return box
