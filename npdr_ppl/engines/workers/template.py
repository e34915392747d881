"""A process that has loaded a task and forks the process that simulates.

Loading Python, torch and an engine takes seconds; a fork of a process that has loaded them takes
milliseconds. So a simulation that crashes or has to be killed costs little more than itself: the
template stays as it was, and forks again. Nothing is ever simulated in the template, and it has
one thread only, which is what makes forks safe.

Commands come from the :class:`~npdr_ppl.engines.workers.supervisor.Supervisor` at the other end
of a socket; when that end closes, for whatever reason, the template ends with its child.
"""

import ctypes
import os
import pickle
import signal
import socket
import sys
import traceback
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from npdr_ppl.engines.workers.faults import Fault
from npdr_ppl.engines.workers.task import Draw, Task
from npdr_ppl.errors import NpdrError

__all__ = ["IDLE_SECONDS", "main"]

IDLE_SECONDS = 300.0
"""After so long without work a template ends; workers of a cluster may outlive a run by days."""

PR_SET_PDEATHSIG = 1
"""Linux's prctl option for the signal that a process gets when its parent ends."""


def main(control_fd: int) -> None:
    """Obeys a supervisor until it is gone.

    Args:
        control_fd: Descriptor of the socket whose other end the supervisor holds.
    """
    # Ctrl-C is for the supervisor; its end of the socket closes when it is done.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = socket.socket(fileno=control_fd)
    control = Connection(os.dup(control_fd))
    task: Task | None = None
    child: int | None = None
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
                template = os.getpid()
                child = os.fork()
                if child == 0:
                    _end_with(template)
                    control.close()
                    channel.close()
                    _simulate(task, Connection(fd))
                os.close(fd)
                control.send(child)
            elif command == "end":
                control.send(_end(child))
                child = None
            elif command == "rest":
                is_resting = True
            elif command == "wake":
                control.send("awake")
    except (EOFError, OSError):
        pass
    finally:
        _end(child)
        os._exit(0)  # at once, because taking torch apart would take longer than all the rest


def _load(pickled: bytes, path: Sequence[str]) -> tuple[Task | None, str]:
    """Unpickles a task, which imports what it needs; returns why not, if it fails."""
    sys.path.extend(folder for folder in path if folder not in sys.path)
    try:
        return pickle.loads(pickled), ""
    except Exception:
        return None, traceback.format_exc(limit=-3)


def _end_with(parent: int) -> None:
    """Has the kernel kill this process when its parent ends.

    A template that is killed cannot end its child, which in the middle of a draw does not see that
    nobody waits for its answer. Systems without prctl leave the child to its draw.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # already gone
        os._exit(0)


def _end(child: int | None) -> int:
    """Kills the child and returns its exit code, negative for a signal."""
    if child is None:
        return 0
    done, status = os.waitpid(child, os.WNOHANG)
    if not done:
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status)


def _simulate(task: Task | None, data: Connection) -> None:
    """Runs groups of draws in a child, and never returns.

    Every draw is answered as soon as it is done, so that the supervisor knows which one a crash
    or a hang belongs to. After a failure the process ends, because nobody knows what state it was
    left in.
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
        # Without the template's own clean-up, which is not the child's business.
        sys.stderr.flush()
        os._exit(code)


def _answer(task: Task, workspace: Any, draw: Draw) -> tuple[Any, Any]:
    """Returns what went wrong with a draw, or nothing and its value."""
    try:
        value = np.asarray(task.run(workspace, draw))
        return (None, value) if bool(np.isfinite(value).all()) else (Fault.NAN, "")
    except Exception as error:
        return _failure(error)


def _failure(error: Exception) -> tuple[Any, Any]:
    """Returns the answer for an exception: our own say that the task is wrong."""
    if isinstance(error, NpdrError):
        return "refused", error
    return Fault.RAISED, f"{type(error).__name__}: {error}"
