"""The force that would explain the residuals has the shape of the hidden one."""

import torch

from npdr_ppl.discovery.screening.latent_force import Pulse, latent_force, responses
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.engines.common.compilation import signature


def test_the_latent_force_correlates_with_the_hidden_drag(dragged):
    case, hypothesis = dragged
    found = responses(hypothesis)
    (latent,) = latent_force(Projection(hypothesis), found)
    speed = found.channels["velocity"]
    drag = case.truth[0].parameters["drag"]
    # Parameters were fitted, so part of the drag hides in them; its shape remains.
    both = torch.stack((latent.force.flatten(), (-drag * speed * speed.abs()).flatten()))
    assert torch.corrcoef(both)[0, 1] > 0.6
    assert bool((latent.error > 0).all())


def test_a_compiled_loop_does_not_depend_on_where_a_pulse_began():
    fresh, used = Pulse("hinge"), Pulse("hinge")
    used.start_positions = torch.zeros(3)
    assert signature(fresh) == signature(used)
