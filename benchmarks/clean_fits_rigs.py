"""Recordings of the zoo's rigs under parameters drawn from their models' priors.

The truth is made by :mod:`hidden_rigs`: equations written a second time, integrated by Runge-Kutta
in steps of 1 ms or less. A new user's recording is imitated: four rollouts of a few seconds, an
excitation that keeps the rig within its limits, encoders that count and velocities that hiss.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pyro
import torch
from hidden_rigs import RIGS, Hidden
from hidden_rigs.mechanics import Array
from hidden_rigs.recording import Recording, record
from hidden_rigs.rig import Rig
from pyro.distributions import Uniform

from npdr_ppl.errors import DataError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.models import zoo
from npdr_ppl.randomness import derived_seed

__all__ = ["EXCITATIONS", "RIG_SUBJECTS", "RigSubject", "prior_ranges", "record_rig"]

EXCITATIONS = ("multisine", "steps", "chirp", "multisine")
"""Excitation of each rollout; the last is held out."""

DURATION = 4.0
"""Seconds per rollout."""

MOST_OF_LIMIT = 0.9
"""Share of a limit that motion may use: a user who hits the stop records again with less."""

WEAKENING, TRIES = 0.7, 16
"""Factor on excitation and starts where motion exceeds a limit, and how often it is applied: at
0.7¹⁵, half a per cent of the excitation is left."""


@dataclass(frozen=True)
class RigSubject:
    """A rig to be fitted by a model of the zoo.

    Attributes:
        model: The model's name in the zoo.
        rig: The rig; its ``unknown`` parameters are those that the model infers.
        limits: Greatest magnitude of each position, then of each velocity, in SI units.
    """

    model: str
    rig: Rig
    limits: tuple[float, ...]


def _subject(
    model: str, *, time_step: float, substeps: int, limits: tuple[float, ...]
) -> RigSubject:
    """Returns a rig of the benchmark of discovery, at the sampling of a clean recording."""
    rig = RIGS[model]
    return RigSubject(
        model,
        replace(rig, time_step=time_step, substeps=substeps, duration=DURATION),
        tuple(MOST_OF_LIMIT * limit for limit in limits),
    )


RIG_SUBJECTS: dict[str, RigSubject] = {
    subject.model: subject
    for subject in (
        _subject("pendulum", time_step=0.02, substeps=20, limits=(12.5, 10.0)),
        _subject("furuta", time_step=0.002, substeps=4, limits=(2.0, 12.5, 62.0, 62.0)),
        _subject("cart_pole", time_step=0.01, substeps=10, limits=(3.0, 12.5, 4.0, 15.0)),
        _subject("emps", time_step=0.004, substeps=4, limits=(1.0, 0.6)),
        _subject("two_link_arm", time_step=0.005, substeps=8, limits=(6.0, 6.0, 15.0, 20.0)),
    )
}
"""The rigs by the name of their model. Limits are the model's where it has some, and speeds that
the sampling resolves elsewhere."""


@cache
def prior_ranges(model: str) -> Mapping[str, tuple[float, float]]:
    """Returns the ends of the uniform priors of a model of the zoo, by parameter.

    Raises:
        DataError: A prior is not uniform.
    """
    simulator = simulator_of(model)
    inputs = Inputs.single(
        torch.zeros(1, len(simulator.actions), dtype=torch.float64),
        torch.zeros(len(simulator.states), dtype=torch.float64),
        action_names=tuple(action.name for action in simulator.actions),
        state_names=tuple(state.name for state in simulator.states),
        time_step=simulator.time_step,
    )
    trace = pyro.poutine.trace(zoo()[model].model).get_trace(inputs)
    names = {parameter.name for parameter in simulator.parameters}
    ranges = {}
    for name in (name for name in trace.stochastic_nodes if name in names):
        fn: Any = trace.nodes[name]["fn"]
        if not isinstance(fn, Uniform):
            raise DataError(f"The prior of {name} in {model} is no Uniform but {fn}.")
        ranges[name] = (float(fn.low), float(fn.high))
    return ranges


def simulator_of(model: str) -> Simulator:
    """Returns a simulator of the kind that a model of the zoo has."""
    return RIG_SUBJECTS[model].rig.simulator()


def drawn_parameters(subject: RigSubject, seed: int) -> dict[str, float]:
    """Returns true values of what the model infers, drawn from its prior.

    From the whole prior: only then does a correct posterior's 90 % interval hold 90 % of the
    truths, also where the recording hardly informs a parameter.
    """
    generator = np.random.default_rng(derived_seed(seed, subject.model, "clean parameters"))
    return {
        name: float(generator.uniform(*ends)) for name, ends in prior_ranges(subject.model).items()
    }


def record_rig(
    subject: RigSubject,
    parameters: Mapping[str, float],
    *,
    seed: int,
    hidden: Sequence[Hidden] = (),
    is_noisy: bool = True,
    substeps: int | None = None,
) -> Recording:
    """Records four rollouts, the excitation weakened until all motion is within the limits.

    Args:
        subject: The rig.
        parameters: True values of what the model infers.
        seed: Seed of excitations, starts and noise.
        hidden: Effects that the model lacks.
        is_noisy: Whether readings have noise.
        substeps: Integration steps per sample; ``None`` for the subject's.

    Raises:
        DataError: However weak the excitation, the motion exceeds a limit.
    """
    factor = 1.0
    for _ in range(TRIES):
        rig = _driven_by(subject.rig, factor)
        recording = record(
            rig,
            EXCITATIONS,
            parameters={**rig.known, **parameters},
            hidden=hidden,
            measurement=rig.measurement if is_noisy else None,
            seed=derived_seed(seed, subject.model, "clean recording"),
            substeps=substeps,
        )
        if is_within(recording.true_states, subject.limits):
            return recording
        factor *= WEAKENING
    raise DataError(f"The motion of {subject.model} exceeds its limits under any excitation.")


def is_within(states: Array, limits: Sequence[float]) -> bool:
    """Returns whether all states ``(R, T + 1, channels)`` are within limits, one a channel."""
    return bool((np.abs(states).max((0, 1)) <= np.array(limits)).all())  # False where NaN


def _driven_by(rig: Rig, factor: float) -> Rig:
    return replace(
        rig,
        amplitudes=tuple(factor * amplitude for amplitude in rig.amplitudes),
        start_spread=tuple(factor * spread for spread in rig.start_spread),
    )
