"""Compiles time loops: decides when to compile, shares kernels, and handles failures.

A kernel is the loop body unrolled over a few steps, compiled by torch.compile for flat batches of
any size. Objects share a kernel if they are equal in everything that the traced code uses. A model
that makes a new simulator on every call is therefore compiled only once.
"""

import functools
import importlib
import importlib.util
import inspect
import logging
import math
import os
import shutil
import warnings
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from npdr_ppl.errors import CompilationError, DependencyError

__all__ = [
    "CompileMode",
    "compiled",
    "is_worthwhile",
    "mark_sizes_dynamic",
    "signature",
    "steps_per_call",
    "with_fallback",
]

CompileMode = Literal["auto", "always", "never"]

_T = TypeVar("_T")

_LOGGER = logging.getLogger(__name__)

# Costs of an eager loop per time step, for Python and for calling about forty operations, and
# additional costs per simulation and time step; then the costs of compiling the loop. All are
# processor times of one core, measured with the Furuta swing-up including policy and reward, in
# float32, for batches of 200 to 200 000, with an empty compiler cache on disk. With dry friction
# or a Runge-Kutta method all three are about twice as large, so the comparison remains valid.
# Compiled loops take a tenth of the time of eager ones.
_EAGER_SECONDS_PER_TIME_STEP = 150e-6
_EAGER_SECONDS_PER_SIMULATION_STEP = 20e-9
_COMPILE_SECONDS = 10.0

# Possible numbers of steps per call of a compiled kernel; costs of a call, and additional costs
# per simulation for reading and writing its state; costs of compiling one more step, which are 3 s
# for the paper's equations and 12 s with friction. Measured as above.
_STEPS_PER_CALL = (2, 5, 10)
_CALL_SECONDS = 250e-6
_CALL_SECONDS_PER_SIMULATION = 40e-9
_COMPILE_SECONDS_PER_STEP = 8.0

# Number of combinations of shape, type and device for which one kernel may be compiled. Beyond
# this limit torch raises an error because of fullgraph=True; otherwise it would silently run
# eagerly.
_RECOMPILE_LIMIT = 64

# One fused pass over memory per call for unrolled bodies of any length; inputs are checked here.
# Vector instructions are chosen by the processor. A test whether the C++ compiler supports them
# would take 20 s and is skipped; if the compiler does not, loops run eagerly.
_OPTIONS = (("max_fusion_size", 100_000), ("size_asserts", False), ("cpp.vec_isa_ok", True))

# Attributes that traced code does not read: priors of effects, where a pulse of force began, and
# values and defaults of the parameters of policies.
_INVISIBLE = frozenset({"_priors", "start_positions", "parameters", "parameter_info", "compile"})

# Number of characters that an error quotes from the start and from the end of torch's message. The
# start says what failed, and the end is the output of the C++ compiler. Its long command line is
# between them.
_QUOTED = 2_000


def is_worthwhile(
    mode: CompileMode,
    device: torch.device,
    *,
    num_steps: int,
    batch_size: int,
    expected_calls: int = 1,
) -> bool:
    """Returns whether to compile a time loop because running it eagerly would take longer.

    The decision depends only on the arguments and on the available compiler. Compiled and eager
    loops round differently, and a result should not depend on earlier computations.

    Args:
        mode: The caller's choice.
        device: Device of the computation.
        num_steps: Time steps of one call.
        batch_size: Simulations that advance together.
        expected_calls: Number of calls of this size to expect.

    Raises:
        DependencyError: Compilation is required, but there is no compiler.
    """
    per_time_step = _EAGER_SECONDS_PER_TIME_STEP + batch_size * _EAGER_SECONDS_PER_SIMULATION_STEP
    eager_seconds = expected_calls * num_steps * per_time_step
    if mode == "never" or (mode == "auto" and eager_seconds < _COMPILE_SECONDS):
        return False
    if has_compiler(device.type):
        return True
    if mode == "always":
        raise DependencyError(
            "compile='always' needs a C++ compiler (or Triton on a GPU), and there is none; "
            "install one or use compile='auto'."
        )
    _log_once("There is no compiler, so time loops run eagerly, about ten times slower.")
    return False


def steps_per_call(*, num_steps: int, batch_size: int, expected_calls: int = 1) -> int:
    """Returns the number of time steps per call of a compiled kernel that saves most time.

    Args:
        num_steps: Time steps of one simulation.
        batch_size: Simulations that advance together.
        expected_calls: Number of simulations of this size to expect.
    """
    per_call = _CALL_SECONDS + batch_size * _CALL_SECONDS_PER_SIMULATION
    calls = expected_calls * num_steps * per_call / _COMPILE_SECONDS_PER_STEP
    # The total cost of calls and compilation has a flat minimum at the square root.
    wanted = math.sqrt(2.0 * calls)
    return max((n for n in _STEPS_PER_CALL if n <= wanted), default=_STEPS_PER_CALL[0])


