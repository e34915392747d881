"""Five Furuta rigs of one series: a learnt likelihood inside a hierarchical Pyro model.

    python examples/fleet.py                    # one fleet; compares with the tractable model
    python examples/fleet.py --fleets 20 --out fleet.json

Every rig has its own motor constant, pole length and arm damping, scattered around the series'
mean; each was excited three times by the same chirp. The simulator is a black box: from
simulations of *one* rig the backend ``nle`` learns the likelihood of one rollout, and
:func:`npdr_ppl.with_likelihood` gives it to the model of the whole fleet, on which Pyro's NUTS
then runs. Because the readings' noise is declared, the exact likelihood is known too, and NUTS on
it is the reference.
"""

import argparse
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from pyro.infer import MCMC, NUTS
from pyro.infer.autoguide.initialization import init_to_median
from torch import Tensor

import npdr_ppl as npdr
from npdr_ppl.inference.nle import NLE
from npdr_ppl.metrics import c2st
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.randomness import seeded

NUM_RIGS, NUM_ROLLOUTS = 5, 3
TIME_STEP, NUM_STEPS = 0.01, 100
NOISE = {"arm_angle": 0.2, "pole_angle": 0.2, "arm_velocity": 2.0, "pole_velocity": 2.0}
"""Standard deviations in rad and rad/s."""

RANGES = {
    "motor_constant": (0.02, 0.07),  # V s/rad
    "pole_length": (0.09, 0.17),  # m
    "arm_damping": (0.0, 1e-3),  # N m s/rad
}
"""Between which values a rig can lie; its place in a range is Phi of a normal coordinate."""


@dataclass(frozen=True)
class Fleet:
    """A fleet drawn from the model.

    Attributes:
        mean: Mean of the rigs' coordinates, ``(3,)``.
        spread: Their standard deviation, ``(3,)``.
        readings: ``(rollouts, rigs, 1, steps, 4)``.
    """

    mean: Tensor
    spread: Tensor
    readings: Tensor


def chirp() -> npdr.Inputs:
    """Returns one second of a chirp from 1 to 6 Hz at 2 V, from rest."""
    seconds = TIME_STEP * torch.arange(NUM_STEPS, dtype=torch.float64)
    voltage = 2.0 * torch.sin(2 * math.pi * (1.0 + 2.5 * seconds) * seconds)
    return npdr.Inputs.single(
        voltage[:, None],
        torch.zeros(4, dtype=torch.float64),
        action_names=("voltage",),
        state_names=tuple(channel.name for channel in Furuta.states),
        time_step=TIME_STEP,
    )


def rig(inputs: npdr.Inputs) -> Tensor:
    """One rollout of one rig, from which the likelihood is learnt."""
    parameters = {name: pyro.sample(name, dist.Uniform(*ends)) for name, ends in RANGES.items()}
    return npdr.simulate("readings", Furuta(), parameters, inputs, noise=NOISE)


def fleet(inputs: npdr.Inputs) -> Tensor:
    """All rollouts of all rigs, which share hyper-priors."""
    size = len(RANGES)
    mean = pyro.sample("mean", dist.Normal(0.0, 0.7).expand([size]).to_event(1))
    spread = pyro.sample("spread", dist.LogNormal(math.log(0.3), 0.5).expand([size]).to_event(1))
    with pyro.plate("rig", NUM_RIGS, dim=-1):
        # Centred: the readings tell more about a rig than its being one of the series.
        coordinates = pyro.sample("coordinates", dist.Normal(mean, spread).to_event(1))
        parameters = rig_parameters(coordinates)
        with pyro.plate("rollout", NUM_ROLLOUTS, dim=-2):
            return npdr.simulate("readings", Furuta(), parameters, inputs, noise=NOISE)


def rig_parameters(coordinates: Tensor) -> dict[str, Tensor]:
    """Maps normal coordinates ``(..., 3)`` to parameters ``(...,)`` in their ranges."""
    shares = torch.special.ndtr(coordinates.double()).unbind(-1)
    return {
        name: low + (high - low) * share
        for (name, (low, high)), share in zip(RANGES.items(), shares, strict=True)
    }


def draw_fleet(inputs: npdr.Inputs, seed: int) -> Fleet:
    """Draws hyper-parameters, rigs and rollouts from the model."""
    with seeded(seed, "fleet"):
        trace = pyro.poutine.trace(fleet).get_trace(inputs)
    return Fleet(*(trace.nodes[name]["value"] for name in ("mean", "spread", "readings")))


