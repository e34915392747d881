"""All members in one pass are the members one by one."""

import pytest
import torch
from torch.func import stack_module_state

from npdr_ppl.inference.parts.flows.flows import build_networks
from npdr_ppl.inference.parts.flows.stacked_flow import stacked_log_prob


@pytest.mark.parametrize("flow", ["nsf", "maf", "affine-nsf"])
@pytest.mark.parametrize(("d", "num_features"), [(1, 3), (2, 1), (5, 8)])
@pytest.mark.parametrize("atoms", [(), (4,)])
def test_values_and_gradients_are_those_of_the_networks(flow, d, num_features, atoms):
    torch.manual_seed(0)
    networks = build_networks(3, d, torch.zeros(num_features), None, flow, 2, (16, 16), 8)
    for network in networks:
        network.double()
        for parameter in network.parameters():
            parameter.data.add_(0.3 * torch.randn_like(parameter))
    parameters, buffers = stack_module_state(list(networks))
    # Wide enough that some arguments lie beyond the splines' edges.
    u = 2.5 * torch.randn(3, 50, *atoms, d, dtype=torch.float64)
    f = torch.randn(3, 50, num_features, dtype=torch.float64)

    found = stacked_log_prob(networks[0], parameters, buffers)(u, f)
    expected = torch.stack([q(u[k], f[k]) for k, q in enumerate(networks)])
    assert found.shape == expected.shape
    assert torch.allclose(found, expected, atol=1e-9)

    found.sum().backward()
    expected.sum().backward()
    for name, stacked in parameters.items():
        for k, network in enumerate(networks):
            own = network.get_parameter(name).grad
            assert torch.allclose(stacked.grad[k], own, rtol=1e-7, atol=1e-8)
