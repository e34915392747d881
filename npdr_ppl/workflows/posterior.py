"""The posterior over domain parameters: samples, density, most likely sample, Pyro guide."""

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from npdr_ppl.embeddings import Embedding
from npdr_ppl.errors import BackendError, DataError, ShapeError
from npdr_ppl.inference.base import Backend, Density, Problem, RoundInfo, State
from npdr_ppl.inference.registry import backend as backend_by_name
from npdr_ppl.language.prior import Prior
from npdr_ppl.randomness import seeded
from npdr_ppl.workflows.binding import BindingOptions, BoundModel, bind, problem_of
from npdr_ppl.workflows.checks import checks_of
from npdr_ppl.workflows.estimator_check import Correction, EstimatorCheck
from npdr_ppl.workflows.preparation import Preparation
from npdr_ppl.workflows.run_folder import RunFolder

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from npdr_ppl.workflows.arviz_module import Data

__all__ = ["Posterior", "PosteriorBase", "Provenance"]

REFERENCE_SITE = "_reference"

ROUNDING = 1e-9
"""What a number of draws may exceed an integer by and still be that integer."""


@dataclass(frozen=True)
class Provenance:
    """How a posterior came about.

    Attributes:
        seed: Seed of the run.
        num_simulations: Simulations of each round.
        rounds: The figures of each round.
        seconds: Time spent to ``simulate`` and ``train``.
    """

    seed: int
    num_simulations: int
    rounds: Sequence[RoundInfo] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def faults(self) -> dict[str, int]:
        """Counts of what went wrong at workers, by kind; empty where none were used."""
        counts: Counter[str] = Counter()
        for info in self.rounds:
            counts.update(info.faults)
        return dict(counts)


