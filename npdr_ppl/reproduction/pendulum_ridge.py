"""Figure 2 of Muratore et al. (2021): the posterior over a pendulum's mass and length.

The torque acts on the pendulum only through 3/(m l²), so parameters along m l² = 1 give almost the
same motion until gravity's term 1.5 g/l has an effect. In the first second from rest, a noisy
recording cannot distinguish them, and the posterior is a ridge along that curve. Over the paper's
eight seconds, gravity determines mass and length: the exact posterior, by a grid and by NUTS,
shrinks to a small region at the truth. Both durations are computed here, and the posteriors of
likelihood-free backends are compared with NUTS on the same model.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyro
import torch
from numpy.typing import NDArray
from pyro.infer import MCMC, NUTS
from pyro.infer.autoguide.initialization import init_to_value
from torch import Tensor

from npdr_ppl.errors import BackendError, NpdrError
from npdr_ppl.language.handlers import with_noise
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.prior import Prior
from npdr_ppl.metrics import c2st, check_c2st
from npdr_ppl.models.pendulum import Pendulum, pendulum
from npdr_ppl.posterior.comparison.compared_backends import Candidate, folder_name, requested
from npdr_ppl.posterior.infer import infer
from npdr_ppl.posterior.posterior import Posterior
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.progress import Reporter
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.run_files import write_json

__all__ = ["Ridge", "exact_samples", "nuts_samples", "reproduce_pendulum", "valley"]

NOISE = {"angle": 0.25, "velocity": 1.0}
"""Standard deviations of the noise in rad and rad/s, about a sixth of the motion's amplitude."""

ROUNDS = 8
NUM_SIMULATIONS = 100
NUM_SAMPLES = 2_000
EMBEDDING = "all~10"
METHODS: Mapping[str, str] = {"snpe-c": "snpe-c(outside=3e-3)", "snpe-a": "snpe-a"}
"""The paper's methods by label, in the syntax of
:mod:`npdr_ppl.posterior.comparison.compared_backends`. With a hundred simulations per round,
SNPE-C works better if its proposals are truncated less than by default."""
DURATIONS = {"1 s": 50, "8 s": 400}
"""Number of steps of 20 ms by duration; the paper's recording lasts eight seconds."""

RANGE = (0.3, 1.7)
GRID = 350


@dataclass(frozen=True)
class Ridge:
    """Posteriors of one recording.

    Attributes:
        posteriors: Posteriors of the backends by label, with all their rounds.
        reference: NUTS draws, ``(n, 2)``: mass in kg, length in m.
        valley: Points ``(k, 2)`` of the curve with the smallest misfit to the recording.
    """

    posteriors: Mapping[str, Posterior]
    reference: NDArray[np.float64]
    valley: NDArray[np.float64]

    def samples(self, label: str, round_index: int = -1) -> NDArray[np.float64]:
        """Returns a backend's draws ``(n, 2)`` after a round, by default after the last one."""
        posterior = self.posteriors[label]
        if round_index >= 0:
            posterior = posterior.after_round(round_index)
        draws = posterior.sample(NUM_SAMPLES)
        return torch.stack([draws["mass"], draws["length"]], -1).double().numpy()


