from dataclasses import dataclass
from typing import ClassVar

import torch

from npdr_ppl.inference.base import Problem
from npdr_ppl.inference.embedding_network import build_embedding
from npdr_ppl.inference.mixture_backend import MixtureBackend
from npdr_ppl.inference.mixture_density import MixtureDensityNetwork, perceptron
__all__ = ["SNPEA"]


@dataclass(frozen=True)
class SNPEA(MixtureBackend):
    name: ClassVar[str] = "snpe-a"
    summary: ClassVar[str] = "sequential neural posterior estimation with mixtures of Gaussians"

    components: int = 8
    hidden: tuple[int, ...] = (64, 64)

    def __post_init__(self) -> None:
        """Validates the options."""
        super().__post_init__()
        self._check_widths("hidden")

    def _networks(self, problem: Problem) -> list[MixtureDensityNetwork]:
        networks = []
        for _ in range(self.members):
            embedding, num_features = build_embedding(
                problem.build_network, problem.observation.to("cpu", torch.float32)
            )
            networks.append(
                MixtureDensityNetwork(
                    problem.num_parameters,
                    self.hidden[-1],
                    self.components,
                    perceptron(num_features, self.hidden),
                    embedding,
                )
            )
        return networks
