"""Bayesian linear regression on inverse dynamics: a posterior in closed form, without simulations.

The equations of motion of a mechanism are linear in base parameters β. Regression on recorded
motion and commands gives them in one step; Muratore et al. (2021) compare with it in Table 2. The
conjugate posterior over β (:mod:`npdr_ppl.inference.parts.samplers.conjugate`) ignores
plausibility: some of its draws have negative dampings or masses outside the prior's support. Such
draws are counted and left out. Let z_f be the free coordinates that β does not determine, for
example a motor's constants. The posterior over the parameters is then::

    q(z) ∝ p(z_f) · t(β(z)) |∂β/∂z_β|   on the plausible set,

where t is the Student-t posterior over β and z_β the coordinates it determines.

Reference: C. G. Atkeson, C. H. An, J. M. Hollerbach, Estimation of inertial parameters of
manipulator loads and links, 1986; F. Muratore et al., Neural posterior domain randomization, 2021.
"""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, get_args

import torch
from torch import Tensor

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Backend, Density, Problem, Progress, State
from npdr_ppl.inference.parts.samplers.conjugate import StudentT, linear_posterior
from npdr_ppl.language.linear_regression_problem import LinearRegression
from npdr_ppl.rollouts.differentiation import Smoothing

__all__ = ["BayesianLinearRegression", "LinearRegressionState", "RegressionDensity"]

logger = logging.getLogger(__name__)

NUM_DRAWS = 20_000
"""Number of draws from which the share of implausible ones is counted."""

CHUNK = 65_536
"""Number of draws mapped in one batch."""

PATIENCE = 20.0
"""Sampling stops with an error after this many times the expected number of draws."""

STEP = 5e-3
"""Step in z of the central differences of β. Parameters may be sampled in float32, whose rounding
is then 1e-4 of the difference; the formula's own error is 1e-5."""

Undetermined = Literal["prior", "nominal"]


@dataclass(frozen=True)
class LinearRegressionState(State):
    """The data that the next round needs.

    Attributes:
        posterior: Posterior over the base parameters; ``None`` before the first round.
        plausible: Share of its draws that are plausible.
    """

    posterior: StudentT | None
    plausible: float


