"""Probabilistic programming for robot simulators.

Declare a simulator and its domain parameters as a Pyro model, hand over measured rollouts, and get
a posterior with ArviZ diagnostics::

    import npdr_ppl as npdr

    posterior = npdr.infer(model, npdr.Rollouts.from_csv("measured.csv"), backend="snpe-c")
"""

import importlib
from typing import TYPE_CHECKING, Any

__all__ = [
    "Backend",
    "BulletSimulator",
    "Calibration",
    "Channel",
    "Comparison",
    "ControlTask",
    "DataOptions",
    "Discovery",
    "DiscoveryOptions",
    "Effect",
    "FunctionSimulator",
    "GymnasiumSimulator",
    "HardwareTarget",
    "Inputs",
    "LoopOptions",
    "MujocoSimulator",
    "NpdrError",
    "ODESimulator",
    "Parameter",
    "Policy",
    "Port",
    "Posterior",
    "Rollouts",
    "Simulator",
    "TargetDomain",
    "Training",
    "add_effect",
    "calibrate",
    "compare",
    "control_task",
    "diagnose",
    "discover",
    "infer",
    "remove_effect",
    "simulate",
    "train",
    "with_finer_steps",
    "with_likelihood",
    "with_noise",
    "with_wider_priors",
    "workers",
]

if TYPE_CHECKING:
    from npdr_ppl.discovery import Discovery, DiscoveryOptions, discover
    from npdr_ppl.engines.bullet import BulletSimulator
    from npdr_ppl.engines.functions import FunctionSimulator
    from npdr_ppl.engines.gymnasium import GymnasiumSimulator
    from npdr_ppl.engines.mujoco import MujocoSimulator
    from npdr_ppl.engines.ode.simulator import ODESimulator
    from npdr_ppl.engines.workers import workers
    from npdr_ppl.errors import NpdrError
    from npdr_ppl.inference.base import Backend
    from npdr_ppl.language.channels import Channel, Parameter, Port
    from npdr_ppl.language.effects import Effect
    from npdr_ppl.language.handlers import add_effect, remove_effect, with_finer_steps, with_noise
    from npdr_ppl.language.inputs import Inputs
    from npdr_ppl.language.simulator import Simulator
    from npdr_ppl.language.sites import simulate
    from npdr_ppl.language.wider_priors import with_wider_priors
    from npdr_ppl.loop.control_task import ControlTask, control_task
    from npdr_ppl.loop.loop_options import LoopOptions
    from npdr_ppl.loop.npdr_loop import Training, train
    from npdr_ppl.policies.base import Policy
    from npdr_ppl.posterior.calibration.calibrate import calibrate
    from npdr_ppl.posterior.calibration.calibration_result import Calibration
    from npdr_ppl.posterior.comparison.compare import compare
    from npdr_ppl.posterior.comparison.comparison_result import Comparison
    from npdr_ppl.posterior.diagnostics import diagnose
    from npdr_ppl.posterior.infer import infer
    from npdr_ppl.posterior.learned_likelihood import with_likelihood
    from npdr_ppl.posterior.posterior import Posterior
    from npdr_ppl.preparation.data_options import DataOptions
    from npdr_ppl.rollouts import Rollouts
    from npdr_ppl.targets import HardwareTarget, TargetDomain

# Loaded when first used, so that importing the package stays quick.
_HOMES = {
    "Backend": "inference.base",
    "BulletSimulator": "engines.bullet",
    "Calibration": "posterior.calibration.calibration_result",
    "Channel": "language.channels",
    "Comparison": "posterior.comparison.comparison_result",
    "ControlTask": "loop.control_task",
    "DataOptions": "preparation.data_options",
    "Discovery": "discovery",
    "DiscoveryOptions": "discovery",
    "Effect": "language.effects",
    "FunctionSimulator": "engines.functions",
    "GymnasiumSimulator": "engines.gymnasium",
    "HardwareTarget": "targets",
    "Inputs": "language.inputs",
    "LoopOptions": "loop.loop_options",
    "MujocoSimulator": "engines.mujoco",
    "NpdrError": "errors",
    "ODESimulator": "engines.ode.simulator",
    "Parameter": "language.channels",
    "Policy": "policies.base",
    "Port": "language.channels",
    "Posterior": "posterior.posterior",
    "Rollouts": "rollouts",
    "Simulator": "language.simulator",
    "TargetDomain": "targets",
    "Training": "loop.npdr_loop",
    "add_effect": "language.handlers",
    "calibrate": "posterior.calibration.calibrate",
    "compare": "posterior.comparison.compare",
    "control_task": "loop.control_task",
    "diagnose": "posterior.diagnostics",
    "discover": "discovery",
    "infer": "posterior.infer",
    "remove_effect": "language.handlers",
    "simulate": "language.sites",
    "train": "loop.npdr_loop",
    "with_finer_steps": "language.handlers",
    "with_likelihood": "posterior.learned_likelihood",
    "with_noise": "language.handlers",
    "with_wider_priors": "language.wider_priors",
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