def learn(inputs: npdr.Inputs, num_simulations: int, seed: int) -> npdr.Posterior:
    """Learns the likelihood of one rollout; any rollout will do as the observation."""
    with seeded(seed, "any rollout"):
        readings = rig(inputs)
    states = torch.cat([torch.zeros(1, 4, dtype=torch.float64), readings[0]])
    rollouts = npdr.Rollouts.from_arrays(
        readings=[states.numpy()],
        actions=[inputs.actions[0].numpy()],
        channel_names=inputs.channel_names,
        action_names=inputs.action_names,
        time_step=TIME_STEP,
    )
    return npdr.infer(
        rig,
        rollouts,
        # Rigs lie anywhere in their ranges, at the ends too.
        backend=NLE(coordinates="bounded"),
        num_simulations=num_simulations,
        options=npdr.DataOptions(embedding="all", segment_length=None, initial_state="recorded"),
        seed=seed,
    )


def run_nuts(
    model: Callable[..., Any], inputs: npdr.Inputs, num_samples: int, seed: int
) -> Mapping[str, Tensor]:
    """Returns NUTS draws of a conditioned model by site."""
    with seeded(seed, "nuts"):
        # Pyro's default start, anywhere within two of zero, can lie in another mode.
        kernel = NUTS(
            model,
            max_tree_depth=6,
            full_mass=[("coordinates",)],
            init_strategy=init_to_median(num_samples=50),
        )
        sampler = MCMC(
            kernel, num_samples=num_samples, warmup_steps=num_samples // 2, disable_progbar=True
        )
        sampler.run(inputs)
    return sampler.get_samples()


def coverage(draws: Mapping[str, Tensor], truth: Fleet, mass: float = 0.9) -> list[bool]:
    """Returns whether each hyper-parameter lies in its central interval."""
    covered = []
    for name, values in (("mean", truth.mean), ("spread", truth.spread)):
        ends = torch.tensor([0.5 - mass / 2, 0.5 + mass / 2])
        low, high = torch.quantile(draws[name], ends.to(draws[name]), dim=0)
        covered += ((low <= values) & (values <= high)).tolist()
    return covered


def c2st_per_rig(draws: Mapping[str, Tensor], others: Mapping[str, Tensor]) -> list[float]:
    """Returns how well a classifier tells two chains apart, rig by rig; 0.5 is not at all."""
    ours, theirs = draws["coordinates"], others["coordinates"]
    return [c2st(ours[:, k], theirs[:, k]) for k in range(NUM_RIGS)]


def print_floor(inputs: npdr.Inputs, num_samples: int, seed: int) -> None:
    """Compares two chains on the exact likelihood: no learnt one can do better."""
    measured = {"readings": draw_fleet(inputs, seed).readings}
    first, second = (
        run_nuts(pyro.condition(fleet, measured), inputs, num_samples, chain) for chain in (0, 1)
    )
    shown = ", ".join(f"{score:.3f}" for score in c2st_per_rig(first, second))
    print(f"two chains on the exact likelihood: C2ST per rig {shown}")


def main() -> None:
    """Runs the fleets that the arguments choose."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fleets", type=int, default=1)
    parser.add_argument("--references", type=int, default=1, help="fleets compared with NUTS")
    parser.add_argument(
        "--floor", action="store_true", help="compare two chains on the exact likelihood instead"
    )
    parser.add_argument("--simulations", type=int, default=160_000)
    parser.add_argument("--samples", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    inputs = chirp()
    if arguments.floor:
        print_floor(inputs, arguments.samples, arguments.seed)
        return
    start = time.perf_counter()
    learnt = learn(inputs, arguments.simulations, arguments.seed)
    print(f"learnt the likelihood of one rollout in {time.perf_counter() - start:.0f} s")
    names = [f"{kind} {name}" for kind in ("mean", "spread") for name in RANGES]
    result: dict[str, Any] = {"hyper_parameters": names, "covered": [], "c2st": []}
    for number in range(arguments.fleets):
        truth = draw_fleet(inputs, arguments.seed + number)
        measured = {"readings": truth.readings}
        start = time.perf_counter()
        quick = npdr.with_likelihood(fleet, learnt)
        draws = run_nuts(pyro.condition(quick, measured), inputs, arguments.samples, number)
        seconds = time.perf_counter() - start
        result["covered"].append(coverage(draws, truth))
        print(
            f"fleet {number}: NUTS on the learnt likelihood took {seconds:.0f} s; 90 % intervals "
            f"cover {sum(result['covered'][-1])} of {len(names)} hyper-parameters",
            flush=True,
        )
        if number < arguments.references:
            start = time.perf_counter()
            exact = pyro.condition(fleet, measured)
            reference = run_nuts(exact, inputs, arguments.samples, number)
            seconds = time.perf_counter() - start
            scores = c2st_per_rig(draws, reference)
            result["c2st"].append(scores)
            shown = ", ".join(f"{score:.3f}" for score in scores)
            print(f"  on the exact one {seconds:.0f} s; C2ST per rig {shown}", flush=True)
    shares = torch.tensor(result["covered"]).double().mean(0)
    result["share_covered"] = dict(zip(names, shares.tolist(), strict=True))
    for name, share in result["share_covered"].items():
        print(f"{name:20} covered in {share:.0%} of {arguments.fleets} fleets")
    if arguments.out:
        arguments.out.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