def reproduce_pendulum(
    out: Path,
    *,
    backends: Sequence[str] | None = None,
    seed: int = 0,
    progress: bool | Reporter | None = None,
) -> tuple[dict[str, Ridge], dict[str, Any]]:
    """Infers mass and length from one second and from eight, and compares with NUTS.

    Args:
        out: Folder for ``pendulum.json`` and the fits; existing fits are not repeated.
        backends: Labels of :data:`METHODS`, or other backends; ``None`` for all methods with an
            available backend; the others are recorded as skipped.
        seed: Seed of everything random.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.

    Returns:
        The posteriors by duration, and the content of ``pendulum.json``.

    Raises:
        BackendError: Every backend failed.
        DataError: The folder holds fits with other settings.
        DependencyError: scikit-learn, which compares the posteriors, is not installed.
    """
    check_c2st()
    chosen, skipped = requested(backends, METHODS)
    out.mkdir(parents=True, exist_ok=True)
    ridges: dict[str, Ridge] = {}
    rows: dict[str, dict[str, Any]] = {}
    failed: dict[str, str] = {}
    for duration, num_steps in DURATIONS.items():
        rollouts = record(num_steps)
        posteriors: dict[str, Posterior] = {}
        for label, candidate in chosen.items():
            try:
                posteriors[label] = infer_mass_and_length(
                    candidate,
                    rollouts,
                    seed,
                    progress,
                    checkpoint=out / folder_name(label) / folder_name(duration),
                )
            except NpdrError as error:
                failed[f"{label}, {duration}"] = str(error)
        if not posteriors:
            raise BackendError(f"Every backend failed. {'; '.join(failed.values())}")
        inputs = rollouts.inputs(initial_state="recorded")
        observed = rollouts.observation(inputs)
        exact = exact_samples(inputs, observed, seed=seed)
        reference = nuts_samples(inputs, observed, start=exact.mean(0), seed=seed)
        ridge = Ridge(posteriors, reference, valley(inputs, observed))
        ridges[duration] = ridge
        found = {label: ridge.samples(label) for label in posteriors}
        for label, samples in (found | {"nuts": reference, "grid": exact}).items():
            values = figures(samples, reference, ridge.valley)
            if samples is reference:
                del values["c2st"]
            rows[f"{label}, {duration}"] = {
                name: {"mean": value, "std": 0.0} for name, value in values.items()
            }
    result = {
        "rows": rows,
        "paper": {},
        "skipped": skipped,
        "failed": failed,
        "noise": NOISE,
        "rounds": ROUNDS,
        "seed": seed,
    }
    write_json(out / "pendulum.json", result)
    return ridges, result


def infer_mass_and_length(
    candidate: Candidate,
    rollouts: Rollouts,
    seed: int,
    progress: bool | Reporter | None = None,
    *,
    checkpoint: Path | None = None,
) -> Posterior:
    """Infers with the common budget; in one round if the backend is not sequential.

    Args:
        candidate: The backend.
        rollouts: The recording.
        seed: Seed of everything random.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.
        checkpoint: Folder for the rounds; existing rounds are not run again.
    """
    rounds = ROUNDS if candidate.is_sequential else 1
    return infer(
        partial(pendulum, noise=NOISE),
        rollouts,
        backend=candidate.backend,
        rounds=rounds,
        num_simulations=ROUNDS * NUM_SIMULATIONS // rounds,
        seed=seed,
        options=DataOptions(
            embedding=candidate.embedding or EMBEDDING,
            segment_length=None,
            initial_state="recorded",
        ),
        checkpoint=checkpoint,
        progress=progress,
    )


def record(num_steps: int) -> Rollouts:
    """Returns the paper's target: the nominal pendulum from rest under 4.5 sin(2πt) N m."""
    time = Pendulum.time_step * torch.arange(num_steps, dtype=torch.float64)
    torque = 4.5 * torch.sin(2 * math.pi * time)[:, None]
    inputs = Inputs.single(
        torque,
        torch.zeros(2),
        action_names=("torque",),
        state_names=("angle", "velocity"),
        time_step=Pendulum.time_step,
    )
    nominal = {"mass": torch.tensor(1.0), "length": torch.tensor(1.0)}
    trajectory = pyro.condition(pendulum, data=nominal)(inputs)[0]
    readings = torch.cat([torch.zeros(1, 2, dtype=torch.float64), trajectory])
    return Rollouts.from_arrays(
        readings=[readings.numpy()],
        actions=[torque.numpy()],
        channel_names=("angle", "velocity"),
        action_names=("torque",),
        time_step=Pendulum.time_step,
    )


