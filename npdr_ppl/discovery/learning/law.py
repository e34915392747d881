"""A learned law, and the source of the effect that has it.

Names and units of a robot's file become code only by :func:`~npdr_ppl.python_text.quoted` and
:func:`~npdr_ppl.python_text.plain`: the code is executed.
"""

import inspect
import re
import zlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count

from npdr_ppl.discovery.learning.terms import SYMBOLS, Term, hat
from npdr_ppl.language.channels import Port
from npdr_ppl.python_text import plain, quoted

__all__ = ["Constant", "Law", "class_source", "module_source"]

_BASES = {
    "force": "ForceEffect",
    "action": "ActionEffect",
    "servo": "ActionEffect",
    "sensor": "SensorEffect",
}


@dataclass(frozen=True)
class Constant:
    """A parameter of a learned effect.

    Attributes:
        name: Its name.
        unit: Its unit.
        value: Its fitted value, in ``unit``.
        spread: Standard deviation of its normal prior; of a positive shape constant, that of the
            log.
        text: What it is.
        is_shape: Whether it is a shape constant, with a log-normal prior about ``value``.
    """

    name: str
    unit: str
    value: float
    spread: float
    text: str
    is_shape: bool = False


@dataclass(frozen=True)
class Law:
    """A sum of terms at a port.

    Attributes:
        port: The port.
        terms: The terms.
        coefficients: Coefficient of each column of each term.
        spreads: Standard deviation of the prior of each coefficient.
        ranges: Least and greatest value of each variable that was visited.
        units: Units of the variables.
        number: Tells it from other learned effects at ports of this name.
    """

    port: Port
    terms: tuple[Term, ...]
    coefficients: tuple[float, ...]
    spreads: tuple[float, ...]
    ranges: Mapping[str, tuple[float, float]]
    units: Mapping[str, str]
    number: int = 1

    @property
    def class_name(self) -> str:
        """Name of its class; another one at every port."""
        name = _identifier(self.port.name)
        words = re.sub(r"(?:^|_)([A-Za-z])", lambda m: m[1].upper(), name)
        return f"Learned{words}{self._end}"

    @property
    def id(self) -> str:
        """Its id as an effect."""
        return f"learned_{_identifier(self.port.name)}{self._end}"

    @property
    def _end(self) -> str:
        # No port's name has two of these signs after another.
        return "" if self.number == 1 else f"__{self.number}"

    def apart_from(self, ids: Collection[str]) -> "Law":
        """Returns the law with an id that is none of others.

        Args:
            ids: Ids of other effects.
        """
        numbered = (replace(self, number=number) for number in count(1))
        return next(law for law in numbered if law.id not in ids)

    @property
    def uses(self) -> frozenset[str]:
        """Symbols of the variables that it depends on."""
        return frozenset(symbol for term in self.terms for symbol in term.uses)

    @property
    def constants(self) -> list[Constant]:
        """Its parameters: the coefficients, then the shape constants."""
        found: list[Constant] = []
        flat = iter(zip(self.coefficients, self.spreads, strict=True))
        for term in self.terms:
            for formula, unit in zip(term.formulas, term.units, strict=True):
                value, spread = next(flat)
                name = f"c{len(found) + 1}"
                sign = "minus the coefficient" if term.is_dry else "coefficient"
                found.append(
                    Constant(
                        name, _per(self.port.unit, unit), value, spread, f"{sign} of {formula}"
                    )
                )
        for number, term in enumerate(self.terms, 1):
            for shape in term.shapes:
                name = shape.name if len(self.terms) == 1 else f"{shape.name}_{number}"
                text = f"in {term.formulas[0]}"
                found.append(Constant(name, shape.unit, shape.value, 0.1, text, True))
        return found

    @property
    def formula(self) -> str:
        """The law in one line, with letters for the coefficients."""
        parts, number = [], 0
        for term in self.terms:
            if term.is_spline:
                number += len(term.columns)
                parts.append(term.key)
                continue
            for formula in term.formulas:
                number += 1
                sign = "−" if term.is_dry else "+"
                parts.append(
                    f"{sign} c{_subscript(number)}" + ("" if formula == "1" else f" {formula}")
                )
        return " ".join(parts).removeprefix("+ ")

    @property
    def formula_with_numbers(self) -> str:
        """The law in one line, with the fitted coefficients."""
        parts, flat = [], iter(self.coefficients)
        for term in self.terms:
            if term.is_spline:
                for _ in term.columns:
                    next(flat)
                parts.append(f"+ {term.key}")
                continue
            values = {s.name: f"{s.value:.4g}" for s in term.shapes}
            for formula in term.formulas:
                value = next(flat) * (-1.0 if term.is_dry else 1.0)
                text = "" if formula == "1" else f" {_with_numbers(formula, values)}"
                parts.append(f"{'−' if value < 0 else '+'} {abs(value):.4g}{text}")
        return " ".join(parts).removeprefix("+ ")


