"""Fault injection into the simulators of a Pyro model, whichever they are."""

import copy
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
from pyro.poutine.messenger import Messenger

from npdr_ppl.engines.pooled.pool_simulator import PooledSimulator, Segment
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.sites import SimulatorBlackBox
from tests.helpers.faulty import FaultRates, fail


class FaultySimulator(PooledSimulator):
    """A simulator that fails at given rates, and otherwise does what another one does.

    Args:
        simulator: The other one.
        rates: The rates; whether a simulation fails depends on its parameters.
        folder: Where failures are counted, so that a draw fails so many times and no more.
    """

    def __init__(self, simulator: PooledSimulator, rates: FaultRates, folder: Path) -> None:
        self.inner, self.rates, self.folder = simulator, rates, folder
        for name in ("states", "actions", "sensors", "parameters", "ports", "effects"):
            setattr(self, name, getattr(simulator, name))
        self.time_step = simulator.time_step
        self.is_deterministic = simulator.is_deterministic

    def with_effects(self, *effects: Effect) -> Self:
        changed = copy.copy(self)
        changed.inner = self.inner.with_effects(*effects)
        changed.effects = changed.inner.effects
        return changed

    def set_up(self) -> Any:
        return self.inner.set_up()

    def simulate_one(
        self, workspace: Any, parameters: Mapping[str, float], segment: Segment, seed: int
    ) -> np.ndarray:
        identity = np.array([*parameters.values(), *segment.initial_state]).tobytes()
        key = zlib.crc32(identity)
        fault = self.rates.fault(key)
        if fault is not None:
            file = self.folder / f"{key:08x}"
            with file.open("ab") as log:
                log.write(fault.value[:1].encode())
            if file.stat().st_size > self.rates.times:
                fault = None
        simulate = self.inner.simulate_one
        return fail(fault, key, lambda: simulate(workspace, parameters, segment, seed))


class FaultMessenger(Messenger):
    """Makes the simulators of a Pyro model faulty: ``FaultMessenger(rates, folder)(model)``."""

    def __init__(self, rates: FaultRates, folder: Path) -> None:
        super().__init__()
        self.rates, self.folder = rates, folder

    def _pyro_sample(self, msg: Any) -> None:
        box = msg["fn"]
        if isinstance(box, SimulatorBlackBox) and isinstance(box.simulator, PooledSimulator):
            changed = box.expand(box.batch_shape)
            changed.simulator = FaultySimulator(box.simulator, self.rates, self.folder)
            msg["fn"] = changed
