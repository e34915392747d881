"""Reads pickles of arrays and plain records without running any code from them.

A pickle is a program for a stack machine that may call any function. The machine below knows only
the instructions that build numbers, text, containers, arrays and records, and it calls no
function of the pickle. A class is only a name, and an instance becomes a :class:`Record`. The few
functions that pickled arrays need are recognised by name and implemented here. Everything else is
refused.

Instructions may refer to an object again. Entries that are visited again count as instructions,
and bytes that are copied again as memory; both are limited, so that a small pickle costs little.
"""

import io
import math
import pickletools
import struct
import warnings
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS, check_expansion
from npdr_ppl.rollouts.rollout_checks import shown

__all__ = ["Record", "read_pickle"]

_JOBLIB_ARRAY = "joblib.numpy_pickle NumpyArrayWrapper"
_NDARRAY = "numpy ndarray"
_DTYPE = "numpy dtype"
_FUNCTIONS = frozenset(
    {
        _DTYPE,
        "__builtin__ bytes",
        "_codecs encode",
        "builtins bytes",
        "collections OrderedDict",
        "numpy.core.multiarray _reconstruct",
        "numpy.core.multiarray scalar",
        "numpy._core.multiarray _reconstruct",
        "numpy._core.multiarray scalar",
    }
)
_DTYPES = frozenset(("b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"))
_LABEL_DTYPES = frozenset(("O", "O8"))  # accepted for arrays of text only
_MAX_DIMENSIONS = 8
_MAX_LABEL_LENGTH = 200

_CONTAINER_WORK = 4
"""Work of making a list, dictionary or record, in instructions. The garbage collector visits each
of them several times."""


@dataclass
class Record:
    """An instance of some class, reduced to the class name and the fields, without methods.

    Attributes:
        kind: Module and name of the class, separated by a space.
        arguments: Arguments of the constructor, e.g. a named tuple's entries.
        fields: The instance's attributes.
    """

    kind: str
    arguments: tuple[Any, ...] = ()
    fields: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Global:
    """A module and a name, separated by a space, as in a pickle; it is never imported."""

    name: str


@dataclass
class _PickledArray:
    """An array whose shape, type and bytes follow in a BUILD instruction.

    Attributes:
        is_joblib: Whether the bytes follow after the instruction instead, as joblib writes them.
        values: The array after it has been built.
    """

    is_joblib: bool = False
    values: NDArray[Any] | None = None


@dataclass
class _PickledDtype:
    code: str
    byte_order: str = "="


_MARK = object()
"""A marker on the stack; the entries above it belong together."""


def read_pickle(data: bytes, records: Collection[str]) -> Any:
    """Returns the object that a pickle describes, built without calling code from the pickle.

    Arrays may be pickled by NumPy or written by joblib, with or without its alignment padding.

    Args:
        data: The pickle.
        records: Classes that may occur, as ``"module name"``; they become :class:`Record`.

    Raises:
        DataError: The pickle is damaged or contains anything but data.
    """
    try:
        with warnings.catch_warnings():
            # The standard library warns so about a damaged escape sequence in an old string.
            warnings.simplefilter("error", DeprecationWarning)
            return _Machine(io.BytesIO(data), len(data), frozenset(records)).run()
    except DataError:
        raise
    # A malformed pickle can cause any of these errors; all of them mean "damaged".
    except (
        AttributeError,
        DeprecationWarning,
        EOFError,
        IndexError,
        KeyError,
        OverflowError,
        RecursionError,
        struct.error,
        TypeError,
        UnicodeError,
        ValueError,
    ) as error:
        raise DataError(f"the pickle is damaged or incomplete ({type(error).__name__}).") from None


