"""Terms from which a law is composed: each is an expression in the variables of a port."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product

import torch
from torch import Tensor

from npdr_ppl.discovery.learning.recorded_motion import PortMotion
from npdr_ppl.discovery.learning.settings import LEARNING
from npdr_ppl.discovery.learning.term import Shape, Term, symbol_of
from npdr_ppl.discovery.learning.terms_with_memory import (
    remembering_commands,
    remembering_forces,
)

__all__ = ["terms_at", "with_harmonics"]


@dataclass(frozen=True)
class _Factor:
    """A function of one variable, from which terms are multiplied."""

    columns: tuple[str, ...]
    formulas: tuple[str, ...]
    uses: frozenset[str] = frozenset()
    unit: str = ""
    shapes: tuple[Shape, ...] = ()
    cost: float = 0.0


_ONE = _Factor(("1.0",), ("",))


def terms_at(motion: PortMotion) -> list[Term]:
    """Returns the terms that a law at a port may have."""
    kind = motion.port.kind
    if kind == "sensor":
        made = _sensor_terms(motion)
    else:
        made = _force_terms(motion) if kind == "force" else _static_terms(motion, "u")
    return list({term.key: term for term in made}.values())


def with_harmonics(term: Term) -> Term | None:
    """Returns the term with the harmonics of its wave; ``None`` if it has no wave.

    Args:
        term: A term with sine and cosine of a position.
    """
    is_wave = len(term.columns) == 2 and term.columns[0].count("torch.sin(") == 1
    if not is_wave or term.formulas[0].count("sin ") + term.formulas[0].count("sin(") != 1:
        return None
    columns, formulas = list(term.columns), list(term.formulas)
    for n in range(2, LEARNING.num_harmonics + 1):
        for column, formula in zip(term.columns, term.formulas, strict=True):
            for name in ("sin", "cos"):
                column = column.replace(f"torch.{name}(", f"torch.{name}({n} * ")
                formula = formula.replace(f"{name}(", f"{name}({n} ")
                formula = formula.replace(f"{name} ", f"{name} {n}·")
            columns.append(column)
            formulas.append(formula)
    return replace(
        term,
        key=f"harmonics of {term.key}",
        columns=tuple(columns),
        formulas=tuple(formulas),
        units=(term.units[0],) * len(columns),
        cost=term.cost + len(columns) - 2,
    )


def _force_terms(motion: PortMotion) -> Iterator[Term]:
    values, units = motion.values, motion.units
    places = [_ONE, *_powers("q", units, 3), *_turns(units, "q", range(1, 4))]
    waves = [*_turns(units, "q", range(4, LEARNING.most_per_turn + 1)), *_waves(motion)]
    speeds = [
        _single("v", "v", "v", units["v"]),
        _single("v", "v * torch.abs(v)", "v|v|", f"({units['v']})²"),
        _single("v", "v * v * v", "v³", f"({units['v']})³"),
        _single("v", "v / torch.sqrt(torch.abs(v) + 1e-9)", "√|v| sign v", f"({units['v']})^½", 1),
        _single("v", "v * v", "v²", f"({units['v']})²"),
    ]
    ages = [_ONE, _single("t", "t", "t", "s"), *_decays(values["t"])]
    stribeck = _stribeck(motion)
    for place in places:
        for speed in (_ONE, *speeds):
            yield _product(motion, place, speed)
        for speed in (_ONE, *stribeck):
            yield _product(motion, place, speed, is_dry=True)
    for wave in waves:
        yield _product(motion, wave)
        yield _product(motion, wave, speeds[0])
        yield _product(motion, wave, is_dry=True)
    for age in ages[1:]:
        for speed in (_ONE, *speeds[:2]):
            yield _product(motion, age, speed)
        yield _product(motion, age, is_dry=True)
    yield from _stops(motion)
    yield from remembering_forces(motion)
    for number in range(1, len(motion.others) + 1):
        yield from _of_another_joint(motion, f"q_{number}", f"v_{number}")
    for variable in ("q", "v", "t"):
        yield _spline(motion, variable)
        yield _spline(motion, variable, is_dry=True)
    if "tau" in values:
        tau = units["tau"]
        loads = [
            _single("tau", "tau", "τ", tau),
            _single("tau", "torch.abs(tau)", "|τ|", tau, 1),
            _single("tau", "tau * torch.abs(tau)", "τ|τ|", f"({tau})²", 1),
            _single("tau", "tau * tau * tau", "τ³", f"({tau})³", 1),
        ]
        for place, load in product(places, loads):
            yield _product(motion, place, load)
        for place in places:
            yield _product(motion, place, loads[1], is_dry=True)
        for wave in waves:
            yield _product(motion, wave, loads[0])
            yield _product(motion, wave, loads[1], is_dry=True)
        yield _product(motion, loads[0], speeds[0])
        yield _product(motion, loads[1], speeds[0])
        yield from (_product(motion, age, loads[0]) for age in ages[1:])
        yield _spline(motion, "tau")
        yield _spline(motion, "tau", is_dry=True)


def _sensor_terms(motion: PortMotion) -> Iterator[Term]:
    """Returns errors that depend on the value itself."""
    unit = motion.units["y"]
    yield _product(motion, _ONE)
    for power in _powers("y", motion.units, 3):
        yield _product(motion, power)
    yield _product(motion, _single("y", "torch.abs(y)", "|y|", unit, 1))
    yield _product(motion, _single("y", "y * torch.abs(y)", "y|y|", f"({unit})²", 1))
    for wave in (*_turns(motion.units, "y", range(1, 4)), *_waves(motion, "y")):
        yield _product(motion, wave)
    yield _spline(motion, "y")


def _static_terms(motion: PortMotion, name: str) -> Iterator[Term]:
    """Returns terms in a command and the time."""
    unit = motion.units[name]
    own = [
        _single(name, name, symbol_of(name), unit),
        _single(name, f"torch.abs({name})", f"|{name}|", unit, 1),
        _single(name, f"{name} * torch.abs({name})", f"{name}|{name}|", f"({unit})²", 1),
        _single(name, f"{name} * {name}", f"{name}²", f"({unit})²", 1),
        _single(name, f"{name} * {name} * {name}", f"{name}³", f"({unit})³", 1),
    ]
    ages = [_ONE, _single("t", "t", "t", "s"), *_decays(motion.values["t"])]
    for age in ages:
        for one in (_ONE, *own):
            yield _product(motion, age, one)
    largest = float(motion.values[name].abs().max())
    for share in torch.linspace(0.05, 0.95, 2 * LEARNING.num_shapes).tolist():
        edge = Shape("edge", share * largest, unit)
        yield _shaped(motion, "beyond", f"torch.relu({name} - {{0}})", f"({name} − {{0}})⁺", edge)
        yield _shaped(motion, "below", f"torch.relu(-{name} - {{0}})", f"(−{name} − {{0}})⁺", edge)
        yield _shaped(
            motion,
            "past",
            f"{name} - torch.clamp({name}, -{{0}}, {{0}})",
            f"({name} − clip({name}, ±{{0}}))",
            edge,
        )
        yield _shaped(
            motion,
            "within",
            f"torch.clamp({name} / {{0}}, -1.0, 1.0)",
            f"clip({name}/{{0}}, ±1)",
            edge,
        )
    yield _spline(motion, name)
    if name == "u":
        yield from remembering_commands(motion)


def _of_another_joint(motion: PortMotion, q: str, v: str) -> Iterator[Term]:
    """Returns forces that depend on another joint's position and velocity, and on both joints."""
    units, position, speed = motion.units, symbol_of(q), symbol_of(v)
    place, rate = _single(q, q, position, units[q]), _single(v, v, speed, units[v])
    squares = [
        _single(v, f"{v} * torch.abs({v})", f"{speed}|{speed}|", f"({units[v]})²", 1),
        _single(v, f"{v} * {v}", f"{speed}²", f"({units[v]})²", 1),
    ]
    turns = _turns(units, q, range(1, 3))
    own = [_single("q", "q", "q", units["q"]), _single("v", "v", "v", units["v"])]
    for one in (place, rate, *squares, *turns):
        yield _product(motion, one)
    for one, other in product((place, rate), own):
        yield _product(motion, one, other)
    for one, other in product(turns[:1], (own[1], rate, squares[1])):
        yield _product(motion, one, other)
    if units[q] == units["q"] == "rad":
        for sign, mark in (("+", "+"), ("-", "−")):
            columns = f"torch.sin(q {sign} {q})", f"torch.cos(q {sign} {q})"
            formulas = f"sin(q {mark} {position})", f"cos(q {mark} {position})"
            both = _Factor(columns, formulas, frozenset({"q", q}), "", cost=2.0)
            yield _product(motion, both)
            yield _product(motion, both, squares[1])