@dataclass(frozen=True)
class BayesianLinearRegression(Backend[LinearRegressionState]):
    """Conjugate regression of inverse dynamics; see the module's text for the method.

    Args:
        position_cutoff: Cut-off in Hz of the filter that smooths position measurements before they
            are differentiated; ``None`` to choose it from the measurements' spectrum.
        parallel_cutoff: Cut-off in Hz of the filter applied to both sides of the equations;
            ``None`` for 0.4 times ``position_cutoff``.
        undetermined: Treatment of parameters that the motion does not determine: ``"prior"`` draws
            them from the prior, ``"nominal"`` holds them at the simulator's nominal values. With
            ``"nominal"`` the density over z is that of the determined coordinates given the
            others, and does not depend on the values passed for the latter.
    """

    name: ClassVar[str] = "bayesian-linear-regression"
    summary: ClassVar[str] = "conjugate regression of inverse dynamics, without simulations"
    uses_simulations: ClassVar[bool] = False
    state_class = LinearRegressionState

    position_cutoff: float | None = None
    parallel_cutoff: float | None = None
    undetermined: Undetermined = "prior"

    def __post_init__(self) -> None:
        """Validates the options."""
        self._check_choice("undetermined", get_args(Undetermined))
        Smoothing(self.position_cutoff, self.parallel_cutoff)

    def init(self, problem: Problem) -> LinearRegressionState:
        """Returns the state before the regression.

        Raises:
            BackendError: The problem has no simulator with inverse dynamics.
        """
        if problem.regression is None:
            raise BackendError(
                f"{self.name} needs a model with one simulator that declares inverse_dynamics "
                "(npdr_ppl.language.linear_dynamics); this one has none."
            )
        return LinearRegressionState(round=0, posterior=None, plausible=math.nan)

    def learn(
        self,
        problem: Problem,
        state: LinearRegressionState,
        z: Tensor,
        x: Tensor,
        progress: Progress,
    ) -> tuple[LinearRegressionState, dict[str, Any]]:
        """Does the regression; simulations are not used. See :meth:`Backend.learn`.

        The figures are ``implausible`` and ``draws``, the numbers of draws left out and tried,
        ``implausible_share``, and ``base``, the mean and standard deviation of every base
        parameter.

        Raises:
            BackendError: No draw is plausible.
        """
        regression = self._regression(problem)
        posterior = linear_posterior(
            regression.regressors,
            regression.targets,
            regression.prior_mean,
            regression.prior_covariance,
            regression.noise,
        )
        density = RegressionDensity(problem, regression, posterior, 1.0, self.undetermined)
        _, is_plausible = density.draw(NUM_DRAWS)
        implausible = NUM_DRAWS - int(is_plausible.sum())
        sds = posterior.standard_deviations()
        base = {
            name: {"mean": float(mean), "sd": float(sd)}
            for name, mean, sd in zip(regression.names, posterior.mean, sds, strict=True)
        }
        if implausible:
            logger.warning(
                "%d of %d draws (%.1f %%) of the regression's posterior are implausible, off the "
                "prior's support or not physical, and were left out.",
                implausible,
                NUM_DRAWS,
                100.0 * implausible / NUM_DRAWS,
            )
        if implausible == NUM_DRAWS:
            found = ", ".join(f"{n} = {v['mean']:.4g} ± {v['sd']:.2g}" for n, v in base.items())
            raise BackendError(
                f"None of {NUM_DRAWS} draws of the regression's posterior is plausible, i.e. on "
                f"the prior's support and physical; the base parameters are {found}: widen the "
                "prior, or attach the effect that is missing."
            )
        progress(1.0, f"{len(regression.targets)} rows, {implausible} implausible draws")
        figures = {
            "implausible": implausible,
            "implausible_share": implausible / NUM_DRAWS,
            "draws": NUM_DRAWS,
            "rows": len(regression.targets),
            "base": base,
        }
        plausible = 1.0 - implausible / NUM_DRAWS
        return replace(state, posterior=posterior, plausible=plausible), figures

    def densities(self, problem: Problem, state: State) -> list[Density]:
        """Returns the posterior, the only member."""
        state = self._told(state)
        assert state.posterior is not None
        regression, undetermined = self._regression(problem), self.undetermined
        return [
            RegressionDensity(problem, regression, state.posterior, state.plausible, undetermined)
        ]

    def tensors(self, state: State) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Splits a state into tensors and JSON-serialisable values."""
        state = self._own(state)
        tensors = {} if state.posterior is None else state.posterior.tensors()
        plausible = None if state.posterior is None else state.plausible
        return tensors, {"backend": self.name, "round": state.round, "plausible": plausible}

    def restore(
        self, problem: Problem, tensors: Mapping[str, Tensor], values: Mapping[str, Any]
    ) -> LinearRegressionState:
        """Rebuilds a state from :meth:`tensors`; see :meth:`Backend.restore`."""
        self._check_restored(problem, tensors, values)
        if not tensors:
            return LinearRegressionState(int(values["round"]), None, math.nan)
        return LinearRegressionState(
            int(values["round"]), StudentT.from_tensors(tensors), float(values["plausible"])
        )

    def _regression(self, problem: Problem) -> LinearRegression:
        if problem.regression is None:
            raise BackendError(f"{self.name} needs a problem with a regression.")
        return problem.regression(Smoothing(self.position_cutoff, self.parallel_cutoff))


class RegressionDensity(Density):
    """The plausible part of a regression's posterior, over reference coordinates.

    Args:
        problem: Gives the prior.
        regression: Gives the maps between β and z.
        posterior: The posterior over β.
        plausible: Share of its draws that are plausible.
        undetermined: See :class:`BayesianLinearRegression`.

    Raises:
        BackendError: Free coordinates would have to follow a prior that is not N(0, I), or be held
            at nominal values outside the prior's support.
    """

    def __init__(
        self,
        problem: Problem,
        regression: LinearRegression,
        posterior: StudentT,
        plausible: float,
        undetermined: Undetermined,
    ) -> None:
        self.problem = problem
        self.regression = regression
        self.posterior = posterior
        self.plausible = plausible
        self.undetermined = undetermined
        free = ~regression.determined
        if undetermined == "prior" and free.any() and not problem.is_prior_standard_normal:
            raise BackendError(
                "bayesian-linear-regression: parameters that the motion does not determine can "
                "follow their prior only if every prior has quantiles; hold them with "
                "undetermined='nominal'."
            )
        if undetermined == "nominal" and not regression.nominal[free].isfinite().all():
            raise BackendError(
                "bayesian-linear-regression: a nominal value lies off its prior's support; let "
                "undetermined parameters follow it with undetermined='prior'."
            )

    def draw(self, num_draws: int) -> tuple[Tensor, Tensor]:
        """Draws from the whole posterior over β, the implausible part included.

        Returns:
            Points ``(num_draws, d)`` and the mask ``(num_draws,)`` of the plausible ones; the
            values of the others have no meaning.
        """
        base = self.posterior.sample(num_draws)
        if self.undetermined == "prior":
            z = self.problem.sample_prior(num_draws).double().cpu()
        else:
            z = self.regression.nominal.nan_to_num().expand(num_draws, -1)
        return self.regression.to_reference(base, z)

    def sample(self, num_samples: int) -> Tensor:
        """Draws plausible points, ``(num_samples, d)``, by rejection.

        Raises:
            BackendError: Too few draws are plausible.
        """
        found: list[Tensor] = []
        missing, tried = num_samples, 0
        while missing > 0:
            z, is_plausible = self.draw(min(CHUNK, 256 + int(1.1 * missing / self.plausible)))
            found.append(z[is_plausible][:missing])
            missing, tried = missing - len(found[-1]), tried + len(z)
            if missing > 0 and tried > PATIENCE * (num_samples + CHUNK) / self.plausible:
                raise BackendError(
                    f"Only {num_samples - missing} of {tried} draws of the regression's posterior "
                    "are plausible; widen the prior."
                )
        return torch.cat(found)

    def log_prob(self, z: Tensor) -> Tensor:
        """Returns log q(z), ``(n,)``, at ``(n, d)``; −∞ where parameters are not physical."""
        points = z.double().cpu()
        log_prob = self.posterior.log_prob(self.regression.from_reference(points))
        log_prob = log_prob + self._log_jacobian(points)
        free = points[:, ~self.regression.determined]
        if self.undetermined == "prior":
            log_prob = log_prob - 0.5 * (free.square() + math.log(2.0 * math.pi)).sum(-1)
        log_prob = log_prob - math.log(self.plausible)
        return torch.where(log_prob.isnan(), -torch.inf, log_prob).to(z.device)

    def _log_jacobian(self, z: Tensor) -> Tensor:
        """Returns log |∂β/∂z_β|, ``(n,)``, by central differences."""
        columns = []
        for coordinate in self.regression.determined.nonzero().flatten():
            step = torch.zeros(z.shape[1], dtype=z.dtype)
            step[coordinate] = STEP
            ahead, behind = (self.regression.from_reference(z + s) for s in (step, -step))
            columns.append((ahead - behind) / (2.0 * STEP))
        return torch.linalg.slogdet(torch.stack(columns, dim=-1))[1]
