"""Base class for physical devices: a control loop at a fixed rate that always ends at rest."""

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
    """Timing and end of the latest episode.

    Attributes:
        ending: Reason why the episode ended, one sentence.
        num_steps: Number of completed steps.
        missed_deadlines: Number of steps that began late.
        largest_delay: Largest delay of a step after its due time, in s.
    """

    ending: str = ""
    num_steps: int = 0
    missed_deadlines: int = 0
    largest_delay: float = 0.0


@dataclass
class _Record:
    """Measurements and applied commands so far."""

    readings: list[Array] = field(default_factory=list)
    actions: list[Array] = field(default_factory=list)


class HardwareTarget(TargetDomain):
    """A physical device; subclasses implement the communication with it.

    A subclass sets ``name``, ``sensors``, ``actions`` and ``time_step`` and implements the hooks
    :meth:`connect`, :meth:`reset`, :meth:`read`, :meth:`write`, :meth:`stop` and
    :meth:`disconnect`. An episode calls them as follows:

        connect, reset, read, then in each step: controller, write, wait for the next tick, read;
        at the end, for any reason: write the rest command, stop, disconnect.

    The three last calls are also made after exceptions and Ctrl-C, each even if another one fails.
    Python makes none of them when the process is killed. Therefore let SIGTERM set the emergency
    stop (``signal.signal(signal.SIGTERM, lambda *_: event.set())``), and use a watchdog in the
    device itself.

    A measurement outside the bounds of ``sensors`` ends the episode, as in simulation. Problems
    that need a person raise an error: the emergency stop, missed deadlines, a silent controller or
    driver, a measurement that is not a number. No measurement is lost: the exception carries the
    rollout so far, see :func:`~npdr_ppl.targets.base.partial_rollout`.

    Args:
        emergency_stop: Event, or function that returns whether to stop at once; checked before
            each command and after each measurement.
        max_missed_deadlines: Number of late steps that an episode may have. A step is late if it
            begins more than a tenth of the time step after its due time, the tolerance for
            constant sampling of recordings. All later steps are then shifted by the delay.
        watchdog_timeout: Seconds after which a silent controller or driver is stopped.
        clock: Function that returns a monotonic time in s.
        sleep: Function that waits for a time in s.

    Attributes:
        report: Timing and end of the latest episode.
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
        """Moves the device to its initial state and returns when it has arrived."""

    @abstractmethod
    def read(self) -> ArrayLike:
        """Returns the present measurements, ``(sensors,)``, in the sensors' units."""

    @abstractmethod
    def write(self, actions: Array) -> None:
        """Sends commands, ``(actions,)``, limited and in the actions' units; must not block."""

    @abstractmethod
    def stop(self) -> None:
        """Switches off the power of the actuators.

        It is called at the end of every episode, perhaps more than once. The watchdog may call it
        from another thread while another hook hangs.
        """

    @abstractmethod
    def disconnect(self) -> None:
        """Closes the connection."""

    def rest(self) -> Array:
        """Returns the command for the device at rest, ``(actions,)``: zeros.

        Devices that take positions must override this, because they would move to position zero.
        """
        return np.zeros(len(self.actions))

    # -- The loop ----------------------------------------------------------------------------

    def run(
        self, controller: Controller, num_steps: int, *, episode: int = 0, seed: int
    ) -> Rollouts:
        """Runs one episode; see the class and :class:`TargetDomain`.

        Args:
            controller: Controller of the device; it must return within the time step.
            num_steps: Maximum number of steps.
            episode: Ignored: all episodes are equal.
            seed: Ignored: :meth:`reset` sets the initial state of a device.

        Raises:
            TargetError: A person should check the device.
        """
        self._check_declaration(num_steps)
        record = _Record()
        self.report = HardwareReport()
        try:
            with ExitStack() as cleanup:
                self.connect()
                # Called in reverse order: the rest command is sent while the connection is open.
                cleanup.callback(self.disconnect)
                watchdog = cleanup.enter_context(Watchdog(self._watchdog_timeout, self.stop))
                cleanup.callback(self.stop)
                cleanup.callback(lambda: self.write(self.rest()))
                self.reset()
                self.report.ending = self._loop(controller, num_steps, record, watchdog)
            return self._rollout_of(record)
        except BaseException as error:
            self.report.ending = f"{type(error).__name__}: {error}"
            # A rollout needs at least one step.
            if record.actions and len(record.readings) > 1:
                error.rollout = self._rollout_of(record)  # type: ignore[attr-defined]
            raise
        finally:
            self.report.num_steps = max(len(record.readings) - 1, 0)

    def _check_declaration(self, num_steps: int) -> None:
        """Checks the declaration, so that errors appear before the device moves."""
        if num_steps < 1:
            raise ModelError(f"An episode has at least one step, got {num_steps=}.")
        if self._watchdog_timeout < 2.0 * self.time_step:
            raise ModelError(
                f"The watchdog of {self.name} is fed every {self.time_step:g} s: it needs a "
                f"timeout of two steps or more, got {self._watchdog_timeout:g} s."
            )
        # Invalid columns, e.g. two with the same name, raise an error here.
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
        """Waits for a tick; returns its due time, or its actual time if it was late."""
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
        """Returns the present measurements after checking their number and values."""
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
        """Describes a measurement outside its bounds; an empty string if there is none."""
        for value, channel in zip(reading, self.sensors, strict=True):
            if not channel.lower <= value <= channel.upper:
                return (
                    f"{channel.name} is {value:.4g} {channel.unit}, outside {channel.lower:.4g} … "
                    f"{channel.upper:.4g}"
                )
        return ""

    def _rollout_of(self, record: _Record) -> Rollouts:
        """Returns the recorded steps; a command without a later measurement is left out."""
        num_steps = min(len(record.actions), len(record.readings) - 1)
        return self.rollout(record.readings[: num_steps + 1], record.actions[:num_steps])