class _Costs:
    """Work and memory that a pickle has taken so far.

    Args:
        size: Bytes of the file.

    Attributes:
        work: Instructions, containers that they made, and entries that they visited again.
        copied: Bytes of text that were copied.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.work = 0
        self.copied = 0

    def spend(self, work: int) -> None:
        """Adds work; raises a DataError if it is more than any rollout needs."""
        self.work += work
        if self.work > LIMITS.instructions:
            raise DataError("the pickle takes more instructions and copies than a rollout.")

    def copy(self, num_bytes: int) -> None:
        """Adds memory; raises a DataError if it is much more than the file has."""
        self.copied += num_bytes
        check_expansion(self.copied, self.size)


class _Machine:
    """One run of the stack machine.

    Attributes:
        file: The pickle, read up to the current instruction.
        size: Bytes of the whole file.
        records: Classes that may occur.
        is_nested: Whether this pickle lies inside another one.
        stack: Operands.
        memo: Objects that later instructions refer to by number.
        costs: Work and memory of the whole pickle so far.
    """

    def __init__(
        self,
        file: io.BytesIO,
        size: int,
        records: frozenset[str],
        costs: "_Costs | None" = None,
        *,
        is_nested: bool = False,
    ) -> None:
        self.file = file
        self.size = size
        self.records = records
        self.is_nested = is_nested
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}
        self.costs = costs or _Costs(size)

    def run(self) -> Any:
        # The operand is read before the step, so that the file position is right after the
        # instruction. joblib writes the raw bytes of an array there.
        while code := self.file.read(1):
            self.costs.spend(1)
            read_operand, step = _INSTRUCTIONS[code]
            operand = read_operand(self.file) if read_operand else None
            if step is None:
                return _plain(self.stack.pop())
            step(self, operand)
        raise EOFError

    def named(self, name: str) -> _Global:
        """Returns a placeholder for a module's member, if data may contain this member."""
        if name in _FUNCTIONS or name in self.records or name in (_JOBLIB_ARRAY, _NDARRAY):
            return _Global(name)
        raise DataError(
            f"the pickle refers to {shown(name.replace(' ', '.'))}, which is no array and no "
            "known record; nothing of it was run."
        )

    def add(self, container: Any) -> None:
        """Puts a new container or record on the stack."""
        self.costs.spend(_CONTAINER_WORK)
        self.stack.append(container)

    def pop_mark(self) -> list[Any]:
        """Removes and returns the entries above the topmost marker."""
        entries: list[Any] = []
        while (entry := self.stack.pop()) is not _MARK:
            entries.append(entry)
        return entries[::-1]

    def tuple_of(self, count: int | None) -> None:
        if count is None:
            entries = self.pop_mark()
        else:
            entries = [self.stack.pop() for _ in range(count)][::-1]
        self.stack.append(tuple(_plain(entry) for entry in entries))

    def append(self, entries: Sequence[Any]) -> None:
        if not isinstance(self.stack[-1], list):
            raise TypeError
        self.stack[-1].extend(_plain(entry) for entry in entries)

    def set_items(self, entries: list[Any]) -> None:
        target = self.stack[-1]
        if not isinstance(target, dict) or len(entries) % 2:
            raise TypeError
        for key, value in zip(entries[::2], entries[1::2], strict=True):
            # Nested tuples as keys would take exponential time to hash.
            if not isinstance(key, str | int | float | bool | None):
                raise DataError(f"the pickle has a dictionary key of type {type(key).__name__}.")
            target[key] = _plain(value)

    def stack_global(self) -> None:
        name, module = self.stack.pop(), self.stack.pop()
        if not isinstance(name, str) or not isinstance(module, str):
            raise TypeError
        self.stack.append(self.named(f"{module} {name}"))

    def new_object(self) -> None:
        arguments, cls = self.stack.pop(), self.stack.pop()
        if not isinstance(cls, _Global) or cls.name in _FUNCTIONS or cls.name == _NDARRAY:
            raise TypeError
        if not isinstance(arguments, tuple):
            raise TypeError
        if cls.name == _JOBLIB_ARRAY:
            self.stack.append(_PickledArray(is_joblib=True))
        else:
            self.add(Record(cls.name, arguments))

    def reduce(self) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        name = function.name if isinstance(function, _Global) else ""
        if name not in _FUNCTIONS or not isinstance(arguments, tuple):
            raise DataError(
                f"the pickle calls {shown(name.replace(' ', '.') or type(function).__name__)}; "
                "nothing of it was run."
            )
        member = name.split()[1]
        if member == "dtype":
            code = arguments[0]
            if not isinstance(code, str) or code not in _DTYPES | _LABEL_DTYPES:
                raise DataError(f"the pickle has an array of type {shown(code)}, not of numbers.")
            self.stack.append(_PickledDtype(code))
        elif member == "_reconstruct":
            if not isinstance(arguments[0], _Global) or arguments[0].name != _NDARRAY:
                raise TypeError
            self.stack.append(_PickledArray())
        elif member == "scalar":
            dtype, content = arguments
            self.stack.append(_array(content, (), dtype, "C")[()])
        elif member == "encode":
            text, encoding = arguments
            self.costs.copy(len(text))
            if encoding not in ("latin1", "latin-1"):
                raise DataError("the pickle encodes text in an unexpected way.")
            self.stack.append(text.encode("latin-1"))
        elif arguments == ():
            self.stack.append(b"" if member == "bytes" else {})
        else:
            raise DataError(f"the pickle makes a {member} of arguments.")

    def build(self) -> None:
        """Sets the state of the topmost object; the data of a joblib array follow in the file."""
        state: Any = self.stack.pop()
        target = self.stack[-1]
        self.costs.spend(_num_entries(state))
        if isinstance(target, _PickledDtype):
            if (
                state[1] not in ("<", ">", "|", "=")
                or state[2] is not None
                or state[3] is not None
            ):
                raise DataError("the pickle has an array that is not of plain numbers.")
            target.byte_order = state[1]
        elif isinstance(target, _PickledArray) and target.is_joblib:
            target.values = self.read_joblib_array(state)
        elif isinstance(target, _PickledArray):
            _, shape, dtype, is_fortran, content = state
            target.values = _array(content, shape, dtype, "F" if is_fortran else "C")
        elif isinstance(target, Record):
            if not isinstance(state, dict) or not all(isinstance(key, str) for key in state):
                raise TypeError
            target.fields.update(state)
        else:
            raise DataError(f"the pickle sets the state of a {type(target).__name__}.")

    def read_joblib_array(self, fields: dict[str, Any]) -> NDArray[Any]:
        subclass = fields["subclass"]
        if not isinstance(subclass, _Global) or subclass.name != _NDARRAY:
            raise TypeError
        shape, dtype = fields["shape"], fields["dtype"]
        if isinstance(dtype, _PickledDtype) and dtype.code in _LABEL_DTYPES:
            # joblib writes a complete pickle of such an array here. The same restrictions apply
            # to it, and it must not contain another one.
            if self.is_nested:
                raise TypeError
            arguments = self.file, self.size, self.records, self.costs
            return _Machine(*arguments, is_nested=True).run()
        if fields.get("numpy_array_alignment_bytes") is not None:
            self.file.seek(self.file.read(1)[0], io.SEEK_CUR)
        num_bytes = _num_bytes(shape, dtype)
        content = self.file.read(num_bytes) if num_bytes <= self.size else b""
        return _array(content, shape, dtype, fields["order"])


