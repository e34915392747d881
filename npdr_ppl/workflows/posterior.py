"""The posterior over domain parameters: samples, density, most likely sample, Pyro guide."""

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
from npdr_ppl.inference.base import Backend, Problem, RoundInfo, State
from npdr_ppl.inference.registry import backend as backend_by_name
from npdr_ppl.language.prior import Prior
from npdr_ppl.randomness import seeded
from npdr_ppl.workflows.binding import BindingOptions, BoundModel, bind, problem_of
from npdr_ppl.workflows.run_folder import RunFolder

if TYPE_CHECKING:
    from npdr_ppl.workflows.arviz_module import Data

__all__ = ["Posterior", "Provenance"]

REFERENCE_SITE = "_reference"


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


class Posterior:
    """q(ξ | x_o): an equal mixture of independently trained ensemble members.

    Attributes:
        bound: The model and its data.
        backend: The backend that learnt it.
        problem: What the backend knew.
        states: The backend's state after each round known, the last one being this posterior's.
        densities: The members, in reference coordinates.
        provenance: How they came about.
    """

    def __init__(
        self,
        bound: BoundModel,
        backend: Backend,
        problem: Problem,
        states: Sequence[State],
        provenance: Provenance,
    ) -> None:
        self.bound = bound
        self.backend = backend
        self.problem = problem
        self.states = tuple(states)
        self.densities = tuple(backend.densities(problem, self.states[-1]))
        self.provenance = provenance

    @property
    def prior(self) -> Prior:
        """The prior of the model."""
        return self.bound.prior

    def sample_reference(self, num_samples: int, *, seed: int = 0) -> Tensor:
        """Draws ``num_samples`` of each member, ``(members, num_samples, d)``."""
        draws = []
        for member, density in enumerate(self.densities):
            with seeded(seed, "posterior", member):
                draws.append(density.sample(num_samples).cpu())
        return torch.stack(draws)

    def sample(self, num_samples: int, *, seed: int = 0) -> dict[str, Tensor]:
        """Draws domain parameters from the mixture of all members.

        Args:
            num_samples: Number of draws n.
            seed: Seed of the draws.

        Returns:
            Values ``(n,) + site.shape`` by site name, in the model's units; all lie on the
            prior's support.
        """
        return self.prior.to_parameters(self._mixture_draws(num_samples, seed))

    def _mixture_draws(self, num_samples: int, seed: int) -> Tensor:
        per_member = -(-num_samples // len(self.densities))
        draws = self.sample_reference(per_member, seed=seed)
        # Interleaved, so that any leading part of the draws is balanced over the members.
        return draws.transpose(0, 1).flatten(0, 1)[:num_samples]

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
        mixture = members.logsumexp(0) - torch.log(torch.tensor(float(len(self.densities))))
        return mixture - self.prior.log_jacobian(z)

    def most_likely(self, num_samples: int = 10_000, *, seed: int = 0) -> dict[str, Tensor]:
        """Returns the draw of greatest density, of ``num_samples`` (``argmax`` in Algorithm 1)."""
        z = self._mixture_draws(num_samples, seed)
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
        z = self._mixture_draws(num_samples, seed)
        with seeded(seed, "predict"):
            return self.prior.execute(z)

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
        bound = bind(model, folder.data(), options, device)
        problem = problem_of(bound, device)
        method = backend_by_name(description["backend"], **description["options"])
        state = method.restore(problem, last.tensors, last.values)
        provenance = Provenance(
            description["seed"], description["num_simulations"], tuple(last.infos), last.seconds
        )
        return cls(bound, method, problem, [state], provenance)

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

    def to_arviz(self, num_samples: int = 1_000, *, seed: int = 0) -> "Data":
        """Returns an ArviZ object; see :func:`npdr_ppl.workflows.arviz_export.to_arviz`."""
        from npdr_ppl.workflows.arviz_export import to_arviz

        return to_arviz(self, num_samples, seed=seed)


class _ReferencePosterior(TorchDistribution):
    """The posterior as a distribution over z whose density is that over ξ."""

    arg_constraints: dict[str, Any] = {}
    has_rsample = False

    def __init__(
        self, posterior: Posterior, batch_shape: torch.Size | tuple[int, ...] = ()
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
        # From torch's global stream, as every Pyro statement.
        seed = int(torch.randint(2**31 - 1, ()))
        z = self.posterior._mixture_draws(shape.numel(), seed)
        z = z[torch.randperm(len(z))] if len(z) > 1 else z
        return z.reshape(shape + self.event_shape).double()

    def log_prob(self, value: Tensor) -> Tensor:
        flat = value.reshape(-1, value.shape[-1])
        return self.posterior.log_prob_reference(flat).reshape(value.shape[:-1])
