"""Embeddings: from trajectories to the features that a backend conditions on.

May import: language. Start reading at ``base.py``, then ``score.py``, the default features.
"""

from npdr_ppl.embeddings.base import Embedding
from npdr_ppl.embeddings.networks import Convolutional, Linear, Recurrent
from npdr_ppl.embeddings.registry import embedding_by_name
from npdr_ppl.embeddings.score import Score
from npdr_ppl.embeddings.statistics import AllSteps, BayesSimStatistic, Differences, LastStep
from npdr_ppl.embeddings.wrappers import Averaged, Masked, Strided

__all__ = [
    "AllSteps",
    "Averaged",
    "BayesSimStatistic",
    "Convolutional",
    "Linear",
    "Differences",
    "Embedding",
    "LastStep",
    "Masked",
    "Recurrent",
    "Score",
    "Strided",
    "embedding_by_name",
]