def _identifier(name: str) -> str:
    """Returns a name of ASCII letters and digits, separated by ``_``.

    A name that has other characters ends with a checksum, so that ``"knee-1"`` and ``"knee_1"``
    stay apart.
    """
    if re.fullmatch("[a-z0-9]+(_[a-z0-9]+)*", name):
        return name
    words = re.findall("[A-Za-z0-9]+", name)
    return "_".join([*words, f"{zlib.crc32(name.encode()):08x}"])


_LETTERS = {"wave_number": "k", "speed": "vₛ", "edge": "e", "time_constant": "T"}


def _with_numbers(formula: str, values: Mapping[str, str]) -> str:
    for name, value in values.items():
        formula = re.sub(rf"(?<!\w){_LETTERS[name]}(?!\w)", value, formula)
    return formula


def _subscript(number: int) -> str:
    return str(number).translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))


def _per(unit: str, other: str) -> str:
    """Returns the unit of a coefficient: a unit per another one."""
    if other in ("1", ""):
        return unit
    is_one = all(c.isalnum() for c in other) or (other[0] == "(" and other.count("(") == 1)
    if unit == other:
        return "1"
    return f"{unit}/{other}" if is_one else f"{unit}/({other})"


def module_source(laws: Sequence[Law], about: str) -> str:
    """Returns the source of a module with an effect for each law.

    Args:
        laws: The laws.
        about: Where they come from, in sentences.
    """
    bases = sorted({_BASES[law.port.kind] for law in laws})
    has_hats = any(term.is_spline for law in laws for term in law.terms)
    head = [f"{law.class_name} at {law.port.name}: {law.formula_with_numbers}" for law in laws]
    lines = [*head, "", *about.strip().splitlines()]
    doc = "\n".join(["Laws that `npdr discover --learn` found.", "", *map(plain, lines)])
    has_shapes = any(c.is_shape for law in laws for c in law.constants)
    lines = [
        f'"""{doc}',
        '"""',
        "",
        *(["import math", ""] if has_shapes else []),
        "import pyro.distributions as dist",
        "import torch",
        *(["from torch import Tensor"] if has_hats else []),
        "",
        "from npdr_ppl.language.channels import Parameter",
        f"from npdr_ppl.language.effects import {', '.join(bases)}",
    ]
    if has_hats:
        lines += ["", "", inspect.getsource(hat).strip()]
    for law in laws:
        lines += ["", "", class_source(law)]
    return "\n".join(lines) + "\n"


def class_source(law: Law) -> str:
    """Returns the source of the class of an effect with a law."""
    constants, uses = law.constants, law.uses
    kind = law.port.kind
    known = ", ".join(f"{SYMBOLS[u]} in {law.units[u]}" for u in sorted(uses))
    lines = [
        f"class {law.class_name}({_BASES[kind]}):",
        f'    """{law.formula}',
        "",
        "    " + plain(f"A law at {law.port.name} in {law.port.unit}, of {known}."),
        "    It was learned for "
        + ", ".join(
            f"{SYMBOLS[u]} from {law.ranges[u][0]:.4g} to {law.ranges[u][1]:.4g}"
            for u in sorted(uses)
        )
        + ".",
        '    """',
        "",
        f'    id = "{law.id}"',
        "    parameters = (",
        *(
            f'        Parameter("{c.name}", {quoted(c.unit)}, '
            f"{c.value if c.is_shape else 0.0:.6g}, "
            f'"{c.text}"),'
            for c in constants
        ),
        "    )",
        f"    strength = ({_quoted([c.name for c in constants if not c.is_shape])})",
        f'    law = "{law.formula}"',
    ]
    if kind == "force" and "tau" in uses:
        lines.append("    needs_joint = True")
    lines += [
        "",
        "    def default_priors(self, port):",
        '        """Normal about zero; shape constants within about 10 %."""',
        "        return {",
        *(
            f'            "{c.name}": dist.LogNormal(math.log({c.value:.6g}), {c.spread:.3g}),'
            if c.is_shape
            else f'            "{c.name}": dist.Normal(0.0, {c.spread:.4g}),'
            for c in constants
        ),
        "        }",
    ]
    methods = {"force": _force_methods, "sensor": _sensor_methods}
    lines += methods.get(kind, _action_methods)(law)
    return "\n".join(lines)


