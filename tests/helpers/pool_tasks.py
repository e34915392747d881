"""Small tasks for the tests of workers; in a module of their own, because workers import it."""

import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np

from npdr_ppl.engines.workers import Task
from npdr_ppl.errors import ModelError


class Noise(Task):
    """Three random numbers about the payload."""

    def run(self, workspace, draw):
        return np.random.default_rng(draw.seed).normal(draw.payload, size=3)


class Sleep(Task):
    """Sleeps for as many seconds as the payload says, and notes its process in a folder."""

    def __init__(self, folder):
        self.folder = folder

    def run(self, workspace, draw):
        (Path(self.folder) / str(os.getpid())).touch()
        time.sleep(draw.payload)
        return np.zeros(1)


class Orphan(Task):
    """Kills the template that forked it, and goes on for as many seconds as the payload says."""

    def run(self, workspace, draw):
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(draw.payload)
        return np.zeros(1)


class CountSetUps(Task):
    """Returns which set-up a draw found, and how many draws came before it."""

    def __init__(self, folder):
        self.folder = folder

    def set_up(self):
        (Path(self.folder) / str(os.getpid())).touch()
        return {"draws": 0}

    def run(self, workspace, draw):
        workspace["draws"] += 1
        if draw.payload == "fail" and draw.attempt == 0:
            raise ValueError("no luck")
        return np.array([workspace["draws"]])


class Refuses(Task):
    """Says that the task itself is wrong."""

    def run(self, workspace, draw):
        raise ModelError("There is no joint 'elbow'.")


class Raises(Task):
    """Raises an error at payloads below zero."""

    def run(self, workspace, draw):
        if draw.payload < 0:
            raise ArithmeticError("below zero")
        return np.array([float(draw.payload)])


class FailsToSetUp(Task):
    """Cannot be set up: an error, or the end of the process."""

    def __init__(self, crashes):
        self.crashes = crashes

    def set_up(self):
        if self.crashes:
            os._exit(9)
        raise OSError("no engine here")

    def run(self, workspace, draw):
        return np.zeros(1)


class FailsToLoad(Task):
    """Cannot be unpickled."""

    def __reduce__(self):
        return (_unloadable, ())

    def run(self, workspace, draw):
        return np.zeros(1)


def _unloadable():
    raise RuntimeError("this module is broken")


class Parent(Task):
    """Returns the process that the draw's own was forked from."""

    def run(self, workspace, draw):
        return np.array([os.getppid()])


class StartsPrograms(Task):
    """Starts a program in its own process group and one in another, and ends in a given way."""

    def __init__(self, folder):
        self.folder = folder

    def run(self, workspace, draw):
        if draw.payload == "starts none":
            return np.zeros(1)
        for is_apart in (False, True):
            program = subprocess.Popen(["sleep", "600"], start_new_session=is_apart)
            (Path(self.folder) / str(program.pid)).touch()
        if draw.payload == "hangs":
            program.wait()
        if draw.payload == "crashes":
            os._exit(3)
        if draw.payload == "raises":
            raise ArithmeticError("no luck")
        return np.zeros(1)
