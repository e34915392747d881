"""Velocity networks, and the posterior density defined by an equation with such a velocity."""

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from npdr_ppl.inference.base import Density
from npdr_ppl.inference.parts.flows.flow_base import CHUNK, finite_samples
from npdr_ppl.inference.parts.training.preconditioning import Preconditioner

__all__ = ["VelocityDensity", "VelocityNetwork", "end_angle"]

INITIAL_SCALE = 0.01
"""Factor on the last layer's initial weights: the network starts near zero velocity, that is, at
the preconditioner's linear-Gaussian posterior."""

NOISE_SPACING = 0.3
"""Factor kappa of the spacing of the solver's steps; larger values give more steps at the end."""

NUM_TIME_FEATURES = 7


def end_angle(sigma: float) -> float:
    """Returns the angle at which the share of noise is sigma times that of the parameters."""
    return math.atan2(1.0, sigma)


def time_features(angle: Tensor) -> Tensor:
    """Returns smooth functions of the angle, ``(..., 7)``.

    Besides waves there is asinh(tan(phi)). Near the end of the path it is the logarithm of the
    signal-to-noise ratio. There the velocity changes on the scale of the remaining noise.
    """
    waves = [wave(k * angle) for k in (1, 2, 4) for wave in (torch.cos, torch.sin)]
    return torch.stack((angle.tan().asinh() / 3, *waves), dim=-1)


class VelocityNetwork(nn.Module):
    """A velocity v(y, phi, h(f)) of two residual blocks, modulated by time and features.

        s   = silu(A silu(B [time(phi), h(f)] + b) + a),
        h_0 = F y + c,
        h_k = h_{k-1} + O_k silu((1 + S_k s) * (I_k h_{k-1} + i_k) + T_k s) + o_k,      k = 1, 2,
        v   = L h_2 + l,

    after feature-wise modulation (Perez et al. 2018, https://arxiv.org/abs/1709.07871). All terms
    that do not depend on y are computed once for all points of the same time and features. Only
    the narrow residual blocks are evaluated at every point. With two blocks the exact divergence
    costs no more than the velocity, see :meth:`velocity_and_divergence`.

    Args:
        num_parameters: Dimension d of y.
        num_features: Length of h(f).
        embedding: Network h, or ``None`` for the identity.
        hidden: Width of the residual blocks.
        context: Width of the network that computes s.
    """

    def __init__(
        self,
        num_parameters: int,
        num_features: int,
        embedding: nn.Module | None,
        hidden: int,
        context: int,
    ) -> None:
        super().__init__()
        self.embedding = embedding
        self.features = nn.Linear(num_features, context)
        self.time = nn.Linear(NUM_TIME_FEATURES, context)
        self.context = nn.Linear(context, context)
        self.modulation = nn.Linear(context, 4 * hidden)
        self.first = nn.Linear(num_parameters, hidden)
        self.inner_1, self.outer_1 = nn.Linear(hidden, hidden), nn.Linear(hidden, hidden)
        self.inner_2, self.outer_2 = nn.Linear(hidden, hidden), nn.Linear(hidden, hidden)
        self.last = nn.Linear(hidden, num_parameters)
        with torch.no_grad():
            self.last.weight.mul_(INITIAL_SCALE)
            self.last.bias.zero_()

    def forward(self, points: Tensor, f: Tensor) -> Tensor:
        """Returns velocities ``(n, k, d)``.

        Args:
            points: Positions y and, in the last column, angles phi, ``(n, k, d + 1)``.
            f: Standardised features, ``(n, ...)``.
        """
        context = self.embed(f)[:, None]
        return self.velocity(points[..., :-1], self.modulate(points[..., -1], context))

    def embed(self, f: Tensor) -> Tensor:
        """Returns the features' contribution, ``(n, context)``."""
        return self.features(f if self.embedding is None else self.embedding(f))

    def modulate(self, angle: Tensor, context: Tensor) -> Tensor:
        """Returns the blocks' modulation ``(..., 4 hidden)`` at angles ``(...)``."""
        s = nn.functional.silu(self.time(time_features(angle)) + context)
        return self.modulation(nn.functional.silu(self.context(s)))

    def velocity(self, y: Tensor, modulation: Tensor) -> Tensor:
        """Returns velocities at positions ``(..., d)``."""
        scale_1, shift_1, scale_2, shift_2 = modulation.chunk(4, dim=-1)
        h = self.first(y)
        h = h + self.outer_1(nn.functional.silu((1 + scale_1) * self.inner_1(h) + shift_1))
        h = h + self.outer_2(nn.functional.silu((1 + scale_2) * self.inner_2(h) + shift_2))
        return self.last(h)

    def velocity_and_divergence(self, y: Tensor, modulation: Tensor) -> tuple[Tensor, Tensor]:
        """Returns velocities ``(n, d)`` at positions ``(n, d)`` and their divergence, ``(n,)``.

        With D_k the diagonal matrix of the slopes of block k's activation at a point, the Jacobian
        is L (1 + O_2 D_2 I_2) (1 + O_1 D_1 I_1) F, and its trace

            tr(L F) + sum_k diag(I_k F L O_k) . D_k + D_2 . (I_2 O_1 * (I_1 F L O_2)^T) D_1,

        a quadratic form of the slopes whatever d is.
        """
        scale_1, shift_1, scale_2, shift_2 = modulation.chunk(4, dim=-1)
        h = self.first(y)
        value, slope_1 = _silu((1 + scale_1) * self.inner_1(h) + shift_1)
        h, slope_1 = h + self.outer_1(value), (1 + scale_1) * slope_1
        value, slope_2 = _silu((1 + scale_2) * self.inner_2(h) + shift_2)
        h, slope_2 = h + self.outer_2(value), (1 + scale_2) * slope_2

        around = self.first.weight @ self.last.weight  # F L
        back_1 = self.inner_1.weight @ around
        back_2 = self.inner_2.weight @ around
        direct_1 = (back_1 * self.outer_1.weight.T).sum(-1)
        direct_2 = (back_2 * self.outer_2.weight.T).sum(-1)
        forth = self.inner_2.weight @ self.outer_1.weight
        both = forth * (back_1 @ self.outer_2.weight).T
        divergence = (
            around.trace()
            + slope_1 @ direct_1
            + slope_2 @ direct_2
            + (slope_2 * (slope_1 @ both.T)).sum(-1)
        )
        return self.last(h), divergence