_LITERALS = frozenset(
    {
        "BINBYTES",
        "BINBYTES8",
        "BINFLOAT",
        "BININT",
        "BININT1",
        "BININT2",
        "BINUNICODE",
        "BINUNICODE8",
        "LONG1",
        "LONG4",
        "SHORT_BINBYTES",
        "SHORT_BINUNICODE",
    }
)

_STEPS: dict[str, Callable[[_Machine], None]] = {
    "APPEND": lambda machine: machine.append((machine.stack.pop(),)),
    "APPENDS": lambda machine: machine.append(machine.pop_mark()),
    "BUILD": _Machine.build,
    "NEWOBJ": _Machine.new_object,
    "REDUCE": _Machine.reduce,
    "SETITEM": lambda machine: machine.set_items([machine.stack.pop(), machine.stack.pop()][::-1]),
    "SETITEMS": lambda machine: machine.set_items(machine.pop_mark()),
    "STACK_GLOBAL": _Machine.stack_global,
    "TUPLE": lambda machine: machine.tuple_of(None),
    "TUPLE1": lambda machine: machine.tuple_of(1),
    "TUPLE2": lambda machine: machine.tuple_of(2),
    "TUPLE3": lambda machine: machine.tuple_of(3),
}

_Step = Callable[[_Machine, Any], None]


