"""Sensitivities: the change from each candidate effect along the recording.

At zero strength an effect changes nothing, and close to it the change is linear in the strengths.
The slope is a finite difference of the black box: one simulation with the effect at a small size,
minus one without it. Shape parameters are tried at several values, and effects that are not smooth
in their strength at several sizes.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.probes import Probe, needs_size, probe_of
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.resonance_sizes import at_telling_sizes
from npdr_ppl.discovery.screening.settings import SENSITIVITY
from npdr_ppl.engines.pooled.pool_simulator import PooledSimulator
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.preparation.segment_model import SegmentModel

__all__ = ["Variant", "sensitivities"]


_ROUNDING_ROOM = 1e-6
"""Relative change of a step that no command notices. Solvers need some room between bounds."""


@dataclass(frozen=True)
class Variant:
    """An effect with one shape, switched on at one size.

    Attributes:
        effect: The effect.
        values: Its parameters at size one, by short name.
        strengths: Names of the parameters that scale it.
        nominal: Their values at zero strength.
        lower: Smallest multiple of the size that the priors allow, by strength.
        upper: Largest multiple of the size, by strength.
        deviation: Standard deviation of the priors in multiples of the size, by strength.
        change: Change of the whitened measurements per size, ``(S, N, k)``.
        is_hinted: Whether its shape was found on the recording itself.
        is_linear: Whether its change is proportional to its strengths up to typical ones.
    """

    effect: Effect
    values: Mapping[str, float]
    strengths: tuple[str, ...]
    nominal: Tensor
    lower: Tensor
    upper: Tensor
    deviation: Tensor
    change: Tensor
    is_hinted: bool = False
    is_linear: bool = True

    def parameters(self, sizes: Tensor) -> dict[str, Tensor]:
        """Returns the parameters by site name for multiples of the size, ``(k,)``."""
        values = {name: torch.tensor(v, dtype=torch.float64) for name, v in self.values.items()}
        for k, name in enumerate(self.strengths):
            values[name] = self.nominal[k] + sizes[k] * (values[name] - self.nominal[k])
        return {f"{self.effect.name}.{name}": value for name, value in values.items()}


def sensitivities(
    hypothesis: Hypothesis,
    effects: tuple[Effect, ...],
    hints: Mapping[str, Mapping[str, float]] | None = None,
    projection: Projection | None = None,
) -> Iterator[Variant]:
    """Yields the change from each effect, in each shape and size.

    Effects are simulated in groups, so that memory does not grow with their number. Effects whose
    simulation fails are left out.

    Args:
        hypothesis: The fitted model that the effects would be added to.
        effects: The candidates.
        hints: Additional shapes to try, by effect's name: values of its parameters.
        projection: The fitted model, to leave out sizes of a resonance that cannot explain its
            residuals; ``None`` to leave out only sizes that change the motion alike.
    """
    fit, own = hypothesis.fit, hypothesis.segments
    segments = own.in_coarser_steps(fit.z, fit.offsets)
    box = segments.black_box(fit.z[None])
    base = segments.run(box.simulator, box.parameters, fit.offsets[None])[0]
    probes = []
    for effect in effects:
        try:
            box.simulator.with_effects(effect)
        except ModelError:
            continue
        probes.append(
            probe_of(effect, segments.inputs, box.simulator, (hints or {}).get(effect.name))
        )
    largest = float(segments.whitened(base, fit.scale).abs().max())
    rounding = SENSITIVITY.rounding_errors * torch.finfo(base.dtype).eps * largest

    def changed(group: list[Probe]) -> list[Tensor]:
        differences = _differences(hypothesis, segments, base, group)
        if segments is not own and not bool(differences.isfinite().all()):
            # Coarser steps can be unstable where the model's own are not.
            there = own.black_box(fit.z[None])
            start = own.run(there.simulator, there.parameters, fit.offsets[None])[0]
            differences = _differences(hypothesis, own, start, group)
        return list(differences.split([len(probe.runs) for probe in group]))

    for group in _groups(probes, box.simulator, segments):
        if group[0].effect.is_resonant:
            group, parts = at_telling_sizes(group, changed, projection)
        else:
            parts = changed(group)
        for probe, rows in zip(group, parts, strict=True):
            yield from _variants(probe, rows, rounding)


def _differences(
    hypothesis: Hypothesis, segments: SegmentModel, base: Tensor, group: list[Probe]
) -> Tensor:
    """Returns the change of the whitened measurements by each run of a group, ``(n, S, N)``.

    Args:
        hypothesis: The fitted model.
        segments: The model in the steps in which it is simulated.
        base: Its readings without the effects, ``(S, K, C)``.
        group: The effects and their runs.
    """
    fit = hypothesis.fit
    box = segments.black_box(fit.z[None])
    changed = box.simulator.with_effects(*(probe.effect for probe in group))
    parameters, num = _side_by_side(group), sum(len(probe.runs) for probe in group)
    differences = []
    for part in torch.arange(num).split(segments.draws_per_chunk):
        own = {name: value[part] for name, value in parameters.items()}
        starts = fit.offsets[None].expand(len(part), -1, -1)
        moved = segments.run(changed, {**box.parameters, **own}, starts)
        differences.append(segments.whitened(moved - base, fit.scale))
    return torch.cat(differences)


def _groups(
    probes: list[Probe], simulator: Simulator, segments: SegmentModel
) -> Iterator[list[Probe]]:
    """Yields groups of effects of one kind that are simulated together, each in its own rows.

    An effect at zero strength changes nothing, and a step of many simulations costs little more
    than one of a few. If each simulation is a call of an engine, every effect is its own group.
    """
    num_segments = segments.inputs.num_segments
    # A few segments of a recording at a high rate have as many measurements as a chunk should.
    most = min(SENSITIVITY.segments_per_part, segments.draws_per_chunk * num_segments)
    together = 1 if isinstance(simulator, PooledSimulator) else most
    kinds: dict[object, list[Probe]] = {}
    for probe in probes:
        effect = probe.effect
        port = simulator.port(effect.port)
        kind = port.kind, getattr(effect, "needs_joint", False), effect.is_resonant
        kinds.setdefault(kind, []).append(probe)
    for members in kinds.values():
        group: list[Probe] = []
        for probe in members:
            size = num_segments * sum(len(p.runs) for p in (*group, probe))
            if group and size > together:
                yield group
                group = []
            group.append(probe)
        yield group


def _side_by_side(group: list[Probe]) -> dict[str, Tensor]:
    """Returns the parameters of a group's effects; each is switched on only in its own rows."""
    result = {}
    for probe in group:
        resting = {p.name: p.nominal for p in probe.effect.parameters}
        rows = [run if p is probe else resting for p in group for run in p.runs]
        result |= {
            f"{probe.effect.name}.{name}": torch.tensor([row[name] for row in rows]).double()
            for name in resting
        }
    return result


