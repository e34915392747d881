"""Compiling time loops: when it pays, how kernels are shared, and what happens where it fails.

A kernel is the loop body unrolled over a few steps, compiled by torch.compile for flat batches of
any size. Kernels are shared between objects that are equal in all that the traced code can see,
so that a model that makes a new simulator on every call does not compile it on every call.
"""

import functools
import importlib
import importlib.util
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

# What an eager loop costs per time step, for Python and for calling some forty operations, and on
# top of that per simulation and time step; and what compiling the loop costs. Measured with the
# Furuta swing-up, policy and reward included: processor time of one core, float32, batches of 200
# to 200 000, nothing in the compiler's cache on disk. With dry friction or a Runge-Kutta method
# all three are about twice as large, so that the comparison stands. Compiled loops take a tenth.
_EAGER_SECONDS_PER_TIME_STEP = 150e-6
_EAGER_SECONDS_PER_SIMULATION_STEP = 20e-9
_COMPILE_SECONDS = 10.0

# Steps that one call of a compiled kernel may take; what a call costs, and on top of that per
# simulation for its state's way to memory and back; what a step more costs to compile, 3 s for the
# paper's equations and 12 s with friction. Measured as above.
_STEPS_PER_CALL = (2, 5, 10)
_CALL_SECONDS = 250e-6
_CALL_SECONDS_PER_SIMULATION = 40e-9
_COMPILE_SECONDS_PER_STEP = 8.0

# Shapes, types and devices that one kernel may specialise to. Beyond the limit torch raises,
# because kernels are compiled with fullgraph=True; it would silently run eagerly otherwise.
_RECOMPILE_LIMIT = 64

# One fused pass over memory per call, however long the unrolled body is; inputs are checked here.
# The processor says which vector instructions it has; that the C++ compiler knows them too is
# not tried out first, which takes 20 s: where it does not, loops run eagerly.
_OPTIONS = (("max_fusion_size", 100_000), ("size_asserts", False), ("cpp.vec_isa_ok", True))

# Attributes that traced code does not read: priors of effects, values and defaults of policies'
# parameters.
_INVISIBLE = frozenset({"_priors", "parameters", "parameter_info", "compile"})

# Characters that an error quotes from each end of the compiler's own message: what failed comes
# first, what the C++ compiler said last, and its command line fills pages between them.
_QUOTED = 2_000


def is_worthwhile(
    mode: CompileMode,
    device: torch.device,
    *,
    num_steps: int,
    batch_size: int,
    expected_calls: int = 1,
) -> bool:
    """Returns whether to compile a time loop: whether running it eagerly would take longer.

    Depends on nothing but the arguments and the compiler at hand, because compiled and eager
    loops round differently, and a result should not depend on what ran before it.

    Args:
        mode: The caller's choice.
        device: Device of the computation.
        num_steps: Time steps of one call.
        batch_size: Simulations that advance together.
        expected_calls: How many calls of this size are to come.

    Raises:
        DependencyError: Compilation is demanded, but there is no compiler.
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
    """Returns how many time steps a compiled kernel had better take at a time.

    Args:
        num_steps: Time steps of one simulation.
        batch_size: Simulations that advance together.
        expected_calls: How many simulations of this size are to come.
    """
    per_call = _CALL_SECONDS + batch_size * _CALL_SECONDS_PER_SIMULATION
    calls = expected_calls * num_steps * per_call / _COMPILE_SECONDS_PER_STEP
    # Calls and compilation together are least at the square root, and flat about it.
    wanted = math.sqrt(2.0 * calls)
    return max((n for n in _STEPS_PER_CALL if n <= wanted), default=_STEPS_PER_CALL[0])


def with_fallback(mode: CompileMode, is_compiled: bool, run: Callable[[bool], _T]) -> _T:
    """Returns ``run(is_compiled)``, or ``run(False)`` where ``auto`` meets a failing compiler.

    Args:
        mode: The caller's choice.
        is_compiled: What :func:`is_worthwhile` made of it.
        run: The computation, compiled or not; must start anew when it is called again.

    Raises:
        CompilationError: Compilation is demanded and fails.
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
    """A function to compile, equal to others of the same signature."""

    key: Hashable
    function: Callable[..., Any] = field(compare=False)


def compiled(key: Hashable, function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns ``function`` compiled, or what was compiled before under the same key.

    What is returned raises a :class:`CompilationError` where compilation fails, the next time
    without another attempt.

    Args:
        key: Signature of everything that the function closes over, floating type and device.
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
    # The stubs of torch.compile do not know its latest options.
    function = torch.compile(  # pyright: ignore[reportCallIssue]
        kernel.function,
        fullgraph=True,
        options=dict(_OPTIONS),
        recompile_limit=_RECOMPILE_LIMIT,
        isolate_recompiles=True,
    )
    # As text: the error itself would keep alive every tensor of the failed attempt.
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


def mark_sizes_dynamic(tree: Any) -> None:
    """Marks the leading size of every tensor as variable, for the next compilation.

    torch.compile(dynamic=True) would do, but it also turns every number that the code reads from
    an object into a variable; that made the Furuta loop 1.7 times slower.
    """
    for leaf in pytree.tree_leaves(tree):
        # Torch gives the sizes 0 and 1 kernels of their own.
        if isinstance(leaf, Tensor) and leaf.ndim and leaf.shape[0] > 1:
            torch._dynamo.maybe_mark_dynamic(leaf, 0)


def signature(thing: Any) -> Hashable:
    """Returns a value that is equal for objects which traced code cannot tell apart.

    Tensors and functions count by identity (a kernel keeps alive what it closes over); other
    objects by type and attributes.
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