def _silu(x: Tensor) -> tuple[Tensor, Tensor]:
    """Returns silu(x) and its derivative."""
    gate = x.sigmoid()
    value = x * gate
    return value, gate + value * (1 - gate)


class VelocityDensity(Density):
    """The posterior of one ensemble member given the observation.

    The equation dy/dphi = v(y, phi) is solved from phi = 0, y ~ N(0, I), to the end of the path by
    the classical Runge-Kutta method with fixed steps; log densities follow the solution backwards
    with the exact divergence (Chen et al. 2018, https://arxiv.org/abs/1806.07366, Eq. 8),

        log q(y_end) = log N(y_0; 0, I) - int div v dphi.

    Args:
        network: A trained network, on the CPU or a GPU.
        preconditioner: The preconditioner fitted before training, on the same device.
        observation: Observation x_o, ``(F,)`` or a raw array, on the same device.
        sigma: Remaining noise at the end of the path.
        steps: Number of steps of the solver.
    """

    def __init__(
        self,
        network: VelocityNetwork,
        preconditioner: Preconditioner,
        observation: Tensor,
        sigma: float,
        steps: int,
    ) -> None:
        self._network = network
        self._preconditioner = preconditioner
        self._features = preconditioner.features(observation[None])
        self._scale = math.sqrt(1 + sigma**2)  # u_1 = r y at t = 1
        self._num_steps = steps
        angles = _grid(sigma, steps)
        self._widths = angles.diff().tolist()
        with torch.no_grad():
            context = network.embed(self._features)
            # Runge-Kutta needs the velocity at the ends and at the middle of every step.
            middle = (angles[1:] + angles[:-1]) / 2
            self._at_grid = network.modulate(angles.to(context), context)
            self._at_middle = network.modulate(middle.to(context), context)

    def sample(self, num_samples: int) -> Tensor:
        """Draws ``(num_samples, d)`` from torch's global stream."""
        d = len(self._preconditioner.offset)

        def draw(n: int) -> Tensor:
            y = torch.randn(n, d).to(self._features.device)
            for step in range(self._num_steps):
                y = self._advance(self._network.velocity, y, step, 1)
            return self._preconditioner.unwhiten(self._scale * y, self._features)

        return finite_samples(draw, num_samples, d)

    def log_prob(self, z: Tensor) -> Tensor:
        """Returns the log density at ``(n, d)``, shape ``(n,)``; differentiable in z."""
        u = self._preconditioner.whiten(z.to(self._features.device), self._features)
        values = [self._log_prob(chunk / self._scale) for chunk in u.split(CHUNK)]
        log_det = self._preconditioner.log_det - u.shape[-1] * math.log(self._scale)
        return (torch.cat(values) + log_det).to(z.device)

    def _log_prob(self, y: Tensor) -> Tensor:
        """Returns the log density of the end point, ``(n, d)`` to ``(n,)``."""
        state = torch.cat((y, torch.zeros_like(y[:, :1])), -1)
        for step in reversed(range(self._num_steps)):
            state = self._advance(self._velocity_and_divergence, state, step, -1)
        start, change = state[:, :-1], state[:, -1]
        return change - 0.5 * (start**2 + math.log(2 * math.pi)).sum(-1)

    def _velocity_and_divergence(self, state: Tensor, modulation: Tensor) -> Tensor:
        """Returns the velocity of y and, as the last column, its divergence, ``(n, d + 1)``."""
        value, divergence = self._network.velocity_and_divergence(state[:, :-1], modulation)
        return torch.cat((value, divergence[:, None]), -1)

    def _advance(
        self, derivative: Callable[[Tensor, Tensor], Tensor], y: Tensor, step: int, sign: int
    ) -> Tensor:
        """Makes a classical Runge-Kutta step forwards (sign 1) or backwards (-1)."""
        width = sign * self._widths[step]
        ends = (step, step + 1)[::sign]
        first, middle, last = self._at_grid[ends[0]], self._at_middle[step], self._at_grid[ends[1]]
        k1 = derivative(y, first)
        k2 = derivative(y + width / 2 * k1, middle)
        k3 = derivative(y + width / 2 * k2, middle)
        k4 = derivative(y + width * k3, last)
        return y + width / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _grid(sigma: float, steps: int) -> Tensor:
    """Returns the angles between the solver's steps, ``(steps + 1,)``, in float64.

    They are evenly spaced in g(phi) = phi + kappa asinh(tan(phi)): at first in the angle, at the
    end in the logarithm of the remaining noise, -log(cos(phi)).
    """
    end = end_angle(sigma)
    fine = torch.linspace(0.0, end, 4097, dtype=torch.float64)
    spacing = fine + NOISE_SPACING * fine.tan().asinh()
    wanted = torch.linspace(0.0, float(spacing[-1]), steps + 1, dtype=torch.float64)
    above = torch.searchsorted(spacing, wanted).clamp(1, len(fine) - 1)
    weight = (wanted - spacing[above - 1]) / (spacing[above] - spacing[above - 1])
    return torch.lerp(fine[above - 1], fine[above], weight.clamp(0.0, 1.0))
