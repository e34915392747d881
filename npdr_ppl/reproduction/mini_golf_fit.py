"""Fits a mini-golf model to strikes, for the rows of Table 1."""

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
from npdr_ppl.progress import Reporter
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
"""A trained linear layer over the ball's path. It gets means of eight samples, which carry the
same information as every second sample (the paper's choice) at a quarter of the size."""

NOISE = {sensor.name: 0.05 if sensor.name in BALL else 1e-9 for sensor in MiniGolf.sensors}
"""Standard deviations of the measurement noise in m and rad: the residuals at the best values of
the ten parameters. The recorded ball moves before any simulated one is struck. Without noise the
recording would differ from all simulations, and the network would have to extrapolate."""

OPTIONS = DataOptions(EMBEDDING, None, "recorded")
"""Whole strikes, from the recorded initial position of the ball."""


NUM_DRAWS = 1_000
"""Number of posterior draws among which the most likely is searched; less than the simulations of
one round."""

NUM_LIKELIEST = 20
"""Number of draws whose mean gives the obstacles' angles: the single most likely draw of a wide
posterior has a random error of degrees."""


@dataclass(frozen=True)
class Budget:
    """Simulation budget of a fit, and its folder.

    Attributes:
        rounds: Rounds of a sequential method.
        num_simulations: Simulations of each round; other methods get all in one round.
        seed: Seed of everything random.
        out: Folder for runs; an interrupted one continues from there.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.
    """

    rounds: int
    num_simulations: int
    seed: int
    out: Path
    progress: bool | Reporter | None

    def fit(
        self, model: Model, candidate: Candidate, rollouts: Rollouts, label: str, name: str
    ) -> Posterior:
        """Fits a model to strikes.

        Args:
            model: The Pyro model.
            candidate: The backend with its embedding. Only a trained embedding gets noisy
                simulations; a statistic of differences would measure the noise instead.
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

    The simulator is deterministic, so one simulation of a draw gives its likelihood under the
    noise of :data:`NOISE`; no network is needed. A network's density over ten parameters is not
    accurate for single draws: relative to the prior it is largest at the edges of the parameters'
    ranges, where the network had the fewest training data.

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
    # Replayed joints equal the measured ones for every draw.
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
