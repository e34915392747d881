"""The source of the effects that have learned laws.

Names and units of a robot's file become code only by :func:`~npdr_ppl.python_text.quoted` and
:func:`~npdr_ppl.python_text.plain`: the code is executed.
"""

import inspect
import re
from collections.abc import Mapping, Sequence
from typing import Any

from npdr_ppl.discovery.learning.expressions import FUNCTIONS
from npdr_ppl.discovery.learning.law import Law
from npdr_ppl.discovery.learning.memory import (
    DELAY,
    CommandMemory,
    Delay,
    MotionMemory,
)
from npdr_ppl.discovery.learning.term import symbol_of
from npdr_ppl.python_text import plain, quoted

__all__ = ["class_source", "module_source"]

SLOPE_STEP = 1e-5
"""Step of the central difference of a sensor's error, rad or m. It is far below the shortest waves
that are learned, and far above rounding in double precision."""

_BASES = {
    "force": "ForceEffect",
    "action": "ActionEffect",
    "servo": "ActionEffect",
    "sensor": "SensorEffect",
}


def module_source(laws: Sequence[Law], about: str) -> str:
    """Returns the source of a module with an effect for each law.

    Args:
        laws: The laws.
        about: Where they come from, in sentences.
    """
    head = [f"{law.class_name} at {law.port.name}: {law.formula_with_numbers}" for law in laws]
    lines = [*head, "", *about.strip().splitlines()]
    doc = "\n".join(["Laws that `npdr discover --learn` found.", "", *map(plain, lines)])
    has_shapes = any(c.is_shape for law in laws for c in law.constants)
    classes = [class_source(law) for law in laws]
    bases = {_BASES[law.port.kind] for law in laws}
    if any(term.memory == DELAY for law in laws for term in law.terms):
        bases.add("Commands")
    called = [f for name, f in FUNCTIONS.items() if any(f"{name}(" in text for text in classes)]
    lines = [
        f'"""{doc}',
        '"""',
        "",
        *(["import math", ""] if has_shapes else []),
        "import pyro.distributions as dist",
        "import torch",
        *(["from torch import Tensor"] if called else []),
        "",
        "from npdr_ppl.language.channels import Parameter",
        f"from npdr_ppl.language.effects import {', '.join(sorted(bases))}",
    ]
    for text in (*map(inspect.getsource, called), *classes):
        lines += ["", "", text.strip()]
    return "\n".join(lines) + "\n"


