"""Effect handlers: change a model's black-box sites without changing the model's code."""

from typing import Any

import pyro
import torch
from pyro.poutine.messenger import Messenger

from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.layers import Layer, layers
from npdr_ppl.language.model import Model
from npdr_ppl.language.noise import Noise
from npdr_ppl.language.sites import BlackBox, SimulatorBlackBox, SiteLikelihood

__all__ = [
    "EffectMessenger",
    "FinerStepsMessenger",
    "LikelihoodMessenger",
    "ModelWithEffects",
    "ModelWithFinerSteps",
    "NoiseMessenger",
    "SkipSimulation",
    "add_effect",
    "num_finer_steps",
    "remove_effect",
    "with_coarser_steps",
    "with_finer_steps",
    "with_noise",
]


class EffectMessenger(Messenger):
    """Attaches one effect to the simulators of a program while it runs.

    Inside the handler the effect's parameters become sample sites
    ``"<port>.<effect>.<parameter>"``, drawn just before the black-box site they act on. Several
    black-box sites whose simulators have the port represent one device and share the parameters.
    Default priors of delays and lags reach at least three steps of the inputs.

    Args:
        effect: The effect.
        site: Name of the only black-box site to attach to; ``None`` for all that have the port.
    """

    def __init__(self, effect: Effect, site: str | None = None) -> None:
        super().__init__()
        self.effect = effect
        self.site = site
        self._drawn: dict[str, torch.Tensor] | None = None
        self._attached = False

    def __enter__(self) -> Any:
        self._drawn = None
        self._attached = False
        return super().__enter__()

    def __exit__(self, exc_type: Any, exc_value: Any, traceback: Any) -> Any:
        if exc_type is None and not self._attached:
            raise ModelError(
                f"{self.effect!r} found no black-box site to attach to"
                + (f" (looked for {self.site!r})." if self.site else ".")
            )
        return super().__exit__(exc_type, exc_value, traceback)

    def _pyro_sample(self, msg: Any) -> None:
        box = msg["fn"]
        if not isinstance(box, SimulatorBlackBox):
            return
        if self.site is not None and msg["name"] != self.site:
            return
        if self._drawn is None:
            port = box.simulator.port(self.effect.port)
            priors = self.effect.at_rate(port, box.inputs.time_step).priors(port)
            self._drawn = {}
            for name, prior in priors.items():
                site = f"{self.effect.name}.{name}"
                self._drawn[site] = pyro.sample(site, prior)  # pyright: ignore[reportArgumentType]
        changed = box.with_effects(self.effect, parameters=self._drawn)
        # Plates may already have expanded the site, because they are inside this handler.
        shape = torch.broadcast_shapes(changed.batch_shape, box.batch_shape)
        msg["fn"] = changed.expand(shape)
        self._attached = True


class ModelWithEffects(Layer):
    """A Pyro model with effects attached; calling it runs the base model inside the handlers.

    Attributes:
        base: The model without effects.
        effects: The effects, each with the site it is restricted to, in the order of attachment.
    """

    def __init__(self, base: Model, effects: tuple[tuple[Effect, str | None], ...]) -> None:
        self.base = base
        self.effects = effects
        self.__name__ = getattr(base, "__name__", type(base).__name__)
        self.__doc__ = base.__doc__

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Runs the base model with all effects attached."""
        run = self.base
        # The innermost handler processes a site first, so the last effect is outermost.
        for effect, site in self.effects:
            run = EffectMessenger(effect, site)(run)
        return run(*args, **kwargs)

    def __repr__(self) -> str:
        names = " + ".join(effect.name for effect, _ in self.effects)
        return f"{self.__name__} + {names}"


def add_effect(model: Model, effect: Effect, *, site: str | None = None) -> ModelWithEffects:
    """Returns the model with an effect attached; it is still a Pyro model.

    Args:
        model: A Pyro model with a black-box site.
        effect: The effect, bound to a port.
        site: Name of the black-box site to attach to; ``None`` for all that have the port.

    Raises:
        ModelError: The effect is attached already.
    """
    base, effects = _parts(model)
    if effect.name in {present.name for present, _ in effects}:
        raise ModelError(f"{effect.name} is attached to {model!r} already.")
    return ModelWithEffects(base, (*effects, (effect, site)))


def remove_effect(model: Model, name: str) -> Model:
    """Returns the model without the effect called ``"<port>.<effect>"``.

    Raises:
        ModelError: The model has no such effect.
    """
    base, effects = _parts(model)
    kept = tuple((effect, site) for effect, site in effects if effect.name != name)
    if len(kept) == len(effects):
        present = ", ".join(effect.name for effect, _ in effects) or "none"
        raise ModelError(f"The model has no effect {name!r}; it has {present}.")
    return ModelWithEffects(base, kept) if kept else base


def _parts(model: Model) -> tuple[Model, tuple[tuple[Effect, str | None], ...]]:
    if isinstance(model, ModelWithEffects):
        return model.base, model.effects
    return model, ()


class FinerStepsMessenger(Messenger):
    """Makes a program's simulators integrate more accurately while it runs, if they can."""

    def _pyro_sample(self, msg: Any) -> None:
        box = msg["fn"]
        if isinstance(box, SimulatorBlackBox):
            finer = box.simulator.with_finer_steps()
            if finer is not None:
                msg["fn"] = box.with_simulator(finer)


