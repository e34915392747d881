"""Expressions of numpy for what a function of torch computes, one number at a time.

A function is called once with stand-ins for its numbers (``torch.fx``), which record every
operation. Each operation is then written as numpy.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch.fx import Graph, Node, Proxy
from torch.fx.proxy import GraphAppendingTracer

from npdr_ppl.errors import ModelError

__all__ = ["Recorder", "number_of"]

_BINARY = {
    "add": ("+", 2), "sub": ("-", 2), "mul": ("*", 3), "truediv": ("/", 3), "div": ("/", 3),
    "gt": (">", 1), "lt": ("<", 1), "ge": (">=", 1), "le": ("<=", 1), "eq": ("==", 1),
    "ne": ("!=", 1),
}  # fmt: skip
"""Python's sign of an operation and how tightly it binds."""

_ATOM, _POWER, _UNARY, _COMPARISON = 6, 5, 4, 1
"""How tightly names and calls, powers, signs in front, and comparisons bind."""

_SAME_NAME = {
    "sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "expm1", "log", "log1p", "sqrt", "abs",
    "sign", "floor", "ceil", "square", "minimum", "maximum", "hypot", "copysign", "remainder",
    "fmod", "where", "round", "logical_and", "logical_or", "logical_not", "isnan", "isfinite",
}  # fmt: skip

_OTHER_NAME = {
    "absolute": "abs", "asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2",
    "arcsin": "arcsin", "arccos": "arccos", "arctan": "arctan", "arctan2": "arctan2",
    "and_": "logical_and", "or_": "logical_or", "invert": "logical_not",
    "bitwise_and": "logical_and", "bitwise_or": "logical_or", "bitwise_not": "logical_not",
    "mod": "remainder",
}  # fmt: skip

_KEEPS_VALUE = {
    "expand", "expand_as", "clone", "double", "to", "contiguous", "type_as", "detach", "getattr",
    "float", "broadcast_to",
}  # fmt: skip
"""Operations that change the shape or kind of a tensor, which one number does not have."""

_LIMITS = {
    "clamp": ("min", "max"), "clip": ("min", "max"), "clamp_min": ("min",), "clamp_max": ("max",),
}  # fmt: skip
"""Arguments behind the number that is limited."""

_IS_SHORT = re.compile(r"-?[\w.\[\]]+")
"""What is repeated instead of becoming a variable: names and numbers."""

_Text = tuple[str, int]


class Recorder:
    """Records what a function does with numbers, and writes it as numpy."""

    def __init__(self) -> None:
        self.graph = Graph()
        self._tracer = GraphAppendingTracer(self.graph)

    def number(self, name: str) -> Any:
        """Returns a stand-in for a number.

        Args:
            name: What it is called in expressions, e.g. ``"self.damping"``.
        """
        node = self.graph.placeholder(f"input_{len(self.graph.nodes)}")
        node.meta["name"] = name
        return Proxy(node, self._tracer)

    def body(self, results: Sequence[Any]) -> tuple[list[str], list[str], set[str]]:
        """Returns statements, an expression for each result, and the names of the inputs used.

        Args:
            results: What functions returned for stand-ins.

        Raises:
            ModelError: An operation has no counterpart here.
        """
        return _Writer(results).written()


def number_of(value: Any) -> float:
    """Returns a constant of a law.

    Raises:
        ModelError: It is not one number.
    """
    if isinstance(value, torch.Tensor) and value.numel() != 1:
        raise ModelError(f"it has a tensor of shape {tuple(value.shape)} as a constant")
    if not isinstance(value, torch.Tensor | float | int):
        raise ModelError(f"it returns a {type(value).__name__} where a number is expected")
    return float(value)


class _Writer:
    """Writes recorded results; what is used more than once becomes a variable."""

    def __init__(self, results: Sequence[Any]) -> None:
        self.results = results
        self.lines: list[str] = []
        self.names: dict[Node, str] = {}
        self.inputs: set[str] = set()
        self.uses: dict[Node, int] = {}
        for result in results:
            if isinstance(result, Proxy):
                self._count(result.node)

    def written(self) -> tuple[list[str], list[str], set[str]]:
        texts = [
            self._text(r.node)[0] if isinstance(r, Proxy) else _literal(number_of(r))[0]
            for r in self.results
        ]
        return self.lines, texts, self.inputs

    def _count(self, node: Node) -> None:
        self.uses[node] = self.uses.get(node, 0) + 1
        if self.uses[node] == 1:
            for other in _read(node):
                self._count(other)

    def _text(self, node: Node) -> _Text:
        if node.op == "placeholder":
            self.inputs.add(node.meta["name"])
            return node.meta["name"], _ATOM
        if node in self.names:
            return self.names[node], _ATOM
        text = _operation(node, self._argument)
        if self.uses[node] > 1 and not _IS_SHORT.fullmatch(text[0]):
            self.names[node] = f"part_{len(self.names) + 1}"
            self.lines.append(f"{self.names[node]} = {text[0]}")
            return self.names[node], _ATOM
        return text

    def _argument(self, value: Any) -> _Text:
        if isinstance(value, Node):
            return self._text(value)
        if isinstance(value, bool):
            return repr(value), _ATOM
        return _literal(number_of(value))