def _expressions(law: Law, *, is_dry: bool) -> list[str]:
    """Returns the summands, each a coefficient times an expression."""
    found, number = [], 0
    for index, term in enumerate(law.terms, 1):
        for column in term.columns:
            number += 1
            if term.is_dry == is_dry:
                for shape in term.shapes:
                    name = shape.name if len(law.terms) == 1 else f"{shape.name}_{index}"
                    column = _renamed(column, shape.name, f'p["{name}"]')
                plain = column if " " not in column or column.startswith("hat(") else f"({column})"
                found.append(f'p["c{number}"]' + ("" if column == "1.0" else f" * {plain}"))
    return found


def _quoted(names: Sequence[str]) -> str:
    """Returns the content of a tuple of strings."""
    return ", ".join(f'"{name}"' for name in names) + ("," if len(names) == 1 else "")


def _renamed(expression: str, name: str, new: str) -> str:
    return re.sub(rf"\b{name}\b", new, expression)


def _sum(summands: Sequence[str], indent: str) -> str:
    if not summands:
        return "0.0"
    return f"\n{indent}+ ".join(summands)


def _force_methods(law: Law) -> list[str]:
    uses = law.uses
    has_time, has_load = "t" in uses, "tau" in uses
    smooth, dry = _expressions(law, is_dry=False), _expressions(law, is_dry=True)
    lines: list[str] = []
    if has_time or has_load:
        lines += [
            "",
            "    def initial_memory(self, position, velocity, start):",
            '        """Returns the time in the middle of the step, and the drive\'s force."""',
            "        return start.time + 0.5 * start.time_step, torch.zeros_like(position)",
        ]
    if has_load:
        lines += [
            "",
            "    def begin_step(self, joint, parameters, memory, time_step):",
            '        """Keeps the drive\'s force."""',
            "        return memory[0], joint.drive",
        ]
    known = ["        q, v, p = position, velocity, parameters"]
    if has_time or has_load:
        known.append("        t, tau = memory")
    for name, summands, doc, end in (
        ("force", smooth, "Returns the smooth part.", ""),
        (
            "dry_friction",
            dry,
            "Returns the greatest dry friction, which acts against the motion.",
            "torch.relu",
        ),
    ):
        if summands:
            body = _sum(summands, "            ")
            lines += [
                "",
                f"    def {name}(self, position, velocity, parameters, memory):",
                f'        """{doc}"""',
                *known,
                f"        return {end}(",
                f"            {body}",
                "        )",
            ]
    if has_time or has_load:
        lines += [
            "",
            "    def next_memory(self, position, velocity, parameters, memory, time_step):",
            '        """Returns the time one step later."""',
            "        return memory[0] + time_step, memory[1]",
        ]
    return lines


def _action_methods(law: Law) -> list[str]:
    body = _sum(_expressions(law, is_dry=False), "            ")
    return [
        "",
        "    memory_time = 0.0",
        "",
        "    def initial_memory(self, command, start):",
        '        """Returns the time in the middle of the step."""',
        "        return (start.time + 0.5 * start.time_step).expand(command.shape)",
        "",
        "    def act(self, commands, parameters, memory, time_step):",
        '        """Returns the changed command, and the time one step later."""',
        "        u, t, p = commands.now(), memory, parameters",
        "        changed = (",
        f"            u + {body}",
        "        )",
        "        return changed, memory + time_step",
    ]


def _sensor_methods(law: Law) -> list[str]:
    body = _sum(_expressions(law, is_dry=False), "            ")
    return [
        "",
        "    def error(self, y, p):",
        '        """Returns the error of the measurement at a true value."""',
        "        return (",
        f"            {body}",
        "        )",
        "",
        "    def initial_value(self, reading, parameters):",
        '        """Removes the error, in two steps."""',
        "        nearly = reading - self.error(reading, parameters)",
        "        return reading - self.error(nearly, parameters)",
        "",
        "    def read(self, value, parameters, memory, time_step):",
        '        """Returns the value with the error."""',
        "        return value + self.error(value, parameters), memory",
    ]