class ModelWithFinerSteps(Layer):
    """A Pyro model whose simulators integrate more accurately than the model asks for.

    Attributes:
        base: The model.
    """

    def __init__(self, base: Model) -> None:
        self.base = base
        self.__name__ = getattr(base, "__name__", type(base).__name__)
        self.__doc__ = base.__doc__

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Runs the model with finer steps."""
        return FinerStepsMessenger()(self.base)(*args, **kwargs)

    def __repr__(self) -> str:
        return f"{self.__name__} in {'still ' * (num_finer_steps(self) - 1)}finer steps"


class CoarserStepsMessenger(Messenger):
    """Gives a program's simulators their coarser steps while it runs, if they have some."""

    def _pyro_sample(self, msg: Any) -> None:
        box = msg["fn"]
        if isinstance(box, SimulatorBlackBox):
            coarser = box.simulator.with_coarser_steps(time_step=box.inputs.time_step)
            if coarser is not None:
                msg["fn"] = box.with_simulator(coarser)


def with_coarser_steps(model: Model) -> Model:
    """Returns the model with cheaper steps; see :meth:`Simulator.with_coarser_steps`."""
    return CoarserStepsMessenger()(model)


def with_finer_steps(model: Model) -> Model:
    """Returns the model with simulators that integrate more accurately, if they can.

    One step per sample is enough to train a policy. In a comparison with measurements, the error
    of such steps looks like a delay. Apply the function again if the steps are still too coarse.
    """
    base, effects = _parts(model)
    base = ModelWithFinerSteps(base)
    return ModelWithEffects(base, effects) if effects else base


def num_finer_steps(model: Model) -> int:
    """Returns how often :func:`with_finer_steps` was applied to a model."""
    return sum(isinstance(layer, ModelWithFinerSteps) for layer in layers(model))


class NoiseMessenger(Messenger):
    """Replaces the measurement noise at a program's black-box sites while it runs.

    Args:
        noise: The noise, ``None`` for none.
    """

    def __init__(self, noise: Noise | None) -> None:
        super().__init__()
        self.noise = noise

    def _pyro_sample(self, msg: Any) -> None:
        if isinstance(msg["fn"], BlackBox):
            msg["fn"] = msg["fn"].with_noise(self.noise)


def with_noise(model: Model, noise: Noise | None) -> Model:
    """Returns the model with another measurement noise; see :func:`npdr_ppl.simulate`."""
    return NoiseMessenger(noise)(model)


class LikelihoodMessenger(Messenger):
    """Gives a program's black-box sites a learnt density while it runs.

    Args:
        likelihood: The density.
        site: Name of the only site to give it to; ``None`` for all.
    """

    def __init__(self, likelihood: SiteLikelihood, site: str | None = None) -> None:
        super().__init__()
        self.likelihood = likelihood
        self.site = site
        self._given = False

    def __enter__(self) -> Any:
        self._given = False
        return super().__enter__()

    def __exit__(self, exc_type: Any, exc_value: Any, traceback: Any) -> Any:
        if exc_type is None and not self._given:
            raise ModelError(
                "The learnt likelihood found no black-box site"
                + (f" {self.site!r}." if self.site else ".")
            )
        return super().__exit__(exc_type, exc_value, traceback)

    def _pyro_sample(self, msg: Any) -> None:
        if isinstance(msg["fn"], BlackBox) and self.site in (None, msg["name"]):
            msg["fn"] = msg["fn"].with_likelihood(self.likelihood)
            self._given = True


class SkipSimulation(Messenger):
    """Runs a program without simulating: black-box sites get zeros of the right shape.

    It is for runs that need only a program's priors.
    """

    def _pyro_sample(self, msg: Any) -> None:
        box = msg["fn"]
        if isinstance(box, BlackBox) and msg["value"] is None:
            event = box.event_shape if isinstance(box, SimulatorBlackBox) else torch.Size()
            msg["value"] = torch.zeros(()).expand(box.batch_shape + event)
