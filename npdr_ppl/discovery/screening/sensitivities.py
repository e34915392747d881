"""Sensitivities: the change from each candidate effect along the recording.

At zero strength an effect changes nothing, and close to it the change is linear in the strengths.
The slope is a finite difference of the black box: one simulation with the effect at a small size,
minus one without it. Shape parameters are tried at several values, and effects that are not smooth
in their strength at several sizes.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.settings import SENSITIVITY
from npdr_ppl.engines.pooled.pool_simulator import PooledSimulator
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import ActionEffect, Effect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.reference import quantile
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
            _probe(effect, segments.inputs, box.simulator, (hints or {}).get(effect.name))
        )
    largest = float(segments.whitened(base, fit.scale).abs().max())
    rounding = SENSITIVITY.rounding_errors * torch.finfo(base.dtype).eps * largest

    def changed(group: list[_Probe]) -> list[Tensor]:
        differences = _differences(hypothesis, segments, base, group)
        if segments is not own and not bool(differences.isfinite().all()):
            # Coarser steps can be unstable where the model's own are not.
            there = own.black_box(fit.z[None])
            start = own.run(there.simulator, there.parameters, fit.offsets[None])[0]
            differences = _differences(hypothesis, own, start, group)
        return list(differences.split([len(probe.runs) for probe in group]))

    for group in _groups(probes, box.simulator, segments):
        if group[0].effect.is_resonant:
            group, parts = _at_telling_sizes(group, changed, projection)
        else:
            parts = changed(group)
        for probe, rows in zip(group, parts, strict=True):
            yield from _variants(probe, rows, rounding)


def _at_telling_sizes(
    group: "list[_Probe]",
    changed: "Callable[[list[_Probe]], list[Tensor]]",
    projection: Projection | None,
) -> "tuple[list[_Probe], list[Tensor]]":
    """Returns the probes with the sizes that tell something, and their changes.

    Far from the frequencies of the motion, neighbouring resonances change it alike. Between two
    sizes that do not, the one in the middle is tried, and so on. With residuals, the part of the
    changes that initial states and parameters can imitate is removed first. Nothing is tried
    between two sizes whose changes are too large to explain the residuals, for example if a soft
    joint makes its servo unstable. It is assumed that those between them are too large as well.

    Args:
        group: Probes of resonances with all their sizes, which ascend.
        changed: Returns the changes of the whitened measurements by each run of probes.
        projection: The residuals to be explained; ``None`` if sizes only have to differ.
    """
    num = len(group[0].cases)
    found: list[dict[int, Tensor]] = [{} for _ in group]
    waiting = [sorted({*range(0, num, SENSITIVITY.resonance_stride), num - 1}) for _ in group]
    while any(waiting):
        asked = [probe.at(cases) for probe, cases in zip(group, waiting, strict=True) if cases]
        rows = iter(changed(asked))
        for k, (probe, cases) in enumerate(zip(group, waiting, strict=True)):
            if cases:
                found[k] |= dict(zip(cases, next(rows).split(len(probe.strengths)), strict=True))
                waiting[k] = _between_unlike(found[k], projection)
    chosen = [sorted(known) for known in found]
    return (
        [probe.at(cases) for probe, cases in zip(group, chosen, strict=True)],
        [torch.cat([known[k] for k in cases]) for known, cases in zip(found, chosen, strict=True)],
    )


def _between_unlike(known: Mapping[int, Tensor], projection: Projection | None) -> list[int]:
    """Returns the middles between neighbouring sizes that differ, unless both are too large.

    Args:
        known: Changes of the whitened measurements by sizes, ``(1, S, N)``: a resonance has one
            strength.
        projection: As for :func:`_at_telling_sizes`.
    """
    cases = sorted(known)
    columns = torch.stack([known[case].sum(0) for case in cases], dim=-1)
    if projection is None:
        flat = columns.flatten(0, 1)
        products, scores, misfit = flat.mT @ flat, torch.zeros(len(cases)), math.inf
    else:
        found = projection.scores(columns)
        products, scores, misfit = found.information, found.score, projection.misfit
    middles = []
    for k, (one, other) in enumerate(itertools.pairwise(cases)):
        if other - one == 1:
            continue
        (a, ab), (_, b) = products[k : k + 2, k : k + 2].tolist()
        is_alike = ab >= SENSITIVITY.alike * math.sqrt(max(a * b, 1e-300))
        # Neither noise nor the residuals tell these apart.
        score = float(scores[k + 1] - scores[k])
        is_alike |= max(a + b - 2.0 * ab, abs(score)) < SENSITIVITY.least_difference
        # |r - m x|² exceeds |r|² for all m above 2 |r| / |x|. If no size between them is tried,
        # the larger one stands for those as well, with multiples m down to this one.
        least = SENSITIVITY.resonance_ratio ** (one - other)
        is_useless = not (a <= 4.0 * misfit or least**2 * b <= 4.0 * misfit)
        if not (is_alike or is_useless):
            middles.append((one + other) // 2)
    return middles


def _differences(
    hypothesis: Hypothesis, segments: SegmentModel, base: Tensor, group: "list[_Probe]"
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


@dataclass(frozen=True)
class _Probe:
    """An effect to be simulated in several shapes and sizes.

    Attributes:
        effect: The effect.
        priors: Its priors, by parameter.
        cases: Values of its parameters at size one, whether they are hinted, and the size.
        strengths: Names of the parameters that scale it.
        nominal: Their values at zero strength in each case; for a limit, the largest command.
        runs: Parameters of each simulation: one per case and strength, the others at zero
            strength.
    """

    effect: Effect
    priors: Mapping[str, Distribution]
    cases: list[tuple[dict[str, float], bool, float]]
    strengths: tuple[str, ...]
    nominal: list[Tensor]
    runs: list[dict[str, float]]

    def at(self, cases: Sequence[int]) -> "_Probe":
        """Returns the probe with some of its cases only."""
        width = len(self.strengths)
        return replace(
            self,
            cases=[self.cases[k] for k in cases],
            nominal=[self.nominal[k] for k in cases],
            runs=[run for k in cases for run in self.runs[k * width : (k + 1) * width]],
        )


def _probe(
    effect: Effect, inputs: Inputs, simulator: Simulator, hint: Mapping[str, float] | None
) -> _Probe:
    port = simulator.port(effect.port)
    priors = effect.priors(port)
    probe = effect.probe(port)
    strengths = tuple(p.name for p in effect.strengths)
    resting = {p.name: p.nominal for p in effect.parameters}
    peaks = _peaks(effect, inputs)
    probe |= {name: SENSITIVITY.first_limit * peak for name, peak in peaks.items()}
    shapes = [(shape, False) for shape in _shapes(effect, priors, strengths)]
    if hint:
        shapes.append(({**shapes[0][0], **hint}, True))
    sizes = SENSITIVITY.sizes if _needs_size(effect, strengths) else (SENSITIVITY.smooth_size,)
    if effect.is_resonant:
        shapes, sizes = shapes[:1], SENSITIVITY.resonant_sizes
    limits = [n for n in strengths if math.isinf(resting[n]) and n not in peaks]
    if limits:
        # How much of a motion a limit cuts off is not known, so several values are tried.
        shapes, sizes = _limit_shapes(shapes[0][0], limits, priors), (1.0,)
    cases = [
        ({**probe, **shape}, is_hinted, size)
        for shape, is_hinted in shapes
        # Only the whole step is tried: half of it rounds to other values.
        for size in ((1.0,) if is_hinted and effect.rounds else sizes)
    ]
    nominal = [
        torch.tensor([_resting(resting[n], values[n]) for n in strengths]).double()
        for values, _, _ in cases
    ]
    runs = [
        _switched_on(values, size, on, zero[k], resting, strengths)
        for (values, _, size), zero in zip(cases, nominal, strict=True)
        for k, on in enumerate(strengths)
    ]
    return _Probe(effect, priors, cases, strengths, nominal, runs)


def _groups(
    probes: list[_Probe], simulator: Simulator, segments: SegmentModel
) -> Iterator[list[_Probe]]:
    """Yields groups of effects of one kind that are simulated together, each in its own rows.

    An effect at zero strength changes nothing, and a step of many simulations costs little more
    than one of a few. If each simulation is a call of an engine, every effect is its own group.
    """
    num_segments = segments.inputs.num_segments
    # A few segments of a recording at a high rate have as many measurements as a chunk should.
    most = min(SENSITIVITY.segments_per_part, segments.draws_per_chunk * num_segments)
    together = 1 if isinstance(simulator, PooledSimulator) else most
    kinds: dict[object, list[_Probe]] = {}
    for probe in probes:
        effect = probe.effect
        port = simulator.port(effect.port)
        kind = port.kind, getattr(effect, "needs_joint", False), effect.is_resonant
        kinds.setdefault(kind, []).append(probe)
    for members in kinds.values():
        group: list[_Probe] = []
        for probe in members:
            size = num_segments * sum(len(p.runs) for p in (*group, probe))
            if group and size > together:
                yield group
                group = []
            group.append(probe)
        yield group


def _side_by_side(group: list[_Probe]) -> dict[str, Tensor]:
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


def _variants(probe: _Probe, rows: Tensor, rounding: float) -> list[Variant]:
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
                not _needs_size(probe.effect, strengths),
            )
        )
    return result


def _switched_on(
    values: Mapping[str, float],
    size: float,
    on: str,
    nominal: Tensor,
    resting: Mapping[str, float],
    strengths: tuple[str, ...],
) -> dict[str, float]:
    """Returns an effect's parameters with one strength at a size and the others at zero."""
    rest = {name: resting[name] if name in strengths else value for name, value in values.items()}
    zero = float(nominal)
    return rest | {on: size * (values[on] - zero) + zero}