def figures(
    samples: NDArray[np.float64],
    reference: NDArray[np.float64],
    curve: NDArray[np.float64],
) -> dict[str, float]:
    """Returns how close a method's draws are to the ridge and to NUTS.

    Args:
        samples: Draws ``(n, 2)``.
        reference: NUTS draws ``(m, 2)``.
        curve: The valley, ``(k, 2)``.

    Returns:
        ``on_curve``: the share within 10 % of the valley; ``on_m_l2``: the share with m l² within
        10 % of the truth; ``c2st`` against NUTS; ``spread_mass`` and ``spread_length``: the 90 %
        range of each marginal relative to that of NUTS.
    """
    relative = np.abs(samples[:, None] / curve[None] - 1).max(-1).min(-1)
    wide = np.diff(np.quantile(samples, [0.05, 0.95], axis=0), axis=0)[0]
    exact = np.diff(np.quantile(reference, [0.05, 0.95], axis=0), axis=0)[0]
    spread = wide / exact
    return {
        "on_curve": float(np.mean(relative < 0.1)),
        "on_m_l2": float(np.mean(np.abs(samples[:, 0] * samples[:, 1] ** 2 - 1) < 0.1)),
        "c2st": c2st(torch.from_numpy(samples), torch.from_numpy(reference)),
        "spread_mass": float(spread[0]),
        "spread_length": float(spread[1]),
    }


def valley(inputs: Inputs, observed: Tensor) -> NDArray[np.float64]:
    """Returns the best-fitting length for every mass whose misfit is within the noise.

    The misfit is the mean square over measurements in units of their noise. The curve is
    m l² = 1 modified by gravity.
    """
    axis, distance = _distances(inputs, observed)
    table = distance.reshape(GRID, GRID) / observed.numel()
    least, column = table.min(dim=1)
    kept = least < 1.0
    return torch.stack([axis[kept], axis[column[kept]]], -1).numpy()


def exact_samples(inputs: Inputs, observed: Tensor, *, seed: int) -> NDArray[np.float64]:
    """Draws from the exact posterior on a grid, ``(n, 2)``."""
    axis, distance = _distances(inputs, observed)
    generator = torch.Generator().manual_seed(seed)
    weights = torch.softmax(-0.5 * distance, 0)
    index = torch.multinomial(weights, NUM_SAMPLES, replacement=True, generator=generator)
    step = axis[1] - axis[0]
    jitter = (torch.rand(NUM_SAMPLES, 2, generator=generator, dtype=axis.dtype) - 0.5) * step
    points = torch.stack([axis[index // GRID], axis[index % GRID]], -1)
    return (points + jitter).numpy()


def _distances(inputs: Inputs, observed: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the grid's axis and the squared distance in units of the noise, ``(GRID²,)``."""
    axis = torch.linspace(*RANGE, GRID, dtype=torch.float64)
    mass, length = (part.flatten() for part in torch.meshgrid(axis, axis, indexing="ij"))
    prior = Prior(with_noise(pendulum, None), (inputs,))
    scale = torch.tensor(list(NOISE.values()), dtype=torch.float64)
    parts = []
    for rows in torch.arange(len(mass)).split(5_000):
        simulated = prior.execute_at({"mass": mass[rows], "length": length[rows]})
        difference = (simulated["trajectory"] - observed) / scale
        parts.append(difference.square().flatten(1).sum(-1))
    return axis, torch.cat(parts)


def nuts_samples(
    inputs: Inputs, observed: Tensor, *, start: NDArray[np.float64], seed: int
) -> NDArray[np.float64]:
    """Draws from the posterior by Pyro's NUTS through the differentiable simulator, ``(n, 2)``.

    Args:
        inputs: The segment.
        observed: The recording, ``(1, K, 2)``.
        start: Initial mass and length; far from the posterior, NUTS steps are slow.
        seed: Seed of the draws.
    """
    conditioned = pyro.condition(partial(pendulum, noise=NOISE), data={"trajectory": observed})
    values = {"mass": torch.tensor(start[0]), "length": torch.tensor(start[1])}
    with seeded(seed, "nuts"):
        kernel = NUTS(
            conditioned,
            step_size=0.01,  # pyright: ignore[reportArgumentType]  # Pyro says int
            full_mass=True,
            max_tree_depth=5,
            init_strategy=init_to_value(values=values),
        )
        sampler = MCMC(
            kernel, num_samples=NUM_SAMPLES // 2, warmup_steps=200, disable_progbar=True
        )
        sampler.run(inputs)
    draws = sampler.get_samples()
    return torch.stack([draws["mass"], draws["length"]], -1).double().numpy()
