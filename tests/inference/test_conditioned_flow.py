"""A flow at one context is the flow."""

import pytest
import torch

from npdr_ppl.inference.parts.flows.conditioned_flow import conditioned
from npdr_ppl.inference.parts.flows.flows import FlowNetwork


@pytest.mark.parametrize("flow", ["nsf", "maf", "affine-nsf"])
@pytest.mark.parametrize(("d", "num_features"), [(1, 4), (2, 1), (5, 40)])
@pytest.mark.parametrize("is_reversed", [False, True])
def test_values_densities_and_inverses_are_those_of_the_flow(flow, d, num_features, is_reversed):
    torch.manual_seed(0)
    network = FlowNetwork(d, num_features, None, flow, 2, (16, 16), 4, is_reversed).double()
    network.requires_grad_(False)
    for parameter in network.parameters():
        parameter.add_(0.1 * torch.randn_like(parameter))
    context = torch.randn(1, num_features, dtype=torch.float64)
    u = torch.randn(50, d, dtype=torch.float64)
    whole = network.transform(context.expand(50, -1))
    fixed = conditioned(network.transform, context)
    for ours, reference in zip(fixed.call_and_ladj(u), whole.call_and_ladj(u), strict=True):
        assert torch.allclose(ours, reference, atol=1e-9)
    assert torch.allclose(fixed.inv(u), whole.inv(u), atol=1e-9)
    assert torch.allclose(fixed(fixed.inv(u)), u, atol=1e-6)
