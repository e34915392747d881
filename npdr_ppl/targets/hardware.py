"""A template for physical devices: a loop at a fixed rate that always ends at rest."""

import threading
import time
from abc import abstractmethod
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from npdr_ppl.errors import ModelError
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.rollout_checks import MAX_MAGNITUDE, MAX_STEP_JITTER
from npdr_ppl.targets.base import Array, Controller, TargetDomain, TargetError, end_episode
from npdr_ppl.targets.watchdog import Watchdog

__all__ = ["HardwareReport", "HardwareTarget"]


@dataclass
class HardwareReport:
    """How the latest episode went.

    Attributes:
        ending: Why the episode ended, one sentence.
        num_steps: Steps made.
        missed_deadlines: Steps that began late.
        largest_delay: The latest that a step began, in s after its due time.
    """

    ending: str = ""
    num_steps: int = 0
    missed_deadlines: int = 0
    largest_delay: float = 0.0


@dataclass
class _Record:
    """What was read and applied so far."""

    readings: list[Array] = field(default_factory=list)
    actions: list[Array] = field(default_factory=list)


class HardwareTarget(TargetDomain):
    """A physical device; subclasses say how to talk to it.

    A subclass sets ``name``, ``sensors``, ``actions`` and ``time_step`` and writes the hooks
    :meth:`connect`, :meth:`reset`, :meth:`read`, :meth:`write`, :meth:`stop` and
    :meth:`disconnect`. An episode calls them as follows:

        connect, reset, read, then in each step: controller, write, wait for the tick, read;
        at the end, whatever ended it: write the command of rest, stop, disconnect.

    The end comes also upon exceptions and Ctrl-C, and each of its three calls is made even if
    another one fails. Python runs none of it when the process is killed, so let SIGTERM set the
    emergency stop (``signal.signal(signal.SIGTERM, lambda *_: event.set())``), and give the
    device a watchdog of its own.

    A reading outside the bounds of ``sensors`` ends the episode, as in simulation. What needs a
    person raises instead: the emergency stop, missed deadlines, silence, a reading that is no
    number. In either case no reading is lost: the exception carries the rollout so far, see
    :func:`~npdr_ppl.targets.base.partial_rollout`.

    Args:
        emergency_stop: Event, or function that returns whether to stop at once; asked before
            each command and after each reading.
        max_missed_deadlines: Late steps that an episode may have. A step is late if it begins
            more than a tenth of the time step after it is due, which is what recordings may
            deviate from constant sampling; later ones are then shifted, not caught up with.
        watchdog_timeout: Seconds after which a silent controller or driver is stopped.
        clock: Time in s that never goes back.
        sleep: Waits for a time in s.

    Attributes:
        report: How the latest episode went.
    """

    def __init__(
        self,
        *,
        emergency_stop: threading.Event | Callable[[], bool] | None = None,
        max_missed_deadlines: int = 5,
        watchdog_timeout: float = 0.5,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if isinstance(emergency_stop, threading.Event):
            emergency_stop = emergency_stop.is_set
        self._is_stop_pressed = emergency_stop or (lambda: False)
        self._max_missed_deadlines = max_missed_deadlines
        self._watchdog_timeout = watchdog_timeout
        self._clock = clock
        self._sleep = sleep
        self.report = HardwareReport()

    # -- Hooks -------------------------------------------------------------------------------

    @abstractmethod
    def connect(self) -> None:
        """Opens the connection; nothing may move yet."""

    @abstractmethod
    def reset(self) -> None:
        """Brings the device to its initial state and returns when it is there."""

    @abstractmethod
    def read(self) -> ArrayLike:
        """Returns the present readings, ``(sensors,)``, in the sensors' units."""

    @abstractmethod
    def write(self, actions: Array) -> None:
        """Sends commands, ``(actions,)``, limited and in the actions' units; must not block."""

    @abstractmethod
    def stop(self) -> None:
        """Takes the power from the actuators.

        It is called at every end, and may be called more than once, and by the watchdog from
        another thread while another hook hangs.
        """

    @abstractmethod
    def disconnect(self) -> None:
        """Closes the connection."""

    def rest(self) -> Array:
        """Returns the command that lets the device rest, ``(actions,)``: zeros.

        Devices that take positions must override this: zero would be a place to go to.
        """
        return np.zeros(len(self.actions))

    # -- The loop ----------------------------------------------------------------------------

    def run(
        self, controller: Controller, num_steps: int, *, episode: int = 0, seed: int
    ) -> Rollouts:
        """Runs one episode; see the class and :class:`TargetDomain`.

        Args:
            controller: What commands the device; it has to answer within the time step.
            num_steps: Greatest number of steps.
            episode: Ignored: all episodes are alike.
            seed: Ignored: a device is where :meth:`reset` brings it.

        Raises:
            TargetError: A person should look at the device.
        """
        self._check_declaration(num_steps)
        record = _Record()
        self.report = HardwareReport()
        try:
            with ExitStack() as cleanup:
                self.connect()
                # In reverse: the command of rest goes first, while there still is a connection.
                cleanup.callback(self.disconnect)
                watchdog = cleanup.enter_context(Watchdog(self._watchdog_timeout, self.stop))
                cleanup.callback(self.stop)
                cleanup.callback(lambda: self.write(self.rest()))
                self.reset()
                self.report.ending = self._loop(controller, num_steps, record, watchdog)
            return self._rollout_of(record)
        except BaseException as error:
            self.report.ending = f"{type(error).__name__}: {error}"
            # One step is the least that a rollout can hold.
            if record.actions and len(record.readings) > 1:
                error.rollout = self._rollout_of(record)  # type: ignore[attr-defined]
            raise
        finally:
            self.report.num_steps = max(len(record.readings) - 1, 0)

    def _check_declaration(self, num_steps: int) -> None:
        """Raises an error for what would otherwise show when the device has already moved."""
        if num_steps < 1:
            raise ModelError(f"An episode has at least one step, got {num_steps=}.")
        if self._watchdog_timeout < 2.0 * self.time_step:
            raise ModelError(
                f"The watchdog of {self.name} is fed every {self.time_step:g} s: it needs a "
                f"timeout of two steps or more, got {self._watchdog_timeout:g} s."
            )
        # Columns that no rollout can have, e.g. two of one name, raise here.
        self.rollout(np.zeros((2, len(self.sensors))), np.zeros((1, len(self.actions))))

    def _loop(
        self, controller: Controller, num_steps: int, record: _Record, watchdog: Watchdog
    ) -> str:
        """Fills the record and returns why the episode ended."""
        watchdog.feed()
        record.readings.append(self._checked_reading())
        if self._violation(record.readings[0]):
            raise TargetError(
                f"{self.name} starts outside its limits: {self._violation(record.readings[0])}."
            )
        due = self._clock()
        ending = "All steps were made."
        for step in range(num_steps):
            self._check_stops(watchdog)
            watchdog.feed()
            command = self.limit(controller(record.readings[-1].copy(), step * self.time_step))
            self._check_stops(watchdog)
            self.write(command)
            record.actions.append(command)
            due = self._wait_until(due + self.time_step)
            record.readings.append(self._checked_reading())
            violation = self._violation(record.readings[-1])
            if violation:
                ending = f"{violation}."
                break
        else:
            self._check_stops(watchdog)
        end_episode(controller, record.readings[-1])
        return ending

    def _wait_until(self, due: float) -> float:
        """Waits for a tick and returns when it was due, or when it came if that was too late."""
        remaining = due - self._clock()
        if remaining > 0.0:
            self._sleep(remaining)
        delay = self._clock() - due
        report = self.report
        report.largest_delay = max(report.largest_delay, delay)
        if delay <= MAX_STEP_JITTER * self.time_step:
            return due
        report.missed_deadlines += 1
        if report.missed_deadlines > self._max_missed_deadlines:
            raise TargetError(
                f"{self.name} missed {report.missed_deadlines} deadlines, the worst by "
                f"{1e3 * report.largest_delay:.2g} ms: the controller or the connection is too "
                f"slow for steps of {1e3 * self.time_step:g} ms."
            )
        return due + delay

    def _check_stops(self, watchdog: Watchdog) -> None:
        """Raises a TargetError if a person or the watchdog has stopped the device."""
        if self._is_stop_pressed():
            raise TargetError(f"The emergency stop of {self.name} was pressed.")
        if watchdog.has_barked:
            raise TargetError(
                f"{self.name} was stopped, because the controller or the connection was silent "
                f"for {self._watchdog_timeout:g} s."
            )

    def _checked_reading(self) -> Array:
        """Returns the present readings, which a rollout can hold."""
        reading = np.array(self.read(), dtype=np.float64)
        if reading.shape != (len(self.sensors),):
            raise TargetError(
                f"{self.name} has {len(self.sensors)} sensors, but read {reading.shape=}."
            )
        for value, channel in zip(reading, self.sensors, strict=True):
            if not abs(value) < MAX_MAGNITUDE:
                raise TargetError(f"The sensor {channel.name} of {self.name} reported {value}.")
        return reading

    def _violation(self, reading: Array) -> str:
        """Returns which reading is outside its bounds, or an empty string."""
        for value, channel in zip(reading, self.sensors, strict=True):
            if not channel.lower <= value <= channel.upper:
                return (
                    f"{channel.name} is {value:.4g} {channel.unit}, outside {channel.lower:.4g} … "
                    f"{channel.upper:.4g}"
                )
        return ""

    def _rollout_of(self, record: _Record) -> Rollouts:
        """Returns the recorded steps; a command without a reading after it is left out."""
        num_steps = min(len(record.actions), len(record.readings) - 1)
        return self.rollout(record.readings[: num_steps + 1], record.actions[:num_steps])