def _variants(probe: Probe, rows: Tensor, rounding: float) -> list[Variant]:
    """Returns an effect's variants from its runs' changes of the whitened measurements.

    Changes up to a rounding error are left out.
    """
    strengths = probe.strengths
    result = []
    parts = rows.split(len(strengths))
    tried = [size for _, _, size in probe.cases]
    ratio = SENSITIVITY.resonance_ratio
    # Each size stands for those up to its neighbours.
    least = [tried[0] / ratio, *tried[:-1]]
    most = [*tried[1:], tried[-1] * ratio]
    for (values, is_hinted, size), nominal, part, low, high in zip(
        probe.cases, probe.nominal, parts, least, most, strict=True
    ):
        if not bool(part.isfinite().all()) or float(part.abs().max()) <= rounding:
            continue
        difference = part / size
        full = torch.tensor([values[n] for n in strengths], dtype=torch.float64)
        lower, upper, deviation = _limits(probe.priors, strengths, nominal, full)
        if probe.effect.is_resonant:
            lower, upper = lower.clamp_min(low), upper.clamp_max(high)
        elif probe.effect.rounds and is_hinted:
            whole = strengths.index(probe.effect.rounds)
            lower[whole], upper[whole] = 1.0 - _ROUNDING_ROOM, 1.0 + _ROUNDING_ROOM
        change = difference.permute(1, 2, 0)
        result.append(
            Variant(
                probe.effect,
                values,
                strengths,
                nominal,
                lower,
                upper,
                deviation,
                change,
                is_hinted,
                not needs_size(probe.effect, strengths),
            )
        )
    return result


def _limits(
    priors: Mapping[str, Distribution],
    strengths: tuple[str, ...],
    nominal: Tensor,
    full: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the least, greatest and typical multiples of the size that the priors allow."""
    lower, upper, deviation = [], [], []
    for k, name in enumerate(strengths):
        prior = priors[name]
        unit = float(full[k] - nominal[k])
        support: object = prior.support
        low = float(getattr(support, "lower_bound", -math.inf))
        high = float(getattr(support, "upper_bound", math.inf))
        ends = sorted(((low - float(nominal[k])) / unit, (high - float(nominal[k])) / unit))
        lower.append(ends[0])
        upper.append(ends[1])
        spread = (float(prior.variance) + (float(prior.mean) - float(nominal[k])) ** 2) ** 0.5
        deviation.append(max(spread / abs(unit), 1e-6))
    return (
        torch.tensor(lower, dtype=torch.float64),
        torch.tensor(upper, dtype=torch.float64),
        torch.tensor(deviation, dtype=torch.float64),
    )