class PosteriorBase(ABC):
    """q(ξ | x_o) = Σ_m w_m q_m(ξ): a weighted mixture of densities.

    Attributes:
        bound: The model and its data.
        densities: The components q_m, in reference coordinates.
        weights: Their weights w_m, ``(components,)`` float64 with sum 1.
    """

    def __init__(
        self, bound: BoundModel, densities: Sequence[Density], weights: Tensor | None = None
    ) -> None:
        """Makes the mixture; equal weights if none are given."""
        self.bound = bound
        self.densities = tuple(densities)
        if weights is None:
            weights = torch.ones(len(self.densities), dtype=torch.float64) / len(self.densities)
        self.weights = weights

    @property
    @abstractmethod
    def backend_name(self) -> str:
        """Which backend, or which mixture of backends, it comes from."""

    @abstractmethod
    def sample_reference(self, num_samples: int, *, seed: int = 0) -> Tensor:
        """Draws ``(chains, num_samples, d)``: what ArviZ takes for chains."""

    @property
    def prior(self) -> Prior:
        """The prior of the model."""
        return self.bound.prior

    def checks(self) -> dict[str, Any]:
        """Returns what is known of estimator and model by other means; empty if nothing is."""
        return {}

    def sample(self, num_samples: int, *, seed: int = 0) -> dict[str, Tensor]:
        """Draws domain parameters.

        Args:
            num_samples: Number of draws n.
            seed: Seed of the draws.

        Returns:
            Values ``(n,) + site.shape`` by site name, in the model's units; all lie on the
            prior's support.
        """
        return self.prior.to_parameters(self.sample_mixture(num_samples, seed=seed))

    def sample_mixture(self, num_samples: int, *, seed: int = 0) -> Tensor:
        """Draws from the mixture in reference coordinates, ``(num_samples, d)``.

        Interleaved, so that any leading part of the draws has the components in proportion to
        their weights: the j-th draw of component m is due at (j + 1/2) / w_m.
        """
        draws, due = [], []
        for member, (density, weight) in enumerate(
            zip(self.densities, self.weights.tolist(), strict=True)
        ):
            share = math.ceil(num_samples * weight - ROUNDING)
            if share < 1:
                continue
            with seeded(seed, "posterior", member):
                draws.append(density.sample(share).cpu())
            due.append((torch.arange(share, dtype=torch.float64) + 0.5) / weight)
        order = torch.cat(due).argsort(stable=True)
        return torch.cat(draws)[order[:num_samples]]

    def log_prob(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns log q(ξ | x_o), ``(n,)``, at values ``(n,) + site.shape`` by site name.

        Raises:
            ShapeError: A site is missing or has the wrong shape.
        """
        for site in self.prior.sites:
            value = parameters.get(site.name)
            if value is None or value.shape[1:] != site.shape:
                came = "nothing" if value is None else tuple(value.shape)
                raise ShapeError(
                    f"log_prob needs {site.name} with shape (n, *{tuple(site.shape)}), got {came}."
                )
        return self.log_prob_reference(self.prior.to_reference(dict(parameters)))

    def log_prob_reference(self, z: Tensor) -> Tensor:
        """Returns log q(ξ(z) | x_o), ``(n,)``, the density over ξ, at points ``(n, d)``."""
        with torch.no_grad():
            members = torch.stack([member.log_prob(z).double().cpu() for member in self.densities])
        # A component whose density is not a number contributes none to the mixture.
        members = members.where(~members.isnan(), -torch.inf) + self.weights.log()[:, None]
        return members.logsumexp(0) - self.prior.log_jacobian(z)

    def most_likely(self, num_samples: int = 10_000, *, seed: int = 0) -> dict[str, Tensor]:
        """Returns the draw of greatest density, of ``num_samples`` (``argmax`` in Algorithm 1)."""
        z = self.sample_mixture(num_samples, seed=seed)
        best = z[self.log_prob_reference(z).argmax()][None]
        return {name: value[0] for name, value in self.prior.to_parameters(best).items()}

    @property
    def guide(self) -> Callable[..., dict[str, Tensor]]:
        """A Pyro guide of the model, e.g. for ``pyro.infer.Predictive``."""
        return self._guide

    def _guide(self, *args: Any, **kwargs: Any) -> dict[str, Tensor]:
        z = pyro.sample(REFERENCE_SITE, _ReferencePosterior(self), infer={"is_auxiliary": True})
        flat = z.reshape(-1, z.shape[-1])
        batch = z.shape[:-1]
        result = {}
        parameters = self.prior.to_parameters(flat)
        for site in self.prior.sites:
            value = parameters[site.name]
            if batch:
                # Outer plates, such as Predictive's own, stand left of the model's.
                outer = batch[: len(batch) - self.prior.max_plate_nesting]
                padding = (1,) * (self.prior.max_plate_nesting - len(site.batch_shape))
                value = value.reshape((*outer, *padding, *site.shape))
            else:
                value = value[0]
            with ExitStack() as stack:
                for name, size, dim in site.plates:
                    stack.enter_context(pyro.plate(name, size, dim=dim))
                result[site.name] = pyro.sample(
                    site.name,
                    dist.Delta(value, event_dim=len(site.shape) - len(site.batch_shape)),
                )
        return result

    def predict(self, num_samples: int = 200, *, seed: int = 0) -> dict[str, Tensor]:
        """Simulates posterior draws: the posterior predictive, by black-box site.

        Returns:
            Outputs ``(num_samples,) + plates + event``.
        """
        z = self.sample_mixture(num_samples, seed=seed)
        with seeded(seed, "predict"):
            return self.prior.execute(z)

    def _repr_html_(self) -> str:
        from npdr_ppl.workflows.notebook import posterior_html

        return posterior_html(self)

    def plot(self, axes: Any = None, *, num_samples: int = 2_000, seed: int = 0) -> "NDArray[Any]":
        """Draws the marginal of every scalar parameter over its prior.

        Args:
            axes: Axes to draw on, one per scalar parameter; ``None`` makes a figure.
            num_samples: Draws behind each density.
            seed: Seed of the draws.

        Returns:
            The axes, ``(scalar parameters,)``.
        """
        from npdr_ppl.workflows.notebook import plot_posterior

        return plot_posterior(self, axes, num_samples=num_samples, seed=seed)

    def to_arviz(self, num_samples: int = 1_000, *, seed: int = 0) -> "Data":
        """Returns an ArviZ object; see :func:`npdr_ppl.workflows.arviz_export.to_arviz`."""
        from npdr_ppl.workflows.arviz_export import to_arviz

        return to_arviz(self, num_samples, seed=seed)


class Posterior(PosteriorBase):
    """What a backend has learnt: an equal mixture of independently trained ensemble members.

    Attributes:
        bound: The model and its data.
        backend: The backend that learnt it.
        problem: What the backend knew.
        states: The backend's state after each round known, the last one being this posterior's.
        densities: The members, in reference coordinates.
        provenance: How they came about.
        preparation: What was done with the recording first, where that is known.
        estimator: How the learnt posterior compares with the simulator, where that was checked.
        correction: What took its place; ``None`` if it is the learnt one.
    """

    def __init__(
        self,
        bound: BoundModel,
        backend: Backend,
        problem: Problem,
        states: Sequence[State],
        provenance: Provenance,
        *,
        preparation: Preparation | None = None,
        estimator: EstimatorCheck | None = None,
        correction: Correction | None = None,
        checks: Mapping[str, Any] | None = None,
    ) -> None:
        if correction is None:
            super().__init__(bound, backend.densities(problem, states[-1]))
        else:
            super().__init__(bound, correction.densities)
        self.backend = backend
        self.problem = problem
        self.states = tuple(states)
        self.provenance = provenance
        self.preparation = preparation
        self.estimator = estimator
        self.correction = correction
        self._checks = None if checks is None else dict(checks)

    @property
    def backend_name(self) -> str:
        """The backend's name."""
        return self.backend.name

    def checks(self) -> dict[str, Any]:
        """Returns what is known of estimator and model; see :mod:`npdr_ppl.workflows.checks`."""
        if self._checks is None:
            self._checks = checks_of(self.preparation, self.estimator)
        return self._checks

    def sample_reference(self, num_samples: int, *, seed: int = 0) -> Tensor:
        """Draws ``num_samples`` of each member, ``(members, num_samples, d)``."""
        draws = []
        for member, density in enumerate(self.densities):
            with seeded(seed, "posterior", member):
                draws.append(density.sample(num_samples).cpu())
        return torch.stack(draws)

    def save(self, path: str | PathLike[str]) -> None:
        """Writes the posterior and its data to a folder; see :mod:`npdr_ppl.workflows.run_folder`.

        Raises:
            BackendError: The folder holds another run.
        """
        folder = RunFolder(Path(path))
        own = self.provenance
        rounds = len(own.rounds)
        folder.begin(
            self.bound,
            self.backend,
            seed=own.seed,
            rounds=rounds,
            num_simulations=own.num_simulations,
        )
        tensors, values = self.backend.tensors(self.states[-1])
        folder.save_round(rounds - 1, tensors, values, own.rounds, own.seconds)
        if self.preparation is not None:
            folder.save_preparation(self.preparation)
        folder.save_correction(self.correction, self.checks())

    @classmethod
    def load(
        cls,
        path: str | PathLike[str],
        model: Callable[..., Any],
        *,
        embedding: Embedding | None = None,
        device: str | torch.device = "cpu",
    ) -> "Posterior":
        """Reads a posterior that :meth:`save` or a run of :func:`npdr_ppl.infer` wrote.

        Args:
            path: The folder.
            model: The model; code is not loaded from disk.
            embedding: The embedding, if it was not one of the named ones.
            device: Where to evaluate it.

        Raises:
            DataError: The folder holds no complete run.
        """
        folder = RunFolder(Path(path))
        description = folder.description()
        rounds = folder.rounds()
        if not rounds:
            raise DataError(f"{path} holds a run without a complete round.")
        last = folder.load_round(rounds[-1])
        options = BindingOptions(**description["binding"])
        if embedding is not None:
            options = replace(options, embedding=embedding)
        kept = folder.preparation()
        if embedding is None and kept.score is not None:
            options = replace(options, embedding=kept.score)
        model = kept.apply(model)
        bound = bind(model, folder.data(), options, device, starts=kept.starts)
        problem = problem_of(bound, device)
        method = backend_by_name(description["backend"], **description["options"])
        state = method.restore(problem, last.tensors, last.values)
        provenance = Provenance(
            description["seed"], description["num_simulations"], tuple(last.infos), last.seconds
        )
        correction, checks = folder.correction(bound.prior)
        return cls(
            bound, method, problem, [state], provenance, correction=correction, checks=checks
        )

    def corrected(self, estimator: EstimatorCheck, correction: Correction | None) -> "Posterior":
        """Returns the posterior as it is after the comparison with the simulator."""
        return Posterior(
            self.bound,
            self.backend,
            self.problem,
            self.states,
            self.provenance,
            preparation=self.preparation,
            estimator=estimator,
            correction=correction,
        )

    def after_round(self, index: int) -> "Posterior":
        """Returns the posterior as it was after round ``index``, counted from 0.

        Raises:
            BackendError: That round's state is not known, e.g. after loading from disk.
        """
        if not 0 <= index < len(self.states):
            raise BackendError(
                f"Round {index} is not known; this posterior knows {len(self.states)}."
            )
        provenance = replace(self.provenance, rounds=self.provenance.rounds[: index + 1])
        states = self.states[: index + 1]
        return Posterior(self.bound, self.backend, self.problem, states, provenance)


class _ReferencePosterior(TorchDistribution):
    """The posterior as a distribution over z whose density is that over ξ."""

    arg_constraints: dict[str, Any] = {}
    has_rsample = False

    def __init__(
        self, posterior: PosteriorBase, batch_shape: torch.Size | tuple[int, ...] = ()
    ) -> None:
        self.posterior = posterior
        super().__init__(
            torch.Size(batch_shape),
            torch.Size((posterior.prior.num_parameters,)),
            validate_args=False,
        )

    @property
    def support(self) -> constraints.Constraint:
        return constraints.real_vector

    def expand(self, batch_shape: torch.Size, _instance: Any = None) -> "_ReferencePosterior":
        return _ReferencePosterior(self.posterior, batch_shape)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape) + self.batch_shape
        # From torch's global stream, as every Pyro statement, and with the component drawn as
        # well: a single draw must be able to come from any of them.
        posterior = self.posterior
        component = torch.multinomial(posterior.weights, shape.numel(), replacement=True)
        z = torch.empty(shape.numel(), posterior.prior.num_parameters, dtype=torch.float64)
        for index in component.unique().tolist():
            own = component == index
            z[own] = posterior.densities[index].sample(int(own.sum())).double().cpu()
        return z.reshape(shape + self.event_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        flat = value.reshape(-1, value.shape[-1])
        return self.posterior.log_prob_reference(flat).reshape(value.shape[:-1])
