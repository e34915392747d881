"""Effects of a user, and learned laws, as classes of numpy beside those of the catalogue.

The law of such an effect is a few lines of torch in the user's file. It is called once with
stand-ins that record what it does; see ``numpy_source.py``. The state that a law keeps from step
to step is recorded, too.
"""

import keyword
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch

from npdr_ppl.engines.mujoco.callbacks.numpy_source import Recorder
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effect_context import Joint, Start
from npdr_ppl.language.effects import (
    ActionEffect,
    BentSensorEffect,
    Commands,
    Effect,
    ForceEffect,
    SensorEffect,
    ServoEffect,
    Uneven,
)
from npdr_ppl.python_text import plain

__all__ = ["TracedLaw", "trace"]

_TAKEN = {
    "joint", "actuator", "channel", "memory", "needs_dynamics", "reset", "begin", "finish",
    "settle", "act", "read", "applied_force", "dry_friction", "known",
}  # fmt: skip
"""Names in the classes, which no parameter may have."""


_WIDTH = 99
"""Characters in a line of the file, if its statements can be broken."""


@dataclass(frozen=True)
class TracedLaw:
    """The class of a law.

    Attributes:
        name: Name of the effect's class.
        base: Name of the class that it extends.
        text: Its body: everything after the line with its name.
        has_dry_friction: Whether it has a bound of dry friction.
    """

    name: str
    base: str
    text: str
    has_dry_friction: bool = False


@lru_cache(maxsize=64)
def trace(effect: Effect) -> TracedLaw:
    """Returns the class of an effect's law.

    Args:
        effect: An effect that acts on a force, a command, a servo or a measurement.

    Raises:
        ModelError: The law cannot be written as numpy; the message says why, without a full stop.
    """
    for parameter in effect.parameters:
        name = parameter.name
        if name in _TAKEN or keyword.iskeyword(name) or not name.isidentifier():
            raise ModelError(f'its parameter "{name}" has a name that the file needs itself')
    writers = {
        ForceEffect: _force, ServoEffect: _servo, ActionEffect: _action, SensorEffect: _sensor
    }  # fmt: skip
    for kind, writer in writers.items():
        if isinstance(effect, kind):
            before = torch.get_rng_state()
            try:
                found = writer(effect)
                if not torch.equal(before, torch.get_rng_state()):
                    torch.set_rng_state(before)
                    raise ModelError(
                        "it draws random numbers, of which one would stay in the file"
                    )
                return found
            except ModelError:
                raise
            except Exception as error:
                # The law is code of the user's, which may do anything with the stand-ins.
                if "control flow" in str(error):
                    raise ModelError(
                        "its law branches on a number; torch.where instead of `if` can be exported"
                    ) from error
                first = str(error).partition("\n")[0]
                raise ModelError(f"its law cannot be followed: {first}".rstrip(".")) from error
    raise ModelError("npdr export has no Python for effects of this kind")


class _Now(Commands):
    """The present command."""

    def __init__(self, command: Any) -> None:
        self.command = command

    def now(self) -> Any:
        return self.command

    def delayed(self, steps: Any) -> Any:
        raise ModelError("it needs earlier commands")


class _Others(Mapping[str, Any]):
    """The other joints, which the class of a law does not get."""

    def __getitem__(self, name: str) -> Any:
        raise ModelError(f"it depends on another joint, {name}")

    def __iter__(self) -> Iterator[str]:
        raise ModelError("it depends on other joints")

    def __len__(self) -> int:
        raise ModelError("it depends on other joints")


class _Memory:
    """A law's own state as a row of numbers.

    Args:
        initial: The state as the effect returned it.
    """

    def __init__(self, initial: Any) -> None:
        self.initial = initial
        self.leaves = _leaves(initial)

    def stand_ins(self, recorder: Recorder) -> Any:
        """Returns the state with stand-ins in place of its numbers."""
        names = iter(f"self.memory[{k}]" for k in range(len(self.leaves)))
        return _rebuilt(self.initial, lambda: recorder.number(next(names)))

    def leaves_of(self, memory: Any) -> list[Any]:
        """Returns the numbers of a later state."""
        found = _leaves(memory)
        if len(found) != len(self.leaves):
            raise ModelError("its state has another number of values after a step")
        return found


