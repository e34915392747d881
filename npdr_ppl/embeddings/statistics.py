"""Embeddings without a trained network: summary statistics and the measurements themselves."""

from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.embeddings.base import Embedding, check_trajectory, states_of
from npdr_ppl.errors import ShapeError
from npdr_ppl.language.inputs import Inputs

__all__ = ["AllSteps", "BayesSimStatistic", "Differences", "LastStep"]


@dataclass(frozen=True)
class BayesSimStatistic(Embedding):
    """Correlations of actions with state differences, and the differences' mean and variance.

    With S the measurements before each step, D their differences to the next measurement and A the
    actions of the same steps, the features of a rollout are ``AᵀD`` (a plain sum over its steps,
    actions by channels), the mean of D and the biased variance of D. The steps of all segments of
    a rollout are pooled; no difference is taken between two segments. The features of several
    rollouts are concatenated, so F = R (A·C + 2·C).

    References:
        F. Ramos et al., BayesSim: adaptive domain randomization via probabilistic inference for
        robotics simulators, 2019, section IV; the pooling over segments is our addition.
    """

    def features(self, trajectory: Tensor, inputs: Inputs) -> Tensor:
        """Returns the statistic, ``(B, R (A·C + 2·C))``."""
        mask = inputs.mask.to(trajectory.device)
        differences = torch.diff(states_of(trajectory, inputs), dim=2)
        differences = torch.where(mask[..., None], differences, 0.0)
        # Padding may be anything in the actions; a product with a zero difference removes it.
        actions = torch.where(mask[..., None], inputs.actions.to(trajectory), 0.0)
        actions = actions.expand(len(trajectory), *actions.shape[-3:])
        result = []
        for rollout in torch.unique(inputs.rollout).tolist():
            rows = torch.nonzero(inputs.rollout == rollout)[:, 0].to(trajectory.device)
            d, a = differences[:, rows].flatten(1, 2), actions[:, rows].flatten(1, 2)
            valid = mask[rows].flatten()
            if not bool(valid.any()):
                raise ShapeError(f"rollout {rollout} has no step left to take statistics of.")
            mean = d.sum(1) / valid.sum()
            deviation = torch.where(valid[:, None], d - mean[:, None], 0.0)
            variance = deviation.square().sum(1) / valid.sum()
            result += [(a.mT @ d).flatten(1), mean, variance]
        return torch.cat(result, dim=1)


@dataclass(frozen=True)
class LastStep(Embedding):
    """The last measurement of every segment, F = S·C."""

    def features(self, trajectory: Tensor, inputs: Inputs) -> Tensor:
        """Returns the last measurements, ``(B, S·C)``."""
        check_trajectory(trajectory, inputs)
        steps = torch.arange(1, inputs.num_steps + 1) * inputs.mask.cpu()
        last = (steps.amax(-1) - 1).to(trajectory.device)
        if bool((last < 0).any()):
            raise ShapeError("a segment has no step left, so it has no last measurement.")
        index = last[None, :, None, None].expand(len(trajectory), -1, 1, trajectory.shape[-1])
        return trajectory.gather(2, index).flatten(1)


@dataclass(frozen=True)
class AllSteps(Embedding):
    """All measurements, one segment after another; use a stride for long rollouts: ``all/10``."""

    def features(self, trajectory: Tensor, inputs: Inputs) -> Tensor:
        """Returns the measurements of the steps that exist, ``(B, (valid steps)·C)``."""
        check_trajectory(trajectory, inputs)
        return trajectory[:, inputs.mask.to(trajectory.device)].flatten(1)


@dataclass(frozen=True)
class Differences(Embedding):
    """All differences between consecutive measurements of a segment, from the initial one on."""

    def features(self, trajectory: Tensor, inputs: Inputs) -> Tensor:
        """Returns the differences of the steps that exist, ``(B, (valid steps)·C)``."""
        differences = torch.diff(states_of(trajectory, inputs), dim=2)
        return differences[:, inputs.mask.to(trajectory.device)].flatten(1)
