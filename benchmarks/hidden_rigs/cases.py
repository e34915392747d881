"""Cases of the blind benchmark: recordings to explain, and the truth to judge by."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hidden_rigs.faults import FAULTS, spoilt
from hidden_rigs.furuta_engine import record_in_mujoco
from hidden_rigs.hidden import Hidden
from hidden_rigs.recording import record
from hidden_rigs.rig import Place, Rig
from hidden_rigs.rigs import RIGS
from hidden_rigs.sizes import drawn
from npdr_ppl.errors import ModelError
from npdr_ppl.randomness import derived_seed
from npdr_ppl.rollouts import Rollouts

__all__ = [
    "CONDITIONS",
    "Case",
    "Condition",
    "cases",
    "hold_out_again",
    "make_case",
    "places",
    "play",
]

Condition = Literal[
    "null",
    "null_noise3",
    "null_coloured",
    "null_outliers",
    "one",
    "two",
    "two_at_one_place",
    "three",
    "inseparable",
    "outside",
    "absorbed",
    "bad_data",
]
"""What is hidden: nothing, under four kinds of noise; one effect; two at different ports; two at
one joint or command; three at different ports; one of a class that the excitation cannot split;
one that no catalogue has; one that the model's parameters swallow; or nothing, in data that were
spoilt."""

CONDITIONS: tuple[Condition, ...] = get_args(Condition)
"""All conditions."""

_NULL_NOISE: tuple[Condition, ...] = ("null", "null_noise3", "null_coloured", "null_outliers")

FIT_EXCITATIONS = ("multisine", "steps", "multisine", "steps")
HOLDOUT_EXCITATIONS = ("chirp", "chirp")


@dataclass(frozen=True)
class Case:
    """One recording session of one rig.

    Attributes:
        rig: Name of the rig.
        model: The Pyro model under test.
        fit: Rollouts to find, name and fit the effect with.
        holdout: Rollouts of another excitation.
        truth: What is hidden; for bad data, what was done to them.
        alternatives: What these recordings cannot tell from the truth, each the names of effects
            that together take the truth's place; any of them, or all as a class, is right.
        condition: The condition.
        strength: Multiple of a typical size, or one for each effect.
        seed: The seed.
        parameters: True domain parameters.
    """

    rig: str
    model: Callable[..., Tensor]
    fit: Rollouts
    holdout: Rollouts
    truth: tuple[Hidden, ...]
    alternatives: tuple[tuple[str, ...], ...]
    condition: Condition
    strength: float | Sequence[float]
    seed: int
    parameters: Mapping[str, float]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what is hidden, ``"<port>.<effect>"``."""
        return tuple(hidden.name for hidden in self.truth)


def cases(
    condition: Condition,
    seeds: Sequence[int],
    rigs: Sequence[str] = tuple(RIGS),
    strengths: Sequence[float] = (1.0,),
) -> Iterator[Case]:
    """Records the cases of a condition one after the other.

    Every place of a rig gets every seed and every strength; ``two`` draws one pair per seed, and
    ``three`` one triple.

    Args:
        condition: What is hidden.
        seeds: Seeds; each stands for true parameters, excitations, starts and noise.
        rigs: Names of rigs.
        strengths: Multiples of a typical size; conditions that hide no effect ignore them.

    Raises:
        ModelError: There is no such condition or rig.
    """
    for name, seed in itertools.product(rigs, seeds):
        for chosen in places(name, condition, seed):
            for strength in strengths if chosen and condition != "bad_data" else (1.0,):
                yield make_case(name, condition, chosen, strength=strength, seed=seed)


def places(rig: str, condition: Condition, seed: int = 0) -> tuple[tuple[Place, ...], ...]:
    """Returns what the cases of a condition hide in a rig: places for each case.

    Args:
        rig: Name of the rig.
        condition: What is hidden.
        seed: Draws the effects of conditions ``two`` and ``three``.

    Raises:
        ModelError: There is no such condition or rig.
    """
    chosen = _rig(rig)
    if condition in _NULL_NOISE:
        return ((),)
    if condition == "bad_data":
        return tuple((("data", kind),) for kind in FAULTS)
    if condition == "two":
        return (_several(chosen, 2, "pair", seed),)
    if condition == "three":
        return (_several(chosen, 3, "triple", seed),)
    if condition == "two_at_one_place":
        return chosen.pairs
    groups: dict[str, Sequence[Place]] = {
        "one": chosen.effects,
        "inseparable": tuple(chosen.inseparable),
        "outside": chosen.outside,
        "absorbed": chosen.absorbed,
    }
    if condition not in groups:
        raise ModelError(
            f"There is no condition {condition!r}; there are {', '.join(CONDITIONS)}."
        )
    return tuple((place,) for place in groups[condition])