def _leaves(memory: Any) -> list[Any]:
    if memory is None:
        return []
    if isinstance(memory, tuple | list):
        return [leaf for part in memory for leaf in _leaves(part)]
    if isinstance(memory, dict):
        return [leaf for name in sorted(memory) for leaf in _leaves(memory[name])]
    return [memory]


def _rebuilt(memory: Any, make: Callable[[], Any]) -> Any:
    if memory is None:
        return None
    if isinstance(memory, tuple | list):
        parts = [_rebuilt(part, make) for part in memory]
        is_named = hasattr(memory, "_fields")
        return type(memory)(*parts) if is_named else type(memory)(parts)
    if isinstance(memory, dict):
        return {name: _rebuilt(memory[name], make) for name in sorted(memory)}
    return make()


def _parameters(effect: Effect, recorder: Recorder) -> dict[str, Any]:
    return {p.name: recorder.number(f"self.{p.name}") for p in effect.parameters}


def _force(effect: ForceEffect) -> TracedLaw:
    recorder = Recorder()
    own = _parameters(effect, recorder)
    q, v, h = (recorder.number(name) for name in ("position", "velocity", "step"))
    start = Start(recorder.number("start"), h, own)
    memory = _Memory(effect.initial_memory(q, v, start))
    lines: list[str] = []
    if memory.leaves:
        lines += _MEMORY
        lines += ["", "    def reset(self, velocity: float) -> None:"]
        lines += ['        """Forgets the state; the first step sets it."""']
        lines += ["        self.memory = ()"]
        lines += ["", "    def known(self, joint: Joint) -> tuple[float, ...]:"]
        lines += ['        """Returns the state, which begins with the first step."""']
        lines += ["        if not self.memory:"]
        lines += textwrap.indent(
            "\n".join(_setting(recorder, memory.leaves, _OF_JOINT)), "    "
        ).split("\n")
        lines += ["        return self.memory"]
    if effect.needs_joint:
        seen = [recorder.number(f) for f in ("acceleration", "inverse_inertia", "drive")]
        joint = Joint(q, v, *seen, others=_Others())
        begun = effect.begin_step(joint, own, memory.stand_ins(recorder), h)
        lines += ["", "    def begin(self, joint: Joint) -> None:"]
        lines += ['        """Takes what the step\'s forces need of the joint."""']
        lines += ["        self.known(joint)"] if memory.leaves else []
        lines += _setting(recorder, memory.leaves_of(begun), _OF_JOINT) or ["        return"]
    parts = {
        "applied_force": ("Returns the force.", effect.force),
        "dry_friction": ("Returns the greatest dry friction.", effect.dry_friction),
    }
    written = set()
    for name, (doc, function) in parts.items():
        found = function(q, v, own, memory.stand_ins(recorder))
        if found is None:
            continue
        written.add(name)
        lines += ["", f"    def {name}(self, joint: Joint) -> float:", f'        """{doc}"""']
        lines += ["        self.known(joint)"] if memory.leaves else []
        lines += _returning(recorder, [found], _OF_JOINT)
    if memory.leaves:
        later = effect.next_memory(q, v, own, memory.stand_ins(recorder), h)
        lines += ["", "    def finish(self, joint: Joint) -> None:"]
        lines += ['        """Sets the state one step later."""', "        self.known(joint)"]
        lines += _setting(recorder, memory.leaves_of(later), _OF_JOINT)
    before = ["    needs_dynamics: ClassVar[bool] = True"] if effect.needs_joint else []
    return TracedLaw(
        type(effect).__name__,
        "JointLaw",
        _class_body(effect, [*before, *lines]),
        "dry_friction" in written,
    )