def _single(variable: str, column: str, formula: str, unit: str, cost: float = 0.0) -> _Factor:
    return _Factor((column,), (formula,), frozenset({variable}), unit, cost=cost)


def _powers(variable: str, units: Mapping[str, str], most: int) -> list[_Factor]:
    unit = units[variable]
    marks = {1: "", 2: "²", 3: "³"}
    return [
        _single(
            variable,
            " * ".join([variable] * n),
            f"{variable}{marks[n]}",
            f"{unit}{marks[n]}",
            n - 1,
        )
        for n in range(1, most + 1)
    ]


def _turns(units: Mapping[str, str], name: str, numbers: range) -> list[_Factor]:
    """Returns sine and cosine of an angle for whole numbers of periods per turn."""
    if units[name] != "rad":
        return []
    found = []
    for n in numbers:
        symbol = symbol_of(name)
        argument, text = (name, symbol) if n == 1 else (f"{n} * {name}", f"{n} {symbol}")
        columns = f"torch.sin({argument})", f"torch.cos({argument})"
        formulas = f"sin {text}", f"cos {text}"
        found.append(_Factor(columns, formulas, frozenset({name}), "", cost=1.0))
    return found


def _waves(motion: PortMotion, name: str = "q") -> list[_Factor]:
    """Returns sine and cosine of a position for wave numbers that its range can tell apart."""
    x, unit = motion.values[name], motion.units[name]
    span = float(x.max() - x.min())
    if span <= 0.0:
        return []
    longest = min(LEARNING.num_waves, round(LEARNING.largest_wave_number * span / torch.pi))
    found = []
    for j in range(1, 2 * max(longest, LEARNING.fewest_waves) + 1):
        number = Shape("wave_number", 0.5 * j * torch.pi / span, f"1/{unit}")
        columns = f"torch.sin(wave_number * {name})", f"torch.cos(wave_number * {name})"
        formulas = f"sin(k {name})", f"cos(k {name})"
        found.append(_Factor(columns, formulas, frozenset({name}), "", (number,), cost=2.0))
    return found


