"""SNPE-A: sequential neural posterior estimation with a mixture of Gaussians.

Papamakarios & Murray (2016), *Fast epsilon-free inference of simulation models with Bayesian
conditional density estimation*, https://arxiv.org/abs/1605.06376. Each round r

1. draws parameters z_n from a Gaussian proposal p~_r(z), the prior in the first round
   (Algorithm 1),
2. simulates features x_n ~ p(x | z_n),
3. fits a mixture density network and divides by the proposal, p(z | x) ~
   q~(z | x) p(z) / p~_r(z), analytically (Algorithm 2, Proposition 1). The next proposal is the
   Gaussian with the moments of the result at x_o. (The paper's networks have a single Gaussian
   until the last round.)

The prior is N(0, I), so that the quotient of Gaussians is known for every model. The division
takes place inside the likelihood rather than after training. It is therefore exact and gives a
proper density for any network, and the simulations of all rounds can be used.
:mod:`npdr_ppl.inference.parts.bases.mixture_backend` gives details and the differences from the
paper. Greenberg et al. (2019, https://arxiv.org/abs/1905.07488) train mixtures without atoms in
this form.
"""

from dataclasses import dataclass
from typing import ClassVar

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Problem
from npdr_ppl.inference.parts.bases.mixture_backend import MixtureBackend
from npdr_ppl.inference.parts.bases.neural_backend import NeuralState

__all__ = ["SNPEA"]


@dataclass(frozen=True)
class SNPEA(MixtureBackend):
    """Sequential neural posterior estimation, SNPE-A; see the module's text for the method.

    The options are those of
    :class:`~npdr_ppl.inference.parts.bases.mixture_backend.MixtureBackend`.
    """

    name: ClassVar[str] = "snpe-a"
    summary: ClassVar[str] = "sequential neural posterior estimation with mixtures of Gaussians"

    epochs: int = 60
    components: int = 8

    def init(self, problem: Problem) -> NeuralState:
        """Returns the state before any simulation.

        Raises:
            BackendError: The prior is not N(0, I) in reference coordinates.
        """
        if not problem.is_prior_standard_normal:
            raise BackendError(
                f"{self.name} divides by Gaussian proposals exactly, for which the prior must be "
                "N(0, I) in reference coordinates; this model's is not. Use snpe-c, or bayessim "
                "with one round."
            )
        return super().init(problem)
