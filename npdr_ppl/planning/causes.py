"""The hypotheses that a plan is for: fitted causes of a run, or draws of the prior."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.discovery.proof.surviving_causes import VERSION
from npdr_ppl.errors import DataError, ModelError, NpdrError
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.handlers import (
    add_effect,
    num_finer_steps,
    with_finer_steps,
    with_noise,
)
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.model import Model
from npdr_ppl.language.only_simulator import only_simulator
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.language.wider_priors import with_wider_priors
from npdr_ppl.language.written_priors import read_prior
from npdr_ppl.models.effects import effect_class
from npdr_ppl.planning.settings import PLANNING
from npdr_ppl.posterior.robot_file import identified
from npdr_ppl.posterior.run_folder import MAX_FINER_STEPS
from npdr_ppl.run_files import read_json
from npdr_ppl.run_records import DiscoveryRecord, SurvivingCausesRecord

__all__ = ["Cause", "Known", "at_time_step", "causes_of_prior", "causes_of_run", "prior_of"]


@dataclass(frozen=True)
class Cause:
    """A model with parameters.

    Attributes:
        name: The effects that it has beside the original model's.
        model: The Pyro model, effects included.
        z: Reference coordinates of the parameters, ``(d,)``.
        precision: Inverse covariance of the coordinates after the recordings so far, ``(d, d)``.
        probability: Its probability; ``None`` if it is not known.
    """

    name: str
    model: Model
    z: Tensor
    precision: Tensor
    probability: float | None = None

    @property
    def simulator(self) -> Simulator:
        """The model's simulator, effects included."""
        return only_simulator(self.model)[0].simulator


@dataclass(frozen=True)
class Known:
    """What is known before the recording that is planned.

    Attributes:
        causes: The causes; several draws of the prior are causes of the same name.
        separations: Their distances along the recording so far, ``(n, n)``.
        time_step: Seconds per step of the recording so far, or of the model without one. Priors of
            delays and lags, and with them the coordinates, depend on it.
        recorded: The ranges of the recording so far; ``None`` without one.
        share: Effective number of independent measurements as a share of all.
        segment_length: Steps of a segment; ``None`` for the default.
        noise: Standard deviation of the measurements so far, by channel; empty if not known.
        is_prior: Whether the causes are draws of the prior.
    """

    causes: tuple[Cause, ...]
    separations: Tensor
    time_step: float
    recorded: Mapping[str, Any] | None = None
    share: float = 1.0
    segment_length: int | None = None
    noise: Mapping[str, float] = field(default_factory=dict)
    is_prior: bool = field(default=False)

    @property
    def probabilities(self) -> list[float]:
        """The probabilities of the causes, whose sum is 1; all the same if they are not known."""
        if all(cause.probability is None for cause in self.causes):
            return [1.0 / len(self.causes)] * len(self.causes)
        likely = [cause.probability or PLANNING.least_likely for cause in self.causes]
        return [part / sum(likely) for part in likely]


def causes_of_run(run: Path, model: Callable[..., Any]) -> Known:
    """Reads the causes that a finished run leaves possible.

    Args:
        run: Folder of a discovery or a fit.
        model: The model that was passed to the run.

    Raises:
        DataError: The run is unfinished, older than planning, or of another model.
    """
    if (run / "fit.json").is_file():
        return _causes_of_fit(run, model)
    if not (run / "discovery.json").is_file():
        raise DataError(f"{run} is no folder of a finished npdr fit or npdr discover.")
    found: Mapping[str, Any] = read_json(run / "discovery.json", DiscoveryRecord)
    record: SurvivingCausesRecord | None = found.get("surviving_causes")
    if record is None:
        raise DataError(
            f"{run} does not say which causes are left: it was written by an older version, or "
            "the search did not reach its end; run npdr discover again with another --out."
        )
    if record["version"] != VERSION:
        raise DataError(
            f"{run} keeps its causes in version {record['version']} of their format; this "
            f"npdr reads version {VERSION}."
        )
    revised = _revised(
        model, int(found.get("finer_steps") or 0), found.get("wider_priors") or [], run
    )
    laws = {
        law["effect"]: law["formula"] for law in (found.get("learned") or {}).get("laws") or []
    }
    step = float(record["time_step"])
    causes = tuple(_cause(revised, part, run, laws, step) for part in record["causes"])
    separations = torch.tensor(record["separations"], dtype=torch.float64)
    if not causes or separations.shape != (len(causes), len(causes)):
        raise DataError(f"{run} keeps causes and separations that do not fit together.")
    return Known(
        causes,
        separations,
        step,
        record,
        record["independent_share"],
        record["segment_length"],
        record["noise"],
    )