def with_fallback(mode: CompileMode, is_compiled: bool, run: Callable[[bool], _T]) -> _T:
    """Returns ``run(is_compiled)``, or ``run(False)`` if compilation fails in mode ``auto``.

    Args:
        mode: The caller's choice.
        is_compiled: The decision of :func:`is_worthwhile`.
        run: The computation, compiled or not; it must start from the beginning at every call.

    Raises:
        CompilationError: Compilation is required and fails.
    """
    if not is_compiled:
        return run(False)
    try:
        return run(True)
    except CompilationError as error:
        if mode == "always":
            raise
        reason = str(error).splitlines()[0]
    _log_once(f"{reason}. It runs eagerly instead, about ten times slower.")
    return run(False)


@functools.lru_cache
def has_compiler(device_type: str) -> bool:
    """Returns whether torch.compile can generate code for a kind of device."""
    if device_type == "cpu":
        return shutil.which(os.environ.get("CXX", "g++")) is not None
    return importlib.util.find_spec("triton") is not None


@functools.lru_cache
def _log_once(message: str) -> None:
    _LOGGER.warning(message)


@dataclass(frozen=True)
class _Kernel:
    """A function to compile; kernels with the same signature are equal."""

    key: Hashable
    function: Callable[..., Any] = field(compare=False)


def compiled(key: Hashable, function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns ``function`` compiled, or the function compiled before with the same key.

    If compilation fails, the returned function raises a :class:`CompilationError`. Further calls
    raise it without another attempt.

    Args:
        key: Signature of all objects that the function closes over, floating type and device.
        function: Pure function of nested tuples and dictionaries of tensors.
    """
    # The number of threads is fixed when code is generated.
    return _compile(_Kernel((key, torch.get_num_threads()), function))


@functools.lru_cache(maxsize=128)
def _compile(kernel: _Kernel) -> Callable[..., Any]:
    with warnings.catch_warnings():
        # Torch's code generator warns about torch's own modules when it is first imported.
        warnings.simplefilter("ignore", DeprecationWarning)
        importlib.import_module("torch._inductor.compile_fx")
        from torch._dynamo.exc import TorchDynamoException
    function = torch.compile(
        kernel.function, fullgraph=True, options=dict(_OPTIONS), **_recompile_options()
    )
    # Stored as text, because the error object would keep all tensors of the failed attempt alive.
    failure: str | None = None

    def run(*arguments: Any) -> Any:
        nonlocal failure
        if failure is not None:
            raise CompilationError(failure)
        try:
            return function(*arguments)
        except TorchDynamoException as error:
            said = str(error).strip() or type(error).__name__
            if len(said) > 2 * _QUOTED:
                said = f"{said[:_QUOTED]}\n[…]\n{said[-_QUOTED:]}"
            failure = f"Torch could not compile a time loop: {said}"
            raise CompilationError(failure) from error

    return run


def _recompile_options() -> dict[str, Any]:
    """Returns those of torch.compile's options for recompilation that the installed torch has.

    Torch 2.11 has none of them. It counts the kernels of all simulators together and raises an
    error after its own limit, which is lower.
    """
    wanted = {"recompile_limit": _RECOMPILE_LIMIT, "isolate_recompiles": True}
    known = inspect.signature(torch.compile).parameters
    return {name: value for name, value in wanted.items() if name in known}


def mark_sizes_dynamic(tree: Any) -> None:
    """Marks the leading size of every tensor as variable, for the next compilation.

    torch.compile(dynamic=True) would also work, but it turns every number that the code reads from
    an object into a variable. That makes the Furuta loop 1.7 times slower.
    """
    for leaf in pytree.tree_leaves(tree):
        # Torch compiles separate kernels for the sizes 0 and 1.
        if isinstance(leaf, Tensor) and leaf.ndim and leaf.shape[0] > 1:
            torch._dynamo.maybe_mark_dynamic(leaf, 0)


def signature(thing: Any) -> Hashable:
    """Returns a value that is equal for objects that traced code cannot distinguish.

    Tensors and functions are compared by identity, because a kernel keeps the objects that it
    closes over alive. Other objects are compared by type and attributes.
    """
    if isinstance(thing, Mapping):
        return tuple(sorted((str(key), signature(value)) for key, value in thing.items()))
    if isinstance(thing, tuple | list):
        return tuple(signature(item) for item in thing)
    if isinstance(thing, Tensor):
        return "tensor", id(thing)
    if not hasattr(thing, "__dict__") or _is_stateless(thing):
        return thing if isinstance(thing, Hashable) else id(thing)
    attributes = {name: value for name, value in vars(thing).items() if name not in _INVISIBLE}
    return type(thing), signature(attributes)


def _is_stateless(thing: Any) -> bool:
    """Returns whether ``thing`` is a plain function or a class."""
    return isinstance(thing, type) or (callable(thing) and not vars(thing))