def class_source(law: Law) -> str:
    """Returns the source of the class of an effect with a law."""
    constants, uses = law.constants, law.uses
    kind = law.port.kind
    has_states = any(term.memory is not None for term in law.terms)
    known = ", ".join(f"{symbol_of(u)} in {law.units[u]}" for u in sorted(uses))
    lines = [
        f"class {law.class_name}({_BASES[kind]}):",
        f'    """{law.formula}',
        "",
        "    " + plain(f"A law at {law.port.name} in {law.port.unit}, of {known}."),
        *("    " + plain(f"{letter} is {about}.") for letter, about in law.letters.items()),
        *(["    A segment begins with what the past 5 s left."] if has_states else []),
        "    It was learned for "
        + ", ".join(
            f"{symbol_of(u)} from {law.ranges[u][0]:.4g} to {law.ranges[u][1]:.4g}"
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
    if kind == "force" and ("tau" in uses or law.of_other_joints):
        lines.append("    needs_joint = True")
    if any(isinstance(term.memory, MotionMemory) for term in law.terms):
        lines.append("    needs_past = True")
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
                column = _own(law, index, column)
                plain = column if " " not in column or column.startswith("hat(") else f"({column})"
                found.append(f'p["c{number}"]' + ("" if column == "1.0" else f" * {plain}"))
    return found


def _quoted(names: Sequence[str]) -> str:
    """Returns the content of a tuple of strings."""
    return ", ".join(f'"{name}"' for name in names) + ("," if len(names) == 1 else "")


def _own(law: Law, number: int, expression: str) -> str:
    """Returns an expression of one of the terms, with the names that the effect gives things."""
    term = law.terms[number - 1]
    for shape in term.shapes:
        own = f'p["{law.own_name(shape.name, number)}"]'
        expression = re.sub(rf"\b{shape.name}\b", own, expression)
    if term.memory is not None:
        own = law.own_name(term.memory.symbol, number)
        expression = re.sub(rf"\b{term.memory.symbol}\b", own, expression)
    return expression


def _sum(summands: Sequence[str], indent: str) -> str:
    if not summands:
        return "0.0"
    return f"\n{indent}+ ".join(summands)


def _remembered(law: Law, kind: type) -> list[tuple[int, str, Any]]:
    """Returns number, name and state of the terms with a state of some kind."""
    return [
        (number, law.own_name(term.memory.symbol, number), term.memory)
        for number, term in enumerate(law.terms, 1)
        if term.memory is not None and isinstance(term.memory, kind)
    ]


def _entries(indent: str, begin: str, entries: Mapping[str, str]) -> list[str]:
    """Returns the lines of a statement with a dictionary."""
    return [
        f"{indent}{begin} {{",
        *(f'{indent}    "{name}": {value},' for name, value in entries.items()),
        f"{indent}}}",
    ]


def _force_methods(law: Law) -> list[str]:
    uses, states = law.uses, _remembered(law, MotionMemory)
    given = {"tau": "joint.drive"} if "tau" in uses else {}
    for name, part, port in law.of_other_joints:
        given[name] = f"joint.others[{quoted(port)}][{part}]"
    lines: list[str] = []
    if "t" in uses or given or states:
        lines += _force_memory(law, list(given))
    if given:
        lines += [
            "",
            "    def begin_step(self, joint, parameters, memory, time_step):",
            '        """Keeps what the step\'s force needs of the joints."""',
            *_entries("        ", "known =", given),
            "        return {**memory, **known}",
        ]
    known = ["        q, v, p = position, velocity, parameters"]
    known += [f'        {name} = memory["{name}"]' for name in ("t", *given) if name in uses]
    within = ['        moved = q - memory["q"]'] if states else []
    for number, name, memory in states:
        within.append(f'        {name} = memory["{name}"]')
        within.append(f"        {name} = {_own(law, number, memory.now)}")
    for method, is_dry, doc, end in (
        ("force", False, "Returns the smooth part.", ""),
        (
            "dry_friction",
            True,
            "Returns the greatest dry friction, which acts against the motion.",
            "torch.relu",
        ),
    ):
        summands = _expressions(law, is_dry=is_dry)
        if summands:
            body = _sum(summands, "            ")
            lines += [
                "",
                f"    def {method}(self, position, velocity, parameters, memory):",
                f'        """{doc}"""',
                *known,
                *([] if is_dry else within),
                f"        return {end}(",
                f"            {body}",
                "        )",
            ]
    return lines


def _force_memory(law: Law, given: Sequence[str]) -> list[str]:
    """Returns the methods that begin and advance the memory of a force.

    Args:
        law: The law.
        given: Variables that each step's beginning gives.
    """
    uses, states = law.uses, _remembered(law, MotionMemory)
    needs_time = any("seconds" in memory.later for _, _, memory in states)
    indent = "        "
    first = {"t": "start.time + 0.5 * start.time_step"} if "t" in uses else {}
    later = {"t": 'memory["t"] + time_step'} if "t" in uses else {}
    for name in given:
        first[name], later[name] = "torch.zeros_like(position)", f'memory["{name}"]'
    lines = [
        "",
        "    def initial_memory(self, position, velocity, start):",
        '        """Returns the memory at a segment\'s start; t is in the middle of a step."""',
    ]
    if states:
        lines.append(f"{indent}p = start.parameters")
        lines += [f"{indent}seconds = start.interval"] * needs_time
        lines += [f"{indent}{name} = torch.zeros_like(position)" for _, name, _ in states]
        lines.append(f"{indent}for moved in start.displacements:")
        lines += [f"{indent}    {name} = {_own(law, n, m.later)}" for n, name, m in states]
        first |= {name: name for _, name, _ in states} | {"q": "position"}
    lines += _entries(indent, "return", first)
    lines += [
        "",
        "    def next_memory(self, position, velocity, parameters, memory, time_step):",
        '        """Returns the memory one step later."""',
    ]
    if states:
        lines.append(f"{indent}p = parameters")
        lines += [f"{indent}seconds = time_step"] * needs_time
        lines.append(f'{indent}moved = position - memory["q"]')
        for number, name, memory in states:
            lines.append(f'{indent}{name} = memory["{name}"]')
            later[name] = _own(law, number, memory.later)
        later["q"] = "position"
    return lines + _entries(indent, "return", later)


def _action_methods(law: Law) -> list[str]:
    states, delays = _remembered(law, CommandMemory), _remembered(law, Delay)
    indent, times = "        ", ["0.0"]
    first, later = {}, {}
    known, now = [], []
    if "t" in law.uses:
        first["t"] = "(start.time + 0.5 * start.time_step).expand(command.shape)"
        later["t"] = "t + time_step"
        known.append(f'{indent}t = memory["t"]')
    for number, name, memory in states:
        first[name], later[name] = memory.settled, _own(law, number, memory.later)
        known.append(f'{indent}{name} = memory["{name}"]')
        now.append(f"{indent}{name} = {_own(law, number, memory.now)}")
        shapes = {shape.name: shape.value for shape in law.terms[number - 1].shapes}
        times.append(f"{memory.fades_in(shapes):.3g}")
    own = {name: f'"{law.own_name("delay", number)}"' for number, name, _ in delays}
    now += [f"{indent}{name} = delayed(commands, p[{d}], seconds)" for name, d in own.items()]
    lines = ["", f"    memory_time = {max(times, key=float)}"]
    if delays:
        longest = ", ".join(f"parameters[{d}].detach().max()" for d in own.values())
        lines += [
            "",
            "    def history(self, parameters, time_step):",
            '        """Returns the number of past commands in the longest delay."""',
            f"{indent}longest = max([{longest}])",
            f"{indent}return math.floor(float(longest) / time_step) + 2",
        ]
    if first:
        lines += [
            "",
            "    def initial_memory(self, command, start):",
            '        """Returns the memory after a long time with one command."""',
            *_entries(indent, "return", first),
        ]
    return [
        *lines,
        "",
        "    def act(self, commands, parameters, memory, time_step):",
        '        """Returns the changed command, and the memory one step later."""',
        "        u, p = commands.now(), parameters",
        *(["        seconds = time_step"] if states or delays else []),
        *known,
        *(_entries(indent, "later =", later) if first else [f"{indent}later = None"]),
        *now,
        "        changed = (",
        f"            u + {_sum(_expressions(law, is_dry=False), indent + '    ')}",
        "        )",
        "        return changed, later",
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
        "    def initial_rate(self, rate, value, parameters):",
        '        """Removes the rate of the error, by a central difference."""',
        f"        step = {SLOPE_STEP:g}",
        "        above = self.error(value + step, parameters)",
        "        below = self.error(value - step, parameters)",
        "        return rate / (1.0 + (above - below) / (2.0 * step))",
        "",
        "    def read(self, value, parameters, memory, time_step):",
        '        """Returns the value with the error."""',
        "        return value + self.error(value, parameters), memory",
    ]