def _literal(number: float) -> _Text:
    """Returns a number as Python."""
    if math.isnan(number):
        return "np.nan", _ATOM
    text = repr(number).replace("inf", "np.inf")
    return text, _UNARY if text.startswith("-") else _ATOM


def _name(node: Node) -> str:
    """Returns the name of the operation without what tells torch's spellings of it apart."""
    target = node.target if isinstance(node.target, str) else node.target.__name__
    return target.strip("_") if target.startswith("__") else target


def _read(node: Node) -> list[Node]:
    """Returns the recorded values that an operation reads: not those of which it needs a shape."""
    name = _name(node)
    if node.op == "placeholder" or name in ("zeros_like", "ones_like"):
        return []
    if name in _KEEPS_VALUE:
        return node.all_input_nodes[:1]
    if name == "full_like":
        return [value for value in node.args[1:] if isinstance(value, Node)]
    return node.all_input_nodes


def _operation(node: Node, text: Callable[[Any], _Text]) -> _Text:
    name, args, options = _name(node), node.args, node.kwargs
    if name in ("add", "sub") and set(options) == {"alpha"}:
        scale, other = text(options["alpha"]), text(args[1])
        second = f"{_inside(scale, 3)} * {_inside(other, 4)}"
        return f"{_inside(text(args[0]), 2)} {_BINARY[name][0]} {second}", 2
    if name in _BINARY and not options:
        sign, level = _BINARY[name]
        # a - (b - c): what stands on the right binds more tightly. Python reads a < b < c as two
        # comparisons of b, so a comparison within another one always has brackets.
        is_comparison = level == _COMPARISON
        left = _inside(text(args[0]), level + 1 if is_comparison else level)
        return f"{left} {sign} {_inside(text(args[1]), level + 1)}", level
    if name == "pow":
        base, power = _inside(text(args[0]), _ATOM), _inside(text(args[1]), _POWER)
        return f"{base}**{power}", _POWER
    if name in ("neg", "negative"):
        return f"-{_inside(text(args[0]), _UNARY)}", _UNARY
    if name in _KEEPS_VALUE:
        kinds = [kind for kind in (*args, *options.values()) if isinstance(kind, torch.dtype)]
        if any(not kind.is_floating_point for kind in kinds):
            raise ModelError("it makes whole numbers of numbers; torch.floor can be exported")
        return text(args[0])
    if name in ("zeros_like", "ones_like"):
        return ("0.0" if name == "zeros_like" else "1.0"), _ATOM
    if name == "full_like":
        return text(args[1])
    if name == "relu":
        return f"np.maximum({text(args[0])[0]}, 0.0)", _ATOM
    if name == "sigmoid":
        return f"1.0 / (1.0 + np.exp(-{_inside(text(args[0]), _UNARY)}))", 3
    if name == "addcmul":
        value = options.get("value", 1.0)
        first, *factors = (
            _inside(text(a), level) for a, level in zip(args, (2, 3, 4), strict=True)
        )
        scale = "" if value == 1.0 else f"{text(value)[0]} * "
        return f"{first} + {scale}{' * '.join(factors)}", 2
    if name == "lerp" and not options:
        first, weight = _inside(text(args[0]), 2), _inside(text(args[2]), 3)
        change = f"{_inside(text(args[1]), 2)} - {_inside(text(args[0]), 3)}"
        return f"{first} + {weight} * ({change})", 2
    if name in _LIMITS:
        return _limited(name, args, options, text), _ATOM
    numpy_name = name if name in _SAME_NAME else _OTHER_NAME.get(name)
    if numpy_name is None or options:
        raise ModelError(f"it uses {name}, which npdr export cannot write as numpy")
    return f"np.{numpy_name}({', '.join(text(a)[0] for a in args)})", _ATOM


def _limited(
    name: str, args: Sequence[Any], options: Mapping[str, Any], text: Callable[[Any], _Text]
) -> str:
    """Returns a value within limits."""
    limits = dict(zip(_LIMITS[name], args[1:], strict=False)) | dict(options)
    result = text(args[0])[0]
    for limit, function in (("min", "maximum"), ("max", "minimum")):
        if limits.get(limit) is not None:
            result = f"np.{function}({result}, {text(limits[limit])[0]})"
    return result


def _inside(text: _Text, level: int) -> str:
    """Returns an expression, in brackets if it binds less tightly than its surroundings."""
    return text[0] if text[1] >= level else f"({text[0]})"