def _step(name: str) -> _Step | None:
    """Returns what the machine does for an instruction, given its operand; ``None`` to stop."""
    constants: dict[str, Any] = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
    constants |= {"EMPTY_TUPLE": (), "MARK": _MARK}
    containers: dict[str, type] = {"EMPTY_DICT": dict, "EMPTY_LIST": list}
    if name == "STOP":
        return None
    if name in ("PROTO", "FRAME"):
        return lambda machine, operand: None
    if name in constants:
        constant = constants[name]
        return lambda machine, operand: machine.stack.append(constant)
    if name in containers:
        container = containers[name]
        return lambda machine, operand: machine.add(container())
    if name in _LITERALS:
        return lambda machine, operand: machine.stack.append(operand)
    if name in ("BINPUT", "LONG_BINPUT"):
        return lambda machine, operand: machine.memo.__setitem__(operand, machine.stack[-1])
    if name == "MEMOIZE":
        return lambda machine, operand: machine.memo.__setitem__(
            len(machine.memo), machine.stack[-1]
        )
    if name in ("BINGET", "LONG_BINGET"):
        return lambda machine, operand: machine.stack.append(machine.memo[operand])
    if name == "GLOBAL":
        return lambda machine, operand: machine.stack.append(machine.named(operand))
    if name in _STEPS:
        step = _STEPS[name]
        return lambda machine, operand: step(machine)

    def refuse(machine: _Machine, operand: Any) -> None:
        raise DataError(f"the pickle uses the instruction {name}, which data do not need.")

    return refuse


_INSTRUCTIONS: dict[bytes, tuple[Callable[[IO[bytes]], Any] | None, _Step | None]] = {
    opcode.code.encode("latin-1"): (opcode.arg and opcode.arg.reader, _step(opcode.name))
    for opcode in pickletools.opcodes
}
"""Of each instruction, a function that reads its operand if it has one, and its step."""


def _plain(value: Any) -> Any:
    """Returns the array of a finished placeholder, and any other value unchanged."""
    if value is _MARK or (isinstance(value, _PickledArray) and value.values is None):
        raise TypeError
    return value.values if isinstance(value, _PickledArray) else value


def _num_entries(state: Any) -> int:
    """Returns the number of entries that a BUILD instruction visits."""
    parts = state if isinstance(state, tuple) else (state,)
    return sum(len(part) for part in parts if isinstance(part, list | dict))


def _num_bytes(shape: Any, dtype: Any) -> int:
    if not isinstance(dtype, _PickledDtype) or not isinstance(shape, tuple):
        raise TypeError
    if len(shape) > _MAX_DIMENSIONS or not all(
        type(n) is int and 0 <= n <= LIMITS.numbers for n in shape
    ):
        raise DataError(f"the pickle has an array of the impossible shape {shown(shape)}.")
    return math.prod(shape) * np.dtype(dtype.code).itemsize


def _array(content: Any, shape: Any, dtype: Any, order: Any) -> NDArray[Any]:
    """Returns an array made from bytes, or from text labels, that are already in memory."""
    if isinstance(dtype, _PickledDtype) and dtype.code in _LABEL_DTYPES:
        is_text = isinstance(content, list) and all(isinstance(entry, str) for entry in content)
        if not is_text or shape != (len(content),):
            raise DataError("the pickle has an array of objects that are not text.")
        # Each entry takes as much memory as the longest one.
        if len(content) > LIMITS.columns or max(map(len, content), default=0) > _MAX_LABEL_LENGTH:
            raise DataError("the pickle has more or longer labels than a rollout.")
        return np.array(content, dtype=np.str_)
    num_bytes = _num_bytes(shape, dtype)
    if not isinstance(content, bytes) or order not in ("C", "F"):
        raise TypeError
    if len(content) != num_bytes:
        raise DataError(
            f"the pickle has an array of shape {shown(shape)} with {len(content)} bytes, but it "
            f"needs {shown(num_bytes)}."
        )
    return np.frombuffer(content, dtype=f"{dtype.byte_order}{dtype.code}").reshape(
        shape, order=order
    )
