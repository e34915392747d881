"""BayesSim: mixture density networks on summary statistics of trajectories.

Ramos, Possas & Fox (2019), *BayesSim: adaptive domain randomization via probabilistic inference
for robotics simulators*, https://arxiv.org/abs/1906.01728. A mixture of Gaussians is fitted to
simulations from the prior by maximum likelihood. Its parameters are functions of the features; the
posterior is the mixture at the features of the observation. The functions are

* ``features="neural"``: a fully connected network, or
* ``features="fourier"``: linear in fixed Fourier features of a kernel
  (Rahimi & Recht 2007, *Random features for large-scale kernel machines*),

      h(f) = (cos(w_1^T f / s), sin(w_1^T f / s), ..., sin(w_m^T f / s)) / sqrt(m),

  whose frequencies w_i follow the kernel's spectral density, here as a scrambled Sobol sequence,
  and whose bandwidth s is the median distance between simulations. Only the linear head is
  trained.

Muratore et al. (2021) ran BayesSim with further rounds. These draw from the posterior and are
corrected as in :mod:`npdr_ppl.inference.snpe_a`. The paper corrects after training;
:mod:`npdr_ppl.inference.parts.bases.mixture_backend` explains why we correct during training.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

from torch import nn

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Problem
from npdr_ppl.inference.parts.bases.mixture_backend import MixtureBackend
from npdr_ppl.inference.parts.bases.neural_backend import NeuralState, Simulations
from npdr_ppl.inference.parts.mixtures.mixture_density import MixtureDensityNetwork
from npdr_ppl.inference.parts.samplers.fourier import KERNELS, FourierFeatures, median_distance
from npdr_ppl.inference.parts.training.preconditioning import Preconditioner

__all__ = ["BayesSim"]

FEATURES = ("neural", "fourier")


@dataclass(frozen=True)
class BayesSim(MixtureBackend):
    """BayesSim; see the module's text for the method.

    Args:
        features: ``"neural"`` or ``"fourier"``.
        frequencies: Number m of Fourier frequencies.
        kernel: Kernel of the Fourier features: ``"rbf"``, ``"matern-3/2"`` or ``"matern-5/2"``.

    The other options are those of
    :class:`~npdr_ppl.inference.parts.bases.mixture_backend.MixtureBackend`.
    """

    name: ClassVar[str] = "bayessim"
    summary: ClassVar[str] = "mixture density networks, neural or on Fourier features"
    continues: ClassVar[bool] = False

    components: int = 10
    features: Literal["neural", "fourier"] = "neural"
    frequencies: int = 256
    kernel: Literal["rbf", "matern-3/2", "matern-5/2"] = "matern-5/2"

    def __post_init__(self) -> None:
        """Validates the options."""
        super().__post_init__()
        self._check_choice("features", FEATURES)
        self._check_choice("kernel", tuple(KERNELS))
        self._check_at_least(1, "frequencies")

    def init(self, problem: Problem) -> NeuralState:
        """Returns the state before any simulation.

        Raises:
            BackendError: Fourier features were chosen, but the embedding is a trained network.
        """
        if self.features == "fourier" and problem.build_network is not None:
            raise BackendError(
                f"{self.name} with features='fourier' needs an embedding that is not trained."
            )
        return super().init(problem)

    def _hidden(self, num_features: int) -> tuple[nn.Module, int]:
        """Returns the hidden layers of one network and their number of outputs."""
        if self.features == "neural":
            return super()._hidden(num_features)
        return FourierFeatures(num_features, self.frequencies, self.kernel), 2 * self.frequencies

    def _starting_networks(
        self,
        problem: Problem,
        state: NeuralState,
        preconditioner: Preconditioner,
        simulations: Simulations,
    ) -> Sequence[MixtureDensityNetwork]:
        """Returns the networks, with the bandwidth set from the simulations' features."""
        networks = self._networks(problem)
        for network in networks:
            if isinstance(network.hidden, FourierFeatures):
                f = preconditioner.features(simulations.x)
                network.hidden.frequencies.div_(median_distance(f))
        return networks