def make_case(
    rig: str,
    condition: Condition,
    hidden: Sequence[Place] = (),
    *,
    strength: float | Sequence[float] = 1.0,
    seed: int,
) -> Case:
    """Records one case.

    The seed alone decides the true parameters, excitations, starts and noise, and what is drawn
    of an effect besides its strength: cases that differ in strength differ in nothing else.

    Args:
        rig: Name of the rig.
        condition: The condition.
        hidden: What to hide; for bad data, ``("data", <kind>)``.
        strength: Multiple of a typical size, or one for each effect.
        seed: The seed.

    Raises:
        ModelError: There is no such rig or effect.
    """
    chosen = _rig(rig)
    generator = np.random.default_rng(derived_seed(seed, rig, "parameters"))
    parameters = dict(chosen.known)
    parameters |= {name: generator.uniform(*ends) for name, ends in chosen.unknown.items()}
    strengths = tuple(strength) if isinstance(strength, Sequence) else (strength,) * len(hidden)
    truth = tuple(
        drawn(
            chosen.port(port),
            effect_id,
            size,
            np.random.default_rng(derived_seed(seed, rig, "effect", port, effect_id)),
        )
        for (port, effect_id), size in zip(hidden, strengths, strict=True)
        if condition != "bad_data"
    )
    measurement = chosen.measurement
    if condition == "null_noise3":
        measurement = measurement.scaled(3.0)
    measurement = replace(
        measurement,
        is_coloured=condition == "null_coloured",
        has_outliers=condition == "null_outliers",
    )
    recorder = record_in_mujoco if chosen.engine == "mujoco" else record
    recording = recorder(
        chosen,
        (*FIT_EXCITATIONS, *HOLDOUT_EXCITATIONS),
        parameters=parameters,
        hidden=truth,
        measurement=measurement,
        is_from_rest=condition == "inseparable",
        seed=derived_seed(seed, rig, "recording"),
    )
    number = len(FIT_EXCITATIONS)
    rollouts = recording.rollouts
    for _, kind in hidden if condition == "bad_data" else ():
        rollouts, fault = spoilt(kind, rollouts, chosen.layout, derived_seed(seed, rig, kind))
        truth = (*truth, fault)
    return Case(
        rig=rig,
        model=chosen.model,
        fit=rollouts[:number],
        holdout=rollouts[number:],
        truth=truth,
        alternatives=_alternatives(chosen, condition, hidden),
        condition=condition,
        strength=strength,
        seed=seed,
        parameters=parameters,
    )


def play(
    case: Case, commands: NDArray[np.float64], start: NDArray[np.float64], *, seed: int
) -> Rollouts:
    """Records one more rollout of a case's rig, which is released at rest.

    Args:
        case: The case; its parameters and what is hidden stay.
        commands: The commands, ``(K, actions)``.
        start: Where it is released: values of its sensors, positions first.
        seed: Seed of the noise.

    Raises:
        ModelError: The rig is simulated by MuJoCo, which plays excitations only.
    """
    rig = _rig(case.rig)
    if rig.engine == "mujoco":
        raise ModelError(f"{rig.name} plays excitations only.")
    return record(
        rig,
        (),
        parameters=case.parameters,
        hidden=case.truth,
        measurement=rig.measurement,
        seed=derived_seed(seed, case.rig, "played"),
        played=(commands, start[: len(rig.layout.positions)]),
    ).rollouts


def hold_out_again(case: Case, *, seed: int) -> Rollouts:
    """Records excitations of the held-out kind once more, from other starts and with other noise.

    The noise is the rig's own, also where the case has another one.

    Args:
        case: The case; its parameters and what is hidden stay.
        seed: Seed of excitations, starts and noise.
    """
    rig = _rig(case.rig)
    recorder = record_in_mujoco if rig.engine == "mujoco" else record
    return recorder(
        rig,
        HOLDOUT_EXCITATIONS,
        parameters=case.parameters,
        hidden=case.truth,
        measurement=rig.measurement,
        seed=derived_seed(seed, case.rig, "held out again"),
    ).rollouts


def _rig(name: str) -> Rig:
    if name not in RIGS:
        raise ModelError(f"There is no rig {name!r}; there are {', '.join(RIGS)}.")
    return RIGS[name]


def _several(rig: Rig, number: int, key: str, seed: int) -> tuple[Place, ...]:
    """Draws effects that act at different ports, and of which no class holds two."""
    choices = [
        chosen
        for chosen in itertools.combinations(rig.effects, number)
        if all(_is_apart(rig, *pair) for pair in itertools.combinations(chosen, 2))
    ]
    generator = np.random.default_rng(derived_seed(seed, rig.name, key))
    return choices[int(generator.integers(len(choices)))]


def _is_apart(rig: Rig, first: Place, second: Place) -> bool:
    """Returns whether two places differ in port and effect, and share no class."""
    return (
        first[0] != second[0]
        and first[1] != second[1]
        and (second,) not in rig.inseparable.get(first, ())
        and (second,) not in rig.same.get(first, ())
    )


def _alternatives(
    rig: Rig, condition: Condition, hidden: Sequence[Place]
) -> tuple[tuple[str, ...], ...]:
    """Returns the effects that are equivalent to the hidden ones."""
    table = rig.inseparable if condition == "inseparable" else rig.same
    choices = [((place,), *table.get(place, ())) for place in hidden]
    found = [
        tuple(f"{port}.{effect_id}" for place in chosen for port, effect_id in place)
        for chosen in itertools.product(*choices)
    ]
    return tuple(found[1:])  # the first is the truth
