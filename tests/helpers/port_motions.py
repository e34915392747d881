"""Motion at ports with random values, for tests of learned laws."""

import torch

from npdr_ppl.discovery.learning.recorded_motion import PortMotion
from npdr_ppl.language.channels import Port


def made_up(kind, **values):
    """Motion at a port with random values, in two segments of ten steps."""
    units = {"q": "rad", "v": "rad/s", "tau": "N m", "t": "s", "u": "N m", "y": "rad"}
    units |= {"q_1": "rad", "v_1": "rad/s"}
    generator = torch.Generator().manual_seed(0)
    motion = {
        name: size * torch.randn(2, 10, generator=generator, dtype=torch.float64)
        for name, size in values.items()
    }
    motion["t"] = motion["t"].abs()
    port = Port("hinge", kind, "N m", rated=2.0)
    edges = torch.arange(11)
    past = 0.3 * torch.randn(2, 7, generator=generator, dtype=torch.float64)
    own = {name: units[name] for name in motion}
    others = ("elbow",) if "q_1" in motion else ()
    return PortMotion(port, motion, own, None, edges, 0.01, past, 0.03, others)


JOINT = made_up("force", q=1.5, v=3.0, tau=1.0, t=2.0, q_1=1.2, v_1=2.5)
COMMAND = made_up("action", u=1.0, t=2.0)
SENSOR = made_up("sensor", y=1.5, t=2.0)
