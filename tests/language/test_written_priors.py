"""Priors in files: they are read as they were written, and nothing else is read."""

import pyro.distributions as dist
import pytest
import torch

from npdr_ppl.errors import DataError
from npdr_ppl.language.written_priors import read_prior, written_prior

PRIORS = [
    dist.HalfNormal(0.3),
    dist.LogNormal(-1.0, 0.5),
    dist.Normal(0.2, 3.0),
    dist.Uniform(0.0, 0.06),
    dist.Gamma(2.0, 4.0),
]


@pytest.mark.parametrize("prior", PRIORS, ids=lambda prior: type(prior).__name__)
def test_a_prior_is_read_as_it_was_written(prior):
    written = written_prior(prior)
    assert written is not None
    again = read_prior(written)
    values = prior.sample((5,))
    torch.testing.assert_close(again.log_prob(values), prior.log_prob(values))


def test_other_priors_are_not_written():
    assert written_prior(dist.Normal(torch.zeros(2), 1.0)) is None
    assert written_prior(torch.distributions.Normal(0.0, 1.0)) is None
    assert written_prior(dist.Binomial(3, torch.tensor(0.5))) is None


@pytest.mark.parametrize(
    "written",
    [
        {},
        {"distribution": "os"},
        {"distribution": "Normal", "loc": "x", "scale": 1.0},
        {"distribution": "Normal", "loc": 0.0, "scale": -1.0},
        {"distribution": "Normal", "wrong": 0.0},
        {"distribution": "Delta", "v": 0.0},
        {"distribution": "Categorical", "probs": 0.5},
    ],
)
def test_what_is_no_prior_gets_a_sentence(written):
    with pytest.raises(DataError, match="is no prior of one number"):
        read_prior(written)
