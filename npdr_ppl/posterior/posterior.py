"""The posterior over domain parameters: samples, density, most likely sample, Pyro guide."""

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
from npdr_ppl.errors import BackendError, DataError
from npdr_ppl.inference.base import Backend, Problem, RoundInfo, State
from npdr_ppl.inference.registry import backend as backend_by_name
from npdr_ppl.language.model import Model
from npdr_ppl.posterior.density_mixture import DensityMixture
from npdr_ppl.posterior.estimator_check import Correction, EstimatorCheck
from npdr_ppl.posterior.exported_checks import checks_of
from npdr_ppl.posterior.prepare import Preparation
from npdr_ppl.posterior.run_folder import RunFolder
from npdr_ppl.preparation.binding import BoundModel, bind, problem_of
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.randomness import seeded
from npdr_ppl.run_files import reading_back

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from npdr_ppl.arviz_module import Data

__all__ = ["Posterior", "PosteriorBase", "Provenance"]

REFERENCE_SITE = "_reference"


@dataclass(frozen=True)
class Provenance:
    """Seed, budget, figures and duration of the run that learnt a posterior.

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
        """Number of faults at workers, by kind; empty if no workers were used."""
        counts: Counter[str] = Counter()
        for info in self.rounds:
            counts.update(info.faults)
        return dict(counts)


class PosteriorBase(DensityMixture):
    """What every posterior offers: a Pyro guide, an ArviZ object and a figure of its marginals."""

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

    def _repr_html_(self) -> str:
        from npdr_ppl.posterior.posterior_view import posterior_html

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
        from npdr_ppl.posterior.posterior_view import plot_posterior

        return plot_posterior(self, axes, num_samples=num_samples, seed=seed)

    def to_arviz(self, num_samples: int = 1_000, *, seed: int = 0) -> "Data":
        """Returns an ArviZ object; see :func:`npdr_ppl.posterior.arviz_export.to_arviz`."""
        from npdr_ppl.posterior.arviz_export import to_arviz

        return to_arviz(self, num_samples, seed=seed)


class Posterior(PosteriorBase):
    """A posterior learnt by a backend: an equal mixture of independently trained members.

    Attributes:
        bound: The model and its data.
        backend: The backend that learnt it.
        problem: The problem that was given to the backend.
        states: The backend's states after the rounds that were kept; the last one is the state of
            this posterior.
        densities: The members of the ensemble, in reference coordinates.
        provenance: Seed, budget, figures and duration of the run that learnt it.
        preparation: How the recording was prepared; ``None`` if that is not known.
        estimator: Result of the estimator check; ``None`` if it was not made.
        correction: The corrected posterior that replaces the learnt one; ``None`` if none does.
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
        """Returns the checks of estimator and model; see :func:`checks_of`."""
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
        """Writes the posterior and its data to a folder; see :mod:`npdr_ppl.posterior.run_folder`.

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
        if self.preparation is not None and self.preparation.hypothesis is not None:
            folder.save_preparation(self.preparation)
        folder.save_correction(self.correction, self.checks())

    @classmethod
    def load(
        cls,
        path: str | PathLike[str],
        model: Model,
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
        with reading_back(folder.path / "run.json"):
            options = DataOptions(**description["binding"])
            method = backend_by_name(description["backend"], **description["options"])
        if embedding is not None:
            options = replace(options, embedding=embedding)
        kept = folder.preparation()
        if embedding is None and kept.score is not None:
            options = replace(options, embedding=kept.score)
        model = kept.apply(model)
        bound = bind(model, folder.data(), options, device, starts=kept.starts)
        problem = problem_of(bound, device)
        with reading_back(folder.path):
            state = method.restore(problem, last.tensors, last.values)
        provenance = Provenance(
            description["seed"], description["num_simulations"], tuple(last.infos), last.seconds
        )
        correction, checks = folder.correction(bound.prior)
        return cls(
            bound, method, problem, [state], provenance, correction=correction, checks=checks
        )

    def corrected(self, estimator: EstimatorCheck, correction: Correction | None) -> "Posterior":
        """Returns the posterior with the results of its comparison with the simulator."""
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
                f"Round {index} does not exist; this posterior has the states of "
                f"{len(self.states)} rounds, counted from 0."
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
