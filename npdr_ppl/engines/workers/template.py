"""A process that has loaded a task and forks the process that simulates.

Loading Python, torch and an engine takes seconds. Forking a process that has loaded them takes
milliseconds. If a simulation crashes or must be killed, the template just forks again, so little
time is lost. The template itself never simulates and has only one thread, which makes forks safe.

The :class:`~npdr_ppl.engines.workers.supervisor.Supervisor` sends commands through a socket. When
its end of the socket closes for any reason, the template stops its child and itself.

A simulation may start programs of its own. They belong to the child's process group, which is
killed as a whole. On Linux, the template also adopts and kills programs that left the group.
"""

import ctypes
import os
import pickle
import signal
import socket
import sys
import traceback
from collections.abc import Sequence, Set
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from npdr_ppl.engines.workers.faults import Fault
from npdr_ppl.engines.workers.task import Draw, Task
from npdr_ppl.errors import NpdrError

__all__ = ["IDLE_SECONDS", "main"]

IDLE_SECONDS = 300.0
"""A template stops after this time without work, in seconds, because workers of a cluster may
keep running for days after a run."""

PR_SET_PDEATHSIG = 1
"""Linux's prctl option for the signal that a process gets when its parent ends."""

PR_SET_CHILD_SUBREAPER = 36
"""Linux's prctl option that makes a process the parent of its descendants without parents."""


def main(control_fd: int) -> None:
    """Executes the commands of a supervisor until the supervisor ends.

    Args:
        control_fd: Descriptor of the socket to the supervisor.
    """
    # The supervisor handles Ctrl-C and then closes its end of the socket.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _set_process_option(PR_SET_CHILD_SUBREAPER, 1)
    channel = socket.socket(fileno=control_fd)
    control = Connection(os.dup(control_fd))
    task: Task | None = None
    child: int | None = None
    own: set[int] = set()  # processes that libraries started in the template itself
    is_resting = False
    try:
        while not is_resting or control.poll(IDLE_SECONDS):
            is_resting = False
            command, *values = control.recv()
            if command == "load":
                task, reply = _load(*values)
                control.send(reply)
            elif command == "spawn":
                _, (fd,), _, _ = socket.recv_fds(channel, 1, 1)
                template, own = os.getpid(), _children()
                child = os.fork()
                if child == 0:
                    os.setpgid(0, 0)
                    _end_with(template)
                    control.close()
                    channel.close()
                    _simulate(task, Connection(fd))
                os.close(fd)
                with suppress(OSError):  # the child was faster, or has ended
                    os.setpgid(child, child)
                control.send(child)
            elif command == "end":
                control.send(_end(child, own))
                child = None
            elif command == "rest":
                is_resting = True
            elif command == "wake":
                control.send("awake")
    except (EOFError, OSError):
        pass
    finally:
        _end(child, own)
        os._exit(0)  # immediately, because the regular clean-up of torch is slow


def _load(pickled: bytes, path: Sequence[str]) -> tuple[Task | None, str]:
    """Unpickles a task and imports its modules; returns the task and an error message."""
    sys.path.extend(folder for folder in path if folder not in sys.path)
    try:
        return pickle.loads(pickled), ""
    except Exception:
        return None, traceback.format_exc(limit=-3)


def _end_with(parent: int) -> None:
    """Lets the kernel kill this process when its parent ends.

    A killed template cannot stop its child, and a child does not notice this during a draw. On
    systems without prctl, the child therefore continues until its draw is done.
    """
    _set_process_option(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # the parent has ended already
        os._exit(0)


def _set_process_option(option: int, value: int) -> None:
    """Calls Linux's prctl; does nothing on other systems."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(option, value)


def _end(child: int | None, own: Set[int]) -> int:
    """Kills the child and all that it started; returns its exit code, negative for a signal.

    Args:
        child: The child.
        own: Processes that are no descendants of the child.
    """
    if child is None:
        return 0
    with suppress(ProcessLookupError, PermissionError):  # macOS permits no signal to a zombie
        os.killpg(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    while adopted := _children() - own:
        for process in adopted:
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
    return os.waitstatus_to_exitcode(status)


def _children() -> set[int]:
    """Returns the children of this process, which has one thread; empty on other systems."""
    try:
        return {
            int(word)
            for word in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
        }
    except OSError:
        return set()


def _simulate(task: Task | None, data: Connection) -> None:
    """Runs groups of draws in a child, and never returns.

    Each result is sent as soon as its draw is done, so the supervisor knows which draw crashed or
    hung. After a failure the process stops, because its state is unknown.
    """
    code = 0
    try:
        assert task is not None
        try:
            workspace = task.set_up()
            data.send((None, ""))
        except Exception as error:
            data.send(_failure(error))
            return
        while True:
            for draw in data.recv():
                answer = _answer(task, workspace, draw)
                data.send(answer)
                if answer[0] is not None:
                    return
    except (EOFError, OSError):
        pass
    except BaseException:
        traceback.print_exc()
        code = 1
    finally:
        # Skips the clean-up of the template, which the child must not run.
        sys.stderr.flush()
        os._exit(code)


def _answer(task: Task, workspace: Any, draw: Draw) -> tuple[Any, Any]:
    """Returns the fault of a draw and its message, or ``None`` and its value."""
    try:
        value = np.asarray(task.run(workspace, draw))
        return (None, value) if bool(np.isfinite(value).all()) else (Fault.NAN, "")
    except Exception as error:
        return _failure(error)


def _failure(error: Exception) -> tuple[Any, Any]:
    """Returns the answer for an exception; an NpdrError means that the task is wrong."""
    if isinstance(error, NpdrError):
        return "refused", error
    return Fault.RAISED, f"{type(error).__name__}: {error}"
