"""Compiling time loops: when it pays, how kernels are shared, and what happens without a compiler.

A kernel is the loop body unrolled over a few steps, compiled by torch.compile for flat batches of
any size. Kernels are shared between objects that are equal in all that the traced code can see,
so that a model that makes a new simulator on every call does not compile it on every call.
"""

import functools
import importlib
import importlib.util
import logging
import os
import shutil
import warnings
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from npdr_ppl.errors import DependencyError

__all__ = ["CompileMode", "compiled", "is_worthwhile", "mark_sizes_dynamic", "signature"]

CompileMode = Literal["auto", "always", "never"]

_LOGGER = logging.getLogger(__name__)

# Compilation takes about ten seconds; compiled loops save some 20 ns per step and simulation
# (38 against 335 million steps per second on one core). 10 s / 20 ns, rounded down.
_STEPS_THAT_PAY_BACK = 400_000_000

# Shapes, types and devices that one kernel may specialise to. Beyond the limit torch raises,
# because kernels are compiled with fullgraph=True; it would silently run eagerly otherwise.
_RECOMPILE_LIMIT = 64

# One fused pass over memory per call, however long the unrolled body is; inputs are checked here.
_OPTIONS = (("max_fusion_size", 100_000), ("size_asserts", False))

# Attributes that traced code does not read: priors of effects, values of policy parameters.
_INVISIBLE = frozenset({"_priors", "parameters", "compile"})


def is_worthwhile(mode: CompileMode, num_steps: int, device: torch.device) -> bool:
    """Returns whether to compile a computation of ``num_steps`` steps, summed over the batch.

    Raises:
        DependencyError: Compilation is demanded, but there is no compiler.
    """
    if mode == "never" or (mode == "auto" and num_steps < _STEPS_THAT_PAY_BACK):
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

    Args:
        key: Signature of everything that the function closes over.
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
    # The stubs of torch.compile do not know its latest options.
    return torch.compile(  # pyright: ignore[reportCallIssue]
        kernel.function,
        fullgraph=True,
        options=dict(_OPTIONS),
        recompile_limit=_RECOMPILE_LIMIT,
        isolate_recompiles=True,
    )


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
