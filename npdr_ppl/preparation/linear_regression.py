"""A bound model as a linear regression on its simulator's inverse dynamics."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from scipy import linalg
from torch import Tensor

from npdr_ppl.errors import BackendError, DataError, ModelError, TooShortError
from npdr_ppl.inference.parts.samplers.conjugate import row_noise
from npdr_ppl.language.effects import LinearForceEffect
from npdr_ppl.language.linear_dynamics import InverseDynamics, Motion
from npdr_ppl.language.linear_regression_problem import LinearRegression
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.language.sites import SimulatorBlackBox
from npdr_ppl.preparation.settings import LINEAR_REGRESSION
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.collection import pieces
from npdr_ppl.rollouts.differentiation import (
    Smoothing,
    cutoffs,
    differentiate,
    held_actions,
    thin,
)

__all__ = ["LinearForm", "regression_of"]


class LinearForm:
    """The base parameters of a model's simulator and effects, as functions of its latent sites.

    The model may fix some of the simulator's parameters. As long as the base parameters then
    still fill a linear space, of the dimension of the determined sites, regression goes on in
    that space: with a known length, say, mass and first moment are proportional.

    Args:
        prior: The model's prior.
        box: Its only black-box site.

    Attributes:
        names: Names of the base parameters that are regressed, r of them.
        prior_mean: Their mean under the prior, ``(r,)``.
        prior_covariance: Their covariance, ``(r, r)``.
        determined: Mask of the coordinates of z that they determine, ``(d,)``.

    Raises:
        ModelError: The simulator declares no inverse dynamics.
        BackendError: The model does not have this form; the message says why.
    """

    def __init__(self, prior: Prior, box: SimulatorBlackBox) -> None:
        self.prior = prior
        self.simulator = box.simulator
        self.dynamics = _declared(box.simulator)
        self.effects = _linear_effects(box.simulator)
        latent = {site.name for site in prior.sites}
        self.fixed = {
            name: value.double().cpu()
            for name, value in {**_nominal(box.simulator), **box.parameters}.items()
            if name not in latent
        }
        self._check_sites()
        sampled_effects = {name for effect in self.effects for name in effect.parameter_names}
        self.determined_sites = tuple(
            site.name
            for site in prior.sites
            if site.name in self.dynamics.determined or site.name in sampled_effects
        )
        self.determined = torch.zeros(prior.num_parameters, dtype=torch.bool)
        for site in prior.sites:
            self.determined[site.coordinates] = site.name in self.determined_sites
        with seeded(0, "linear form"):
            z, other = (
                prior.sample(LINEAR_REGRESSION.num_prior_draws),
                prior.sample(LINEAR_REGRESSION.num_prior_draws),
            )
        self._check_order(z, other)
        self._reduce(self.all_base(self.parameters(z)))

    def parameters(self, z: Tensor) -> dict[str, Tensor]:
        """Returns every parameter of simulator and effects at z, ``(n, d)``, as ``(n,)`` each."""
        sampled = {name: v.double().cpu() for name, v in self.prior.to_parameters(z).items()}
        return {**{name: value.expand(len(z)) for name, value in self.fixed.items()}, **sampled}

    def all_base(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns all base parameters, the effects' behind the simulator's, ``(n, k)``."""
        scale = self.dynamics.force_scale(parameters)
        parts = [self.dynamics.to_base(parameters)]
        for effect in self.effects:
            own = effect.to_base(effect.own_parameters(parameters))
            parts.append(torch.stack(own, dim=-1) * scale[..., None])
        return torch.cat(parts, dim=-1)

    def rows(self, motion: Motion) -> tuple[Tensor, Tensor]:
        """Returns both sides of the equations: ``(T, joints, r)`` and ``(T, joints)``."""
        own = self.dynamics.regressors(motion)
        columns = [own]
        joints = [port.name for port in self.simulator.ports if port.kind == "force"]
        for effect in self.effects:
            joint = joints.index(effect.port)
            forces = effect.columns(motion.positions[joint], motion.velocities[joint])
            column = own.new_zeros(*own.shape[:-1], len(forces))
            # Forces stand on the other side of the equations.
            column[:, joint] = -torch.stack(forces, dim=-1)
            columns.append(column)
        every = torch.cat(columns, dim=-1)
        return every @ self.gain, self.dynamics.targets(motion) - every @ self.offset

    def from_reference(self, z: Tensor) -> Tensor:
        """Returns the regressed base parameters at z; NaN where parameters are not physical."""
        parameters = self.parameters(z)
        base = self.all_base(parameters)[:, self.chosen]
        return torch.where(self.dynamics.is_physical(parameters)[:, None], base, torch.nan)

    def to_reference(self, base: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Maps base parameters to z, as :class:`LinearRegression` requires."""
        given = self.parameters(z)
        found = given | self._physical(base @ self.gain.T + self.offset, given)
        values = {site.name: found[site.name] for site in self.prior.sites}
        is_plausible = self.dynamics.is_physical(found) & self.prior.on_support(values)
        kept = {
            name: torch.where(is_plausible, value, given[name]) for name, value in values.items()
        }
        return self.prior.to_reference(kept), is_plausible

    def nominal(self) -> Tensor:
        """Returns z of the nominal values, ``(d,)``; NaN where a prior does not reach them."""
        number = len(self.prior.sites)
        middle = self.parameters(torch.zeros(number, self.prior.num_parameters))
        nominal = _nominal(self.simulator)
        values = {}
        for row, site in enumerate(self.prior.sites):
            # A row per site, so that one nominal value off its support leaves the others alone.
            values[site.name] = middle[site.name].clone()
            values[site.name][row] = nominal[site.name]
        reached = self.prior.on_support(values)
        for row, site in enumerate(self.prior.sites):
            if not reached[row]:
                values[site.name][row] = middle[site.name][row]
        z = self.prior.to_reference(values)
        result = torch.full((self.prior.num_parameters,), torch.nan, dtype=z.dtype)
        for row, site in enumerate(self.prior.sites):
            if reached[row]:
                result[site.coordinates] = z[row, site.coordinates]
        return result

    def _physical(self, every: Tensor, given: Mapping[str, Tensor]) -> dict[str, Tensor]:
        stop = len(self.dynamics.base)
        found = self.dynamics.to_physical(every[:, :stop], given)
        scale = self.dynamics.force_scale(given)
        for effect in self.effects:
            start, stop = stop, stop + _num_base(effect)
            base = (every[:, start:stop] / scale[:, None]).unbind(-1)
            values = effect.from_base(base)
            found |= {f"{effect.name}.{name}": value for name, value in values.items()}
        return found

    def _check_sites(self) -> None:
        known = {p.name for p in self.simulator.parameters}
        known |= {name for effect in self.effects for name in effect.parameter_names}
        for site in self.prior.sites:
            if site.name not in known or site.shape != torch.Size():
                raise BackendError(
                    f"Linear regression needs latent sites that are parameters of "
                    f"{self.simulator.name} by name, one number each; {site.name!r} with shape "
                    f"{tuple(site.shape)} is not."
                )

    def _check_order(self, z: Tensor, other: Tensor) -> None:
        """Refuses priors in which a free site depends on one that the regression determines."""
        mixed = torch.where(self.determined, other, z)
        before, after = self.parameters(z), self.parameters(mixed)
        for site in self.prior.sites:
            if site.name not in self.determined_sites and not torch.equal(
                before[site.name], after[site.name]
            ):
                raise BackendError(
                    f"The prior of {site.name} depends on a parameter that the regression "
                    f"determines; sample {site.name} first."
                )

    def _reduce(self, draws: Tensor) -> None:
        """Finds base parameters that all others are affine functions of: β_all = G β + β₀."""
        mean, spread = draws.mean(0), draws.std(0)
        varies = spread > LINEAR_REGRESSION.relative_rank * mean.abs()
        centred = (draws - mean) / torch.where(varies, spread, 1.0) * varies
        # QR with pivoting takes the columns in the order of what each adds to those before.
        decomposition: Any = linalg.qr(centred.numpy(), mode="r", pivoting=True)
        size, order = np.abs(np.diag(decomposition[0])), decomposition[1]
        rank = int((size > LINEAR_REGRESSION.relative_rank * size[0]).sum()) if varies.any() else 0
        if rank != len(self.determined_sites):
            raise BackendError(
                f"The base parameters of {self.simulator.name} vary in {rank} directions under "
                f"the prior, but the sites they determine are {len(self.determined_sites)} "
                f"({', '.join(self.determined_sites) or 'none'}); sample all of "
                f"{', '.join(self.dynamics.determined)}, or fix others."
            )
        self.chosen = torch.as_tensor(np.sort(order[:rank]))
        solution = torch.linalg.lstsq(centred[:, self.chosen], centred).solution
        gain = solution.T * spread[:, None] / spread[self.chosen]
        gain[~varies] = 0.0
        gain[self.chosen] = torch.eye(rank, dtype=gain.dtype)
        self.gain = gain
        self.offset = mean - gain @ mean[self.chosen]
        self.offset[self.chosen] = 0.0
        self.prior_mean = mean[self.chosen]
        self.prior_covariance = draws[:, self.chosen].T.cov().reshape(rank, rank)
        names = [parameter.name for parameter in self.dynamics.base]
        for effect in self.effects:
            names += [f"{effect.name}.{number}" for number in range(_num_base(effect))]
        self.names = tuple(names[i] for i in self.chosen)


def regression_of(
    prior: Prior, box: SimulatorBlackBox, rollouts: Rollouts, smoothing: Smoothing
) -> LinearRegression:
    """Returns a model and a recording as a linear regression.

    Whole rollouts are used, not segments: nothing is simulated, so no simulation has to be
    re-synchronised. The rows of each joint are divided by the standard deviation of their
    residuals, so that forces in N and torques in N m are comparable.

    Args:
        prior: The model's prior.
        box: Its only black-box site.
        rollouts: The recording.
        smoothing: Cut-offs of the filters.

    Raises:
        ModelError: The simulator declares no inverse dynamics.
        BackendError: The model has no linear form.
        DataError: A position was not recorded, or the rollouts are too short.
    """
    form = LinearForm(prior, box)
    rows, targets = _recorded_rows(form, rollouts, smoothing)
    noise = row_noise(rows, targets, form.prior_mean, form.prior_covariance)
    return LinearRegression(
        regressors=(rows / noise[:, None]).flatten(0, 1),
        targets=(targets / noise).flatten(),
        names=form.names,
        prior_mean=form.prior_mean,
        prior_covariance=form.prior_covariance,
        determined=form.determined,
        nominal=form.nominal(),
        to_reference=form.to_reference,
        from_reference=form.from_reference,
    )


def _recorded_rows(
    form: LinearForm, rollouts: Rollouts, smoothing: Smoothing
) -> tuple[Tensor, Tensor]:
    """Returns filtered rows of all rollouts, ``(N, joints, r)`` and ``(N, joints)``."""
    simulator, rollouts = form.simulator, pieces(rollouts)
    joints = [state.name for state in simulator.states if state.rate_of is None]
    missing = [name for name in joints if name not in rollouts.channel_names]
    if missing:
        raise DataError(
            f"Linear regression differentiates position readings, but {', '.join(missing)} was "
            "not recorded."
        )
    columns = [rollouts.channel_names.index(name) for name in joints]
    readings = [values[:, columns] for values in rollouts.readings]
    channels = [rollouts.action_names.index(action.name) for action in simulator.actions]
    lower = [action.lower for action in simulator.actions]
    upper = [action.upper for action in simulator.actions]
    step = rollouts.time_step
    position_cutoff, parallel_cutoff = cutoffs(readings, step, smoothing)
    parts = []
    for positions, actions in zip(readings, rollouts.actions, strict=True):
        derivatives = differentiate(positions, step, position_cutoff)
        commands = held_actions(np.clip(actions[:, channels], lower, upper))
        motion = Motion(
            *(
                tuple(torch.as_tensor(column) for column in table.T)
                for table in (
                    derivatives.positions,
                    derivatives.velocities,
                    derivatives.accelerations,
                    commands,
                )
            )
        )
        rows, targets = form.rows(motion)
        both = torch.cat((rows, targets[..., None]), dim=-1).numpy()
        parts.append(torch.as_tensor(thin(both, step, parallel_cutoff)))
    both = torch.cat(parts)
    if both[..., 0].numel() <= len(form.names):
        raise TooShortError(
            f"{len(both)} rows are left of the rollouts by a filter of {parallel_cutoff:.3g} Hz, "
            f"too few for {len(form.names)} base parameters; record longer rollouts."
        )
    return both[..., :-1], both[..., -1]


def _declared(simulator: Simulator) -> InverseDynamics:
    dynamics = simulator.inverse_dynamics
    if dynamics is None:
        raise ModelError(
            f"{simulator.name} cannot be fitted by linear regression until it declares its "
            "equations of motion: give it the attribute inverse_dynamics, an InverseDynamics with "
            "base, determined, regressors, targets, to_base and to_physical "
            "(npdr_ppl.language.linear_dynamics)."
        )
    return dynamics


def _linear_effects(simulator: Simulator) -> tuple[LinearForceEffect, ...]:
    linear = []
    for effect in simulator.effects:
        if not isinstance(effect, LinearForceEffect):
            raise BackendError(
                f"Linear regression cannot infer {effect.name}, which is not a force that is "
                "linear in its parameters; remove the effect or choose another backend."
            )
        linear.append(effect)
    return tuple(linear)


def _num_base(effect: LinearForceEffect) -> int:
    """Returns the number of an effect's base parameters."""
    return len(effect.to_base(effect.own_parameters({})))


def _nominal(simulator: Simulator) -> dict[str, Tensor]:
    """Returns the nominal values of simulator and effects by site name."""
    values = simulator.nominal()
    for effect in simulator.effects:
        own = effect.own_parameters({}).values()
        values |= dict(zip(effect.parameter_names, own, strict=True))
    return values