def _action(effect: ActionEffect) -> TracedLaw:
    recorder = Recorder()
    own = _parameters(effect, recorder)
    command, h = recorder.number("command"), recorder.number("step")
    memory = _Memory(effect.initial_memory(command, Start(recorder.number("start"), h, own)))
    changed, later = effect.act(_Now(command), own, memory.stand_ins(recorder), h)
    lines: list[str] = []
    if memory.leaves:
        lines += _MEMORY
        lines += ["", "    def settle(self, command: float, step: float) -> float:"]
        lines += ['        """Sets the state after a long time with the command."""']
        lines += _setting(recorder, memory.leaves, _OF_COMMAND)
        lines += ["        before = self.memory"]
        lines += ["        output, _ = self.act(command, step)"]
        lines += ["        self.memory = before", "        return output"]
    uneven = isinstance(changed, Uneven)
    outputs = [changed.mean, changed.moment] if uneven else [changed, 0.0]
    lines += ["", "    def act(self, command: float, step: float) -> tuple[float, float]:"]
    lines += ['        """Returns mean and moment of the command after the law."""']
    statements, texts = _statements(recorder, [*outputs, *memory.leaves_of(later)], _OF_COMMAND)
    lines += statements
    lines += _assigned("output", texts[:2])
    if memory.leaves:
        lines += _assigned("self.memory", texts[2:])
    lines += ["        return output"]
    return TracedLaw(type(effect).__name__, "CommandLaw", _class_body(effect, lines))


def _servo(effect: ServoEffect) -> TracedLaw:
    recorder = Recorder()
    own, error = _parameters(effect, recorder), recorder.number("error")
    memory = _Memory(effect.initial_memory(error))
    step: Any = recorder.number("step")
    before = memory.stand_ins(recorder)
    mean: Any = recorder.number("mean")
    middle = effect.next_memory(error, own, before, 0.5 * step)
    acted = [effect.act(each, own, middle) for each in (error, mean)]
    lines: list[str] = []
    if memory.leaves:
        lines += _MEMORY
        lines += ["", "    def reset(self) -> None:"]
        lines += ['        """Sets the state as a rollout begins, with no error."""']
        lines += _setting(recorder, memory.leaves, _AT_REST)
    lines += [
        "",
        "    def act(self, error: float, mean: float, step: float) -> tuple[float, float]:",
        '        """Returns the error on which the servo acts as a step begins, and its mean."""',
    ]
    later = effect.next_memory(mean, own, before, step)
    statements, texts = _statements(recorder, [*acted, *memory.leaves_of(later)], _OF_ERROR)
    lines += statements
    lines += _assigned("acted", texts[:2])
    if memory.leaves:
        lines += _assigned("self.memory", texts[2:])
    lines += ["        return acted"]
    return TracedLaw(type(effect).__name__, "ServoLaw", _class_body(effect, lines))


def _sensor(effect: SensorEffect) -> TracedLaw:
    if (
        effect.needs_past
        or isinstance(effect, BentSensorEffect)
        or type(effect).history is not SensorEffect.history
    ):
        raise ModelError(
            "its measurement depends on the motion within a step, or on earlier values"
        )
    recorder = Recorder()
    own = _parameters(effect, recorder)
    value, h = recorder.number("value"), recorder.number("step")
    start = Start(recorder.number("start"), h, own)
    memory = _Memory(effect.initial_memory(value, value, start))
    measured, later = effect.read(value, own, memory.stand_ins(recorder), h)
    lines: list[str] = []
    if memory.leaves:
        lines += _MEMORY
        lines += ["", "    def reset(self, value: float, step: float) -> float:"]
        lines += ['        """Sets the state at the start; returns the measurement."""']
        lines += _setting(recorder, memory.leaves, _OF_VALUE)
        lines += ["        before = self.memory"]
        lines += ["        measured = self.read(value, 0.0, 0.0, step)"]
        lines += ["        self.memory = before", "        return measured"]
    lines += [
        "",
        "    def read(self, value: float, bend: float, time: float, step: float) -> float:",
    ]
    lines += ['        """Returns the measurement."""']
    statements, texts = _statements(recorder, [measured, *memory.leaves_of(later)], _OF_VALUE)
    lines += [*statements, f"        measured = {texts[0]}"]
    if memory.leaves:
        lines += _assigned("self.memory", texts[1:])
    lines += ["        return float(measured)"]
    return TracedLaw(type(effect).__name__, "SensorLaw", _class_body(effect, lines))