def causes_of_prior(model: Callable[..., Any], seed: int) -> Known:
    """Returns draws of a model's prior.

    Args:
        model: The model.
        seed: Seed of the draws.
    """
    step = only_simulator(model)[0].simulator.time_step
    prior = prior_of(model, step)
    generator = torch.Generator().manual_seed(seed)
    shape = PLANNING.num_draws - 1, prior.num_parameters
    draws = torch.randn(shape, generator=generator, dtype=torch.float64)
    # The middle of the prior is one of them.
    draws = torch.cat((torch.zeros_like(draws[:1]), draws))
    eye = torch.eye(prior.num_parameters, dtype=torch.float64)
    causes = tuple(Cause("the prior", model, z, eye) for z in draws)
    return Known(causes, torch.zeros(len(causes), len(causes)), step, is_prior=True)


def prior_of(model: Model, time_step: float) -> Prior:
    """Returns a model's prior without a recording.

    Args:
        model: The model.
        time_step: Seconds per step of the recordings. The priors of delays and lags reach at least
            a few steps.
    """
    # Inputs without channels, which a program only passes on.
    nothing = Inputs.single(
        torch.zeros(1, 0), torch.zeros(0), action_names=(), state_names=(), time_step=time_step
    )
    return Prior(with_noise(model, None), (nothing,))


def at_time_step(known: Known, time_step: float) -> Known:
    """Returns the same knowledge for recordings with another time step.

    Draws of the prior become draws of the prior at that time step.

    Raises:
        DataError: The priors at that time step do not contain a cause's parameters.
    """
    if math.isclose(time_step, known.time_step):
        return known
    if known.is_prior:
        # In reference coordinates every prior is the same normal distribution.
        return replace(known, time_step=time_step)
    causes = tuple(_cause_at(cause, known.time_step, time_step) for cause in known.causes)
    # A segment keeps its length in seconds.
    length = known.segment_length
    if length is not None:
        length = max(2, round(length * known.time_step / time_step))
    return replace(known, causes=causes, time_step=time_step, segment_length=length)


def _cause_at(cause: Cause, before: float, after: float) -> Cause:
    """Returns a cause whose coordinates are those of the priors at another time step."""
    old, new = prior_of(cause.model, before), prior_of(cause.model, after)

    def moved(z: Tensor) -> Tensor:
        return new.to_reference(old.to_parameters(z[None]))[0].to(z)

    z = moved(cause.z)
    slope = (moved(cause.z + 1e-3) - moved(cause.z - 1e-3)) / 2e-3  # by coordinate
    kept, wanted = new.to_parameters(z[None]), old.to_parameters(cause.z[None])
    is_kept = all(torch.allclose(kept[name], wanted[name], rtol=1e-3) for name in wanted)
    if not (is_kept and bool((slope > 0.0).all())):
        raise DataError(
            f"{cause.name} has parameters outside the priors for a time step of {after:g} s; plan "
            f"with a time step closer to that of the recording, {before:g} s."
        )
    return replace(cause, z=z, precision=cause.precision / slope / slope[:, None])


def _causes_of_fit(run: Path, model: Callable[..., Any]) -> Known:
    """Returns the posterior of a fit: its means, and its standard deviations."""
    found = identified(run)
    revised = _revised(model, found.finer_steps, [], run)
    step = found.time_step or only_simulator(revised)[0].simulator.time_step
    prior = prior_of(revised, step)
    record: Mapping[str, Any] = read_json(run / "fit.json")
    names = [site.name for site in prior.sites]
    if set(names) != set(found.values):
        raise DataError(_other_model(run, set(names) ^ set(found.values)))

    def place(shift: float) -> Tensor:
        values = {
            name: torch.tensor(
                [found.values[name] + shift * float(record["parameters"][name]["sd"])],
                dtype=torch.float64,
            )
            for name in names
        }
        return prior.to_reference(values)[0]

    z = place(0.0)
    # Half a deviation to either side stays inside a prior that the posterior touches.
    width = (place(0.5) - place(-0.5)).nan_to_num(1.0, 1.0, 1.0).abs().clamp(1e-6, 1.0)
    if not bool(z.isfinite().all()):
        raise DataError(f"{run}: a posterior mean lies outside the priors of the model.")
    cause = Cause("the fitted model", revised, z, width.square().reciprocal().diag())
    prepared: Mapping[str, Any] = record.get("preparation") or {}
    return Known(
        (cause,),
        torch.zeros(1, 1),
        step,
        share=float(prepared.get("independent_share") or 1.0),
        segment_length=prepared.get("segment_length"),
        noise=_noise(prepared, revised, run),
    )