def _shapes(
    effect: Effect, priors: Mapping[str, Distribution], strengths: tuple[str, ...]
) -> list[dict[str, float]]:
    """Returns values of the shape parameters, the nominal ones first."""
    varied = [p for p in effect.parameters if p.name not in strengths]
    shapes: list[dict[str, float]] = [{p.name: p.nominal for p in varied}]
    for parameter in varied:
        for share in SENSITIVITY.shape_quantiles[1:]:
            value = float(quantile(priors[parameter.name], torch.tensor(share)))
            shapes.append({**shapes[0], parameter.name: value})
    return shapes[: SENSITIVITY.most_shapes]


def _needs_size(effect: Effect, strengths: tuple[str, ...]) -> bool:
    """Returns whether small sizes of an effect do not tell what a typical size changes.

    Example: a lag far below the sampling time changes no sample.
    """
    units = {p.name: p.unit for p in effect.parameters}
    return not effect.is_smooth or any(units[name] == "s" for name in strengths)


def _peaks(effect: Effect, inputs: Inputs) -> dict[str, float]:
    """Returns the greatest recorded values of what an effect on one command limits."""
    if not isinstance(effect, ActionEffect) or effect.port not in inputs.action_names:
        return {}
    commands = inputs.actions[..., inputs.action_names.index(effect.port)]
    return effect.peaks(commands, inputs.time_step)


def _limit_shapes(
    values: Mapping[str, float], limits: list[str], priors: Mapping[str, Distribution]
) -> list[tuple[dict[str, float], bool]]:
    """Returns values of limits at several quantiles of their priors."""
    return [
        ({**values, **{n: float(quantile(priors[n], torch.tensor(q))) for n in limits}}, False)
        for q in SENSITIVITY.limit_quantiles
    ]


def _resting(nominal: float, probe: float) -> float:
    """Returns zero strength as a finite number; for a limit, the largest command."""
    return nominal if math.isfinite(nominal) else probe / SENSITIVITY.first_limit


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
