"""Probabilistic programming for robot simulators.

Declare a simulator and its domain parameters as a Pyro model, hand over measured rollouts, and get
a posterior with ArviZ diagnostics::

    import npdr_ppl as npdr

    posterior = npdr.infer(model, npdr.Rollouts.from_csv("measured.csv"), backend="snpe-c")
"""

import importlib
from typing import TYPE_CHECKING, Any

__all__ = [
    "Calibration",
    "Channel",
    "Discovery",
    "DiscoveryOptions",
    "Effect",
    "GymnasiumSimulator",
    "Inputs",
    "LoopOptions",
    "MujocoSimulator",
    "NpdrError",
    "Parameter",
    "Port",
    "Posterior",
    "Rollouts",
    "Simulator",
    "Training",
    "add_effect",
    "calibrate",
    "compare",
    "diagnose",
    "discover",
    "infer",
    "remove_effect",
    "simulate",
    "train",
    "with_likelihood",
    "with_finer_steps",
    "with_noise",
    "with_wider_priors",
    "workers",
]

if TYPE_CHECKING:
    from npdr_ppl.discovery import Discovery, DiscoveryOptions, discover
    from npdr_ppl.engines.gymnasium import GymnasiumSimulator
    from npdr_ppl.engines.mujoco import MujocoSimulator
    from npdr_ppl.engines.workers import workers
    from npdr_ppl.errors import NpdrError
    from npdr_ppl.language.channels import Channel, Parameter, Port
    from npdr_ppl.language.effects import Effect
    from npdr_ppl.language.handlers import (
        add_effect,
        remove_effect,
        with_finer_steps,
        with_noise,
    )
    from npdr_ppl.language.inputs import Inputs
    from npdr_ppl.language.simulator import Simulator
    from npdr_ppl.language.sites import simulate
    from npdr_ppl.language.wider_priors import with_wider_priors
    from npdr_ppl.loop.loop_options import LoopOptions
    from npdr_ppl.loop.npdr_loop import Training, train
    from npdr_ppl.posterior.calibration.calibrate import calibrate
    from npdr_ppl.posterior.calibration.calibration_result import Calibration
    from npdr_ppl.posterior.comparison.compare import compare
    from npdr_ppl.posterior.diagnostics import diagnose
    from npdr_ppl.posterior.infer import infer
    from npdr_ppl.posterior.learned_likelihood import with_likelihood
    from npdr_ppl.posterior.posterior import Posterior
    from npdr_ppl.rollouts import Rollouts

# Loaded when first used, so that importing the package stays quick.
_HOMES = {
    "Calibration": "posterior.calibration.calibration_result",
    "Channel": "language.channels",
    "Discovery": "discovery",
    "DiscoveryOptions": "discovery",
    "Effect": "language.effects",
    "GymnasiumSimulator": "engines.gymnasium",
    "Inputs": "language.inputs",
    "LoopOptions": "loop.loop_options",
    "MujocoSimulator": "engines.mujoco",
    "NpdrError": "errors",
    "Parameter": "language.channels",
    "Port": "language.channels",
    "Posterior": "posterior.posterior",
    "Rollouts": "rollouts",
    "Simulator": "language.simulator",
    "Training": "loop.npdr_loop",
    "add_effect": "language.handlers",
    "calibrate": "posterior.calibration.calibrate",
    "compare": "posterior.comparison.compare",
    "diagnose": "posterior.diagnostics",
    "discover": "discovery",
    "infer": "posterior.infer",
    "remove_effect": "language.handlers",
    "simulate": "language.sites",
    "train": "loop.npdr_loop",
    "with_likelihood": "posterior.learned_likelihood",
    "with_finer_steps": "language.handlers",
    "with_wider_priors": "language.wider_priors",
    "with_noise": "language.handlers",
    "workers": "engines.workers",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("npdr-ppl")
    if name in _HOMES:
        return getattr(importlib.import_module(f"npdr_ppl.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'npdr_ppl' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, "__version__"})