_MEMORY = [
    "    memory: tuple[float, ...] = field(default=(), init=False, repr=False)",
]

_OF_JOINT = {
    "position": "np.float64(joint.position)",
    "velocity": "np.float64(joint.velocity)",
    "step": "np.float64(joint.step)",
    "start": "joint.time - 0.5 * joint.step",
    "acceleration": "np.float64(joint.acceleration)",
    "inverse_inertia": "np.float64(joint.inverse_inertia)",
    "drive": "np.float64(joint.drive)",
}
_OF_COMMAND = {"start": "0.0", "command": "np.float64(command)", "step": "np.float64(step)"}
_OF_VALUE = {"start": "0.0", "value": "np.float64(value)", "step": "np.float64(step)"}
_OF_ERROR = {
    "error": "np.float64(error)",
    "mean": "np.float64(mean)",
    "step": "np.float64(step)",
}
_AT_REST = {"error": "np.float64(0.0)"}
"""Where each input of a law comes from, in the file. Numbers of numpy may be divided by zero, as
those of torch."""


def _statements(
    recorder: Recorder, results: Sequence[Any], sources: Mapping[str, str]
) -> tuple[list[str], list[str]]:
    """Returns the statements that results need, and an expression for each result."""
    lines, texts, inputs = recorder.body(results)
    known = [f"{name} = {source}" for name, source in sources.items() if name in inputs]
    return [f"        {line}" for line in [*known, *lines]], texts


def _returning(
    recorder: Recorder, results: Sequence[Any], sources: Mapping[str, str]
) -> list[str]:
    statements, (text,) = _statements(recorder, results, sources)
    return [*statements, f"        return float({text})"]


def _setting(recorder: Recorder, leaves: Sequence[Any], sources: Mapping[str, str]) -> list[str]:
    """Returns statements that set the state; none for a law without a state."""
    if not leaves:
        return []
    statements, texts = _statements(recorder, leaves, sources)
    return [*statements, *_assigned("self.memory", texts)]


def _assigned(name: str, texts: Sequence[str]) -> list[str]:
    """Returns the assignment of a row of numbers."""
    row = ", ".join(f"float({text})" for text in texts)
    return [f"        {name} = ({row},)"]


def _class_body(effect: Effect, lines: Sequence[str]) -> str:
    """Returns the documentation, the parameters and the rest of a class."""
    doc = effect.law or (type(effect).__doc__ or "A law of the user's.").strip().split("\n")[0]
    head = [f'    """{plain(doc)}"""', ""]
    head += [f"    {parameter.name}: float" for parameter in effect.parameters]
    return "\n".join([*head, *(_wrapped(line) for line in lines)])


def _wrapped(line: str) -> str:
    """Returns a statement on several lines if it is long, broken at spaces in brackets."""
    if len(line) <= _WIDTH:
        return line
    name, equals, value = line.partition(" = ")
    if equals and not value.startswith("("):
        line = f"{name} = ({value})"
    indent = " " * (len(line) - len(line.lstrip()) + 4)
    lines, depth = [line[: len(indent) - 4]], 0
    for word in re.split(r"(?<=\S) ", line.strip()):
        if depth > 0 and len(lines[-1]) + len(word) >= _WIDTH:
            lines.append(indent)
        is_first = not lines[-1].strip()
        lines[-1] += word if is_first else f" {word}"
        depth += word.count("(") - word.count(")")
    return "\n".join(lines)