def _noise(prepared: Mapping[str, Any], model: Model, run: Path) -> Mapping[str, float]:
    """Returns the noise that a fit estimated, or that its model declares; empty if neither."""
    found = prepared.get("noise")
    if found is None:
        return _declared_noise(model)
    if not isinstance(found, Mapping) or not all(
        isinstance(value, int | float) and value > 0.0 for value in found.values()
    ):
        raise DataError(f"{run} keeps a noise that is not a positive number for each channel.")
    return {str(name): float(value) for name, value in found.items()}


def _declared_noise(model: Model) -> Mapping[str, float]:
    """Returns the noise that a model declares, by sensor; empty if it declares no normal noise."""
    box = only_simulator(model)[0]
    noise, names = box.noise, [sensor.name for sensor in box.simulator.sensors]
    if noise is None or callable(noise):
        return {}
    values = noise if isinstance(noise, Mapping) else dict.fromkeys(names, noise)
    return {
        name: float(torch.as_tensor(value).double().flatten()[0]) for name, value in values.items()
    }


def _revised(
    model: Callable[..., Any], finer_steps: int, wider: list[list[str]], run: Path
) -> Callable[..., Any]:
    """Returns a model with the integration steps and the priors that a run ended with."""
    finer = finer_steps - num_finer_steps(model)
    if not 0 <= finer <= MAX_FINER_STEPS:
        raise DataError(f"{run} took {finer_steps} times finer steps, which the model cannot.")
    for _ in range(finer):
        model = with_finer_steps(model)
    for names in wider:
        model = with_wider_priors(model, names)
    return model


def _cause(
    model: Callable[..., Any],
    part: Mapping[str, Any],
    run: Path,
    laws: Mapping[str, str],
    time_step: float,
) -> Cause:
    """Returns a stored cause of a model; ``laws`` are the learned formulas by effect."""
    effects = [_effect(described, run, laws) for described in part["effects"]]
    for effect in effects:
        model = add_effect(model, effect)
    try:
        prior = prior_of(model, time_step)
    except NpdrError as error:
        raise DataError(f"{run} is not of this model: {error}") from None
    names = {site.name for site in prior.sites}
    z = torch.tensor(part["coordinates"], dtype=torch.float64)
    precision = torch.tensor(part["precision"], dtype=torch.float64)
    if names != set(part["parameters"]):
        raise DataError(_other_model(run, names ^ set(part["parameters"])))
    if precision.shape != (len(z), len(z)) or len(z) != prior.num_parameters:
        raise DataError(f"{run} keeps a cause whose numbers do not fit together.")
    name = " + ".join(effect.name for effect in effects) or "the original model"
    return Cause(name, model, z, precision, part["probability"])


def _effect(described: Mapping[str, Any], run: Path, laws: Mapping[str, str]) -> Effect:
    name = described["effect"]
    file = run / "learned_effect.py" if name in laws else "FILE.py"
    try:
        cls = effect_class(name)
    except ModelError:
        raise DataError(
            f"{run} has the effect {name!r} of a file, which a plan needs among the added ones; "
            f"give `npdr effects --add {file}` first."
        ) from None
    if name in laws and cls.law != laws[name]:
        raise DataError(
            f"{run} learned the law {laws[name]}, but the added effect {name!r} has another, "
            f"{cls.law}; give `npdr effects --remove {name}` and `npdr effects --add {file}`."
        )
    priors = {}
    for parameter, written in described["priors"].items():
        if written is None:
            raise DataError(
                f"{run} was searched with a prior of {parameter} of {name} that no file can keep; "
                "search again with one of Pyro's own distributions."
            )
        priors[parameter] = read_prior(written)
    effect = cls(described["port"], priors=priors)
    constants = dict(described["constants"])
    if constants != effect.constants and effect.has_ripples:
        effect = effect.with_ripples(int(constants["order"]))
    if constants != effect.constants:
        raise DataError(f"{run} has an effect {effect.name} with other constants {constants}.")
    return effect


def _other_model(run: Path, differing: set[str]) -> str:
    return (
        f"{min(differing)} is a parameter of only one of model and {run}; give the model that the "
        "run was given."
    )