def _decays(t: Tensor) -> list[_Factor]:
    """Returns exp(−t/T) for time constants up to that of the longest rollout."""
    longest = float(t.max())
    return [
        _Factor(
            ("torch.exp(-t / time_constant)",),
            ("exp(−t/T)",),
            frozenset({"t"}),
            "",
            (Shape("time_constant", longest * share, "s"),),
            cost=2.0,
        )
        for share in (0.1, 0.3, 1.0)
    ]


def _stribeck(motion: PortMotion) -> list[_Factor]:
    """Returns exp(−|v|/vₛ) for several speeds, relative to the root mean square of the motion."""
    spread = float(motion.values["v"].square().mean().sqrt())
    return [
        _Factor(
            ("torch.exp(-torch.abs(v) / speed)",),
            ("exp(−|v|/vₛ)",),
            frozenset({"v"}),
            "",
            (Shape("speed", spread * share, motion.units["v"]),),
            cost=2.0,
        )
        for share in (0.02, 0.06, 0.2, 0.6)
        if spread > 0.0
    ]


def _stops(motion: PortMotion) -> Iterator[Term]:
    """Returns forces that act only beyond a position."""
    q, unit = motion.values["q"], motion.units["q"]
    # A quantile takes at most 16 million values; a part of them will do.
    sizes = q.abs().flatten()[:: max(1, q.numel() // 100_000)]
    shares = torch.linspace(0.3, 0.97, 2 * LEARNING.num_shapes, dtype=torch.float64)
    sizes = sizes.quantile(shares)
    for size in sizes.tolist():
        if size <= 0.0:
            continue
        edge = Shape("edge", size, unit)
        yield _shaped(motion, "stop", "q - torch.clamp(q, -{0}, {0})", "(q − clip(q, ±{0}))", edge)
        yield Term(
            f"damped stop {size:.6g}",
            ("q - torch.clamp(q, -edge, edge)", "v * (torch.abs(q) > edge)"),
            ("(q − clip(q, ±e))", "v (|q| > e)"),
            (unit, motion.units["v"]),
            frozenset({"q", "v"}),
            (edge,),
            cost=5.0,
        )
        yield _shaped(motion, "stop above", "torch.relu(q - {0})", "(q − {0})⁺", edge)
        yield _shaped(motion, "stop below", "torch.relu(-q - {0})", "(−q − {0})⁺", edge)


def _shaped(motion: PortMotion, key: str, column: str, formula: str, shape: Shape) -> Term:
    variable = "q" if motion.port.kind == "force" else "u"
    return Term(
        f"{key} {shape.value:.6g}",
        (column.format(shape.name),),
        (formula.format("e"),),
        (shape.unit,),
        frozenset({variable}),
        (shape,),
        cost=3.0,
    )


def _product(motion: PortMotion, *factors: _Factor, is_dry: bool = False) -> Term:
    """Returns the term that multiplies factors; of two with several columns, all products."""
    columns: list[str] = []
    formulas: list[str] = []
    for parts in product(*(zip(f.columns, f.formulas, strict=True) for f in factors)):
        code = [c for c, _ in parts if c != "1.0"]
        if len(code) > 1:
            code = [c if " " not in c else f"({c})" for c in code]
        text = [f for _, f in parts if f]
        columns.append(" * ".join(code) or "1.0")
        formulas.append(" · ".join([*text, "sign v"] if is_dry else text) or "1")
    unit = " ".join(f.unit for f in factors if f.unit) or "1"
    shapes = tuple(shape for f in factors for shape in f.shapes)
    uses = frozenset(u for f in factors for u in f.uses) | ({"v"} if is_dry else frozenset())
    values = "".join(f" {s.value:.6g}" for s in shapes)
    num = sum(1 for f in factors if f is not _ONE)
    cost = len(columns) + sum(f.cost for f in factors) + max(0, num - 1)
    return Term(
        " + ".join(formulas) + values,
        tuple(columns),
        tuple(formulas),
        (unit,) * len(columns),
        uses,
        shapes,
        is_dry,
        cost=cost,
    )


def _spline(motion: PortMotion, variable: str, *, is_dry: bool = False) -> Term:
    """Returns a linear spline in one variable over its visited range; constant beyond."""
    values = motion.values[variable]
    low, high = float(values.min()), float(values.max())
    knots = torch.linspace(low, high, LEARNING.num_knots, dtype=torch.float64).tolist()
    every = [knots[0], *knots, knots[-1]]
    columns = tuple(
        f"hat({variable}, {every[k]:.6g}, {every[k + 1]:.6g}, {every[k + 2]:.6g})"
        for k in range(len(knots))
    )
    symbol = symbol_of(variable)
    sign = " · sign v" if is_dry else ""
    return Term(
        f"spline({symbol}){sign}",
        columns,
        tuple(f"spline({symbol} = {knot:.4g}){sign}" for knot in knots),
        ("1",) * len(columns),
        frozenset({variable} | ({"v"} if is_dry else set())),
        is_dry=is_dry,
        is_spline=True,
        cost=2.0 * len(columns),
    )
