"""Units of domain parameters, from what their simulators declare."""

from npdr_ppl.language.prior import Prior
from npdr_ppl.language.sites import SimulatorBlackBox

__all__ = ["parameter_units"]


def parameter_units(prior: Prior) -> dict[str, str]:
    """Returns the units of the latent sites that carry a parameter's name."""
    known: dict[str, str] = {}
    for box in prior.black_boxes.values():
        if isinstance(box, SimulatorBlackBox):
            known |= {p.name: p.unit for p in box.simulator.parameters}
            for effect in box.simulator.effects:
                units = effect.units(box.simulator.port(effect.port))
                known |= {f"{effect.name}.{name}": unit for name, unit in units.items()}
    return {site.name: known[site.name] for site in prior.sites if site.name in known}
