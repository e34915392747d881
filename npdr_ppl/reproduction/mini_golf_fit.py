"""One fit of a mini-golf model to strikes, as every row of Table 1 needs it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from npdr_ppl import metrics
from npdr_ppl.embeddings import Embedding, embedding_by_name
from npdr_ppl.models.mini_golf import MiniGolf
from npdr_ppl.posterior.comparison.compared_backends import Candidate, folder_name
from npdr_ppl.posterior.infer import infer
from npdr_ppl.posterior.posterior import Posterior
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.evaluation import replay
from npdr_ppl.rollouts import Rollouts

__all__ = [
    "BALL",
    "EMBEDDING",
    "NOISE",
    "OPTIONS",
    "Budget",
    "likeliest_draws",
    "most_likely_draw",
    "score_each",
    "score_strikes",
]

Model = Callable[..., Tensor]

BALL = ("ball_x", "ball_y")

EMBEDDING = "linear[ball_x,ball_y]~8"
"""A trained linear layer over the ball's way. Means of eight readings carry what every second one
does, which is what the paper takes, at a quarter of the size."""

NOISE = {sensor.name: 0.05 if sensor.name in BALL else 1e-9 for sensor in MiniGolf.sensors}
"""Standard deviations of the readings in m and rad: what the best of the ten parameters leave
unexplained. The recorded ball is off before any simulated one is touched, so that without noise
the recording is unlike every simulation, and a network is asked about what it never saw."""

OPTIONS = DataOptions(EMBEDDING, None, "recorded")
"""Whole strikes, from the recorded place of the ball."""


NUM_DRAWS = 1_000
"""Posterior draws among which the most likely is sought, less than one round's simulations."""

NUM_LIKELIEST = 20
"""Draws whose mean says where the obstacles are: the likeliest one of a wide posterior is off by
degrees by chance."""


@dataclass(frozen=True)
class Budget:
    """How much a fit may cost, and where it is kept.

    Attributes:
        rounds: Rounds of a sequential method.
        num_simulations: Simulations of each round; other methods get all at once.
        seed: Seed of everything random.
        out: Folder for runs; an interrupted one continues from there.
        progress: Whether to show progress; ``None`` shows it on a terminal.
    """

    rounds: int
    num_simulations: int
    seed: int
    out: Path
    progress: bool | None

    def fit(
        self, model: Model, candidate: Candidate, rollouts: Rollouts, label: str, name: str
    ) -> Posterior:
        """Fits a model to strikes.

        Args:
            model: The Pyro model.
            candidate: The backend with its embedding. A trained embedding is given noisy
                readings; a statistic of differences would measure the noise instead.
            rollouts: The strikes.
            label: The method's label.
            name: Name of this fit.
        """
        embedding = candidate.embedding or EMBEDDING
        rounds = self.rounds if candidate.is_sequential else 1
        return infer(
            partial(model, noise=NOISE) if _is_trained(embedding) else model,
            rollouts,
            backend=candidate.backend,
            rounds=rounds,
            num_simulations=self.rounds * self.num_simulations // rounds,
            seed=self.seed,
            options=DataOptions(
                embedding=embedding, segment_length=None, initial_state="recorded"
            ),
            checkpoint=self.out / folder_name(label) / name,
            progress=self.progress,
        )


def most_likely_draw(
    posterior: Posterior, model: Model, rollouts: Rollouts, *, seed: int = 0
) -> dict[str, Tensor]:
    """Returns the first of :func:`likeliest_draws`."""
    likeliest = likeliest_draws(posterior, model, rollouts, seed=seed)
    return {name: values[0] for name, values in likeliest.items()}


def likeliest_draws(
    posterior: Posterior, model: Model, rollouts: Rollouts, *, seed: int = 0
) -> dict[str, Tensor]:
    """Returns the :data:`NUM_LIKELIEST` draws that make the strikes most likely, best first.

    The simulator is deterministic, so that under the noise of :data:`NOISE` every draw that is
    simulated once more has a likelihood, and no network has to be asked for it. The density of a
    network over ten parameters is a poor judge of single draws: relative to the prior it is
    greatest far out, at the edges of the parameters' ranges, where it has seen least.

    Args:
        posterior: The posterior.
        model: The Pyro model.
        rollouts: The strikes it was fitted to.
        seed: Seed of the draws.
    """
    draws = posterior.sample(NUM_DRAWS, seed=seed)
    replayed = replay(model, rollouts, draws, OPTIONS)
    measured = rollouts.observation(replayed.inputs, channels=replayed.channel_names)
    scale = measured.new_tensor([NOISE[name] for name in replayed.channel_names])
    # Replayed joints are the measured ones, whatever the draw.
    ball = [replayed.channel_names.index(name) for name in BALL]
    error = ((replayed.trajectory - measured) / scale)[..., ball].square()
    best = error.flatten(1).sum(-1).nan_to_num(torch.inf).argsort()[:NUM_LIKELIEST]
    return {name: values[best] for name, values in draws.items()}


def score_each(
    model: Model, parameters: Sequence[Mapping[str, Tensor]], strikes: Sequence[Rollouts]
) -> dict[str, Tensor]:
    """Scores one parameter set on each strike, ``(R,)`` per metric."""
    found = [
        score_strikes(model, strike, values)
        for values, strike in zip(parameters, strikes, strict=True)
    ]
    return {name: torch.cat([scores[name] for scores in found]) for name in found[0]}


def score_strikes(
    model: Model, strikes: Rollouts, parameters: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Scores one parameter set on every strike: RMSE and both kinds of DTW, ``(R,)`` each."""
    batched = {name: torch.as_tensor(value)[None] for name, value in parameters.items()}
    replayed = replay(model, strikes, batched, OPTIONS)
    simulated = [series[0].double() for series in replayed.series()]
    measured = strikes.series(replayed.channel_names)
    return {
        "rmse": metrics.rmse(simulated, measured),
        "dtw": metrics.dtw(simulated, measured),
        "dtw_open": metrics.dtw(simulated, measured, open_end="measured"),
    }


def _is_trained(embedding: str | Embedding) -> bool:
    chosen = embedding_by_name(embedding) if isinstance(embedding, str) else embedding
    return chosen.is_trained
