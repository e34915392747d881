"""Least squares on a simulator's own noise-free output: can an effect's parameters be told?"""

import torch
from torch.distributions import biject_to

# Levenberg–Marquardt tries all of these dampings in one batch, relative to the largest curvature.
DAMPINGS = 10.0 ** torch.arange(-14.0, 3.0, 2.0, dtype=torch.float64)

# The prior's centre as a quantile, off the middle, where signs would be undecided; and where to
# start again if a misfit has several minima, as that of a frequency has.
STARTS = (0.55, 0.65, 0.75)
TRUTH = 0.7


class Recovery:
    """The fit of one effect's parameters in unconstrained coordinates.

    Args:
        simulator: The simulator with the effect attached.
        effect: The effect.
        inputs: What is simulated.
    """

    def __init__(self, simulator, effect, inputs):
        self.simulator, self.inputs = simulator, inputs
        port = simulator.port(effect.port)
        priors = effect.priors(port)
        self.sites = [f"{effect.name}.{name}" for name in priors]
        self.priors = list(priors.values())
        self.transforms = [biject_to(prior.support) for prior in self.priors]
        self.true = self.quantiles(torch.full((1,), TRUTH))
        observed = self.simulate(self.true)
        self.scale = observed.reshape(-1, observed.shape[-1]).std(0)
        self.observed = observed / self.scale
        # Some unconstrained coordinates are physical and small, so count them in units of this.
        self.unit = torch.stack(
            [
                (t.inv(p.icdf(torch.tensor(0.84))) - t.inv(p.icdf(torch.tensor(0.5)))).abs()
                for t, p in zip(self.transforms, self.priors, strict=True)
            ]
        ).double()

    def quantiles(self, levels):
        """Parameters at quantiles of their priors, (n, p)."""
        return torch.stack([prior.icdf(levels) for prior in self.priors], dim=-1).double()

    def coordinates(self, parameters):
        columns = zip(self.transforms, parameters.unbind(-1), strict=True)
        return torch.stack([t.inv(x) for t, x in columns], dim=-1) / self.unit

    def parameters(self, coordinates):
        columns = zip(self.transforms, (coordinates * self.unit).unbind(-1), strict=True)
        return torch.stack([t(z) for t, z in columns], dim=-1)

    def simulate(self, parameters):
        given = dict(zip(self.sites, parameters.unbind(-1), strict=True))
        return self.simulator.simulate(given, self.inputs)

    def residuals(self, coordinates):
        output = self.simulate(self.parameters(coordinates)) / self.scale - self.observed
        return output.flatten(1)

    def scan(self, num_points, num_rounds):
        """The same for one parameter whose misfit has too many minima for a descent."""
        levels = torch.linspace(0.002, 0.998, num_points)
        points = self.coordinates(self.quantiles(levels))
        for finer in range(num_rounds):
            costs = self.residuals(points).square().mean(-1)
            best = points[costs.argmin()]
            width = 0.02 / 100.0**finer
            around = torch.linspace(-width, width, num_points, dtype=torch.float64)
            points = best + around[:, None]
        return self.parameters(best), costs.min().sqrt()

    def descend(self, tolerance):
        """Returns the parameters found from one of the starts, and the root mean square misfit."""
        for level in STARTS:
            found, misfit = self._descend(
                self.coordinates(self.quantiles(torch.tensor([level])))[0]
            )
            if misfit < tolerance:
                break
        return found, misfit

    def _descend(self, start, step=1e-5, num_iterations=60):
        present = start
        cost = self.residuals(present[None]).square().sum()
        for _ in range(num_iterations):
            moves = step * torch.eye(len(present), dtype=torch.float64)
            both = self.residuals(torch.cat((present + moves, present - moves, present[None])))
            jacobian = ((both[: len(present)] - both[len(present) : -1]) / (2.0 * step)).T
            hessian, gradient = jacobian.T @ jacobian, jacobian.T @ both[-1]
            largest = hessian.diagonal().max().clamp_min(1e-300)
            damped = hessian + (DAMPINGS * largest)[:, None, None] * torch.eye(len(present))
            trials = present - torch.linalg.solve(damped, gradient.expand(len(DAMPINGS), -1))
            trials = present + (trials - present).clamp(-1.0, 1.0)
            costs = self.residuals(trials).square().sum(-1).nan_to_num(torch.inf)
            if costs.min() >= cost:
                break
            cost, present = costs.min(), trials[costs.argmin()]
        return self.parameters(present), (cost / self.observed.numel()).sqrt()
