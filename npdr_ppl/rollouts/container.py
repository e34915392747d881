"""Rollouts: an immutable set of recorded or simulated episodes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.errors import DataError
from npdr_ppl.language.channels import Channel
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.rollouts import (
    collection,
    indices,
    rollout_checks,
    segments,
    simulator_checks,
)
from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.gridding import at_one_rate
from npdr_ppl.rollouts.recording import Recording

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from npdr_ppl.rollouts.logs.mapping import Mapping as LogMapping

__all__ = ["Rollouts"]

Path = str | PathLike[str]


@dataclass(frozen=True, eq=False, repr=False)
class Rollouts(Recording):
    """R recorded or simulated episodes with the same columns and the same time step.

    The fields and their checks are those of :class:`Recording`.
    """

    # -- Construction ------------------------------------------------------------------------

    @classmethod
    def of(cls, recording: Recording) -> "Rollouts":
        """Returns a recording as rollouts, without copying its arrays."""
        rollouts = object.__new__(cls)
        for field in fields(Recording):
            object.__setattr__(rollouts, field.name, getattr(recording, field.name))
        return rollouts

    @classmethod
    def from_csv(cls, path: Path, *, actions: Sequence[str] | None = None) -> "Rollouts":
        """Reads a CSV file with the columns ``rollout,time,<channels…>,<actions…>``.

        Units are SI. A rollout has one more row of measurements than of actions. Actions and the
        column ``reward`` are therefore recognised by an empty cell in the last row of every
        rollout. Measurements that were not taken at equal steps have rows of their own; the column
        ``step`` then counts the rows at which steps begin, and is empty in the others.

        Args:
            path: The file, UTF-8 with commas.
            actions: Names of the action columns, for files whose last rows are not empty; the
                actions of the last rows are then ignored.

        Raises:
            DataError: The file cannot be read; the message says why in one sentence.
        """
        from npdr_ppl.rollouts.io.csv_files import read_csv

        return cls.of(read_csv(path, actions))

    @classmethod
    def from_parquet(cls, path: Path, *, actions: Sequence[str] | None = None) -> "Rollouts":
        """Reads a Parquet file with the columns of :meth:`from_csv`."""
        from npdr_ppl.rollouts.io.file_formats import read_parquet

        return cls.of(read_parquet(path, actions))

    @classmethod
    def from_npz(cls, path: Path) -> "Rollouts":
        """Reads a file written by :meth:`to_npz`; nothing is unpickled."""
        from npdr_ppl.rollouts.io.file_formats import read_npz

        return cls.of(read_npz(path))

    @classmethod
    def from_netcdf(cls, path: Path) -> "Rollouts":
        """Reads a NetCDF4 file written by :meth:`to_netcdf`."""
        from npdr_ppl.rollouts.io.file_formats import read_netcdf

        return cls.of(read_netcdf(path))

    @classmethod
    def from_xarray(cls, dataset: "xr.Dataset") -> "Rollouts":
        """Converts a data set laid out as by :meth:`to_xarray`."""
        from npdr_ppl.rollouts.io.file_formats import from_xarray

        return cls.of(from_xarray(dataset))

    @classmethod
    def from_simurlacra(cls, path: Path, names: Mapping[str, str] | None = None) -> "Rollouts":
        """Reads a rollout, or a list of rollouts, that SimuRLacra saved.

        The reader builds arrays and plain records only and calls no code from the pickle, so a
        file from an untrusted source does no harm. States become channels; if no states were
        saved, observations do. Applied actions become actions; if none were saved, the commanded
        ones do.

        Args:
            path: A ``.pkl`` file.
            names: New names for names in the file, e.g. ``{"theta": "arm_angle"}``.

        Raises:
            DataError: The file is damaged, holds no rollouts, or would run code.

        References:
            F. Muratore, SimuRLacra, https://github.com/famura/SimuRLacra (class ``StepSequence``).
        """
        from npdr_ppl.rollouts.io.simurlacra import read_simurlacra

        return cls.of(read_simurlacra(path, names))

    @classmethod
    def load(
        cls,
        path: Path | Sequence[Path],
        mapping: "LogMapping | dict[str, Any] | Path | None" = None,
    ) -> "Rollouts":
        """Reads rollouts from files or folders.

        Without a mapping, ``.csv``, ``.parquet``, ``.npz`` and ``.nc`` files have the layout of
        this class. With one, the path is a log of any format that robots write; see
        :func:`npdr_ppl.rollouts.logs.read_log`. LeRobot data sets need no mapping: components of
        ``observation.state`` are channels, those of ``action`` are actions.

        Args:
            path: The file or folder, or several with the same columns, one after another. Of
                different rates, all get the time step of the fastest; measurements keep their
                times.
            mapping: Which signals of the log are channels and actions: a TOML file as written by
                ``npdr inspect``, a dictionary with its content, or a ``Mapping``.

        Raises:
            DataError: The format is unknown, the file cannot be read, or a log has no mapping.
            DependencyError: A log needs a package that is not installed.
        """
        from npdr_ppl.rollouts.logs.load_logs import recording_of_logs

        paths = [path] if isinstance(path, str | PathLike) else path
        if not isinstance(paths, Sequence) or not all(
            isinstance(part, str | PathLike) for part in paths
        ):
            raise DataError(
                "Rollouts.load takes a path or a list of paths, not "
                f"{rollout_checks.shown(path, 100)}."
            )
        return cls.of(recording_of_logs(paths, mapping))

    @classmethod
    def from_dataframe(
        cls, frame: "pd.DataFrame", mapping: "LogMapping | dict[str, Any] | Path | None" = None
    ) -> "Rollouts":
        """Makes rollouts of a pandas data frame.

        Args:
            frame: One row per time stamp; a value that was not recorded is NaN. A column or the
                index holds the time.
            mapping: Which columns are channels and actions, as for :meth:`load`; ``None`` for the
                columns of :meth:`from_csv`.

        Raises:
            DataError: A column is missing or has no numbers.
        """
        from npdr_ppl.rollouts.logs.load_logs import recording_of_frame

        return cls.of(recording_of_frame(frame, mapping))

    # -- Export ------------------------------------------------------------------------------

    def to_csv(self, path: Path) -> None:
        """Writes the CSV layout of :meth:`from_csv`; numbers stay exact, units are not written."""
        from npdr_ppl.rollouts.io.csv_files import write_csv

        write_csv(self, path)

    def to_parquet(self, path: Path) -> None:
        """Writes the columns of :meth:`from_csv`; metadata hold units, time step and actions."""
        from npdr_ppl.rollouts.io.file_formats import write_parquet

        write_parquet(self, path)

    def to_npz(self, path: Path) -> None:
        """Writes zero-padded arrays ``(R, T + 1, C)`` and so on, with names, units and lengths."""
        from npdr_ppl.rollouts.io.file_formats import write_npz

        write_npz(self, path)

    def to_netcdf(self, path: Path) -> None:
        """Writes the data set of :meth:`to_xarray` as NetCDF4."""
        from npdr_ppl.rollouts.io.file_formats import write_netcdf

        write_netcdf(self, path)

    def to_xarray(self) -> "xr.Dataset":
        """Returns a data set with one variable ``(rollout, step)`` per column, padded with NaN.

        Each variable has the attributes ``kind`` (``channel``, ``action`` or ``reward``) and
        ``units``; ``num_steps`` holds the length of each rollout.
        """
        from npdr_ppl.rollouts.io.file_formats import to_xarray

        return to_xarray(self)

    def stacked(self) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Returns measurements ``(R, T + 1, C)``, actions ``(R, T, A)`` and mask ``(R, T)``.

        T is the length of the longest rollout; shorter ones are zero-padded where the mask is
        false.
        """
        return collection.stacked(self)

    # -- As a collection ---------------------------------------------------------------------

    def __iter__(self) -> Iterator["Rollouts"]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: indices.Index) -> "Rollouts":
        """Returns the chosen rollouts, always as Rollouts."""
        return collection.picked(self, indices.chosen(index, len(self)))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Rollouts):
            return NotImplemented
        return collection.are_equal(self, other)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return collection.summary(self)

    def _repr_html_(self) -> str:
        from npdr_ppl.rollouts.rollouts_view import rollouts_html

        return rollouts_html(self)

    def plot(self, axes: Any = None) -> NDArray[Any]:
        """Plots every channel and action over time, with all rollouts in the same axes.

        Args:
            axes: Axes to draw on, one per channel and action; ``None`` makes a figure.

        Returns:
            The axes, ``(channels + actions,)``.
        """
        from npdr_ppl.rollouts.rollouts_view import plot_rollouts

        return plot_rollouts(self, axes)

    def split(
        self,
        train: Sequence[int] | float,
        test: Sequence[int] | None = None,
        *,
        seed: int | None = None,
    ) -> tuple["Rollouts", "Rollouts"]:
        """Splits by rollout, never by sample: samples of one rollout are not independent.

        Args:
            train: Indices of the training rollouts, or their fraction, which is rounded so that
                both sets get at least one.
            test: Indices of the test rollouts; all others if left out.
            seed: Seed to shuffle with before a fractional split; without it, the first rollouts
                are the training set.

        Returns:
            Training and test rollouts.

        Raises:
            DataError: A set is empty, or a rollout is in both sets.
        """
        left, right = indices.split(len(self), train, test, seed)
        return self[left], self[right]

    def concatenate(self, *others: "Rollouts") -> "Rollouts":
        """Returns these rollouts followed by others with the same columns.

        If rates differ, all get the smallest time step; measurements keep their own times.

        Raises:
            DataError: Columns differ.
        """
        parts = [Rollouts.of(part) for part in at_one_rate((self, *others))]
        return collection.joined(parts)

    def select(self, channels: Sequence[str]) -> "Rollouts":
        """Returns the rollouts with only these channels, in this order."""
        return collection.with_channels(self, channels)

    # -- For inference -----------------------------------------------------------------------

    def check(
        self,
        channels: Sequence[Channel] = (),
        actions: Sequence[Channel] = (),
        *,
        allow_extra: bool = False,
        strict: bool = True,
    ) -> None:
        """Checks that the data fit a simulator: columns, units and no duplicate rollouts.

        Args:
            channels: The simulator's state or sensor channels.
            actions: The simulator's actions.
            allow_extra: Accept channels that the simulator does not have.
            strict: Refuse values that hint at wrong units or signs, and duplicates, too. Without
                it, only columns and declared units are checked.

        Raises:
            DataError: A check failed; the message says which in one sentence.
        """
        if strict:
            simulator_checks.check_duplicates(self)
        if channels or actions:
            simulator_checks.check_channels(self, channels, actions, allow_extra=allow_extra)
            simulator_checks.check_declared_units(self, (*channels, *actions))
            if strict:
                simulator_checks.check_units(self, (*channels, *actions))

    def inputs(
        self,
        segment_length: int | None = None,
        initial_state: segments.InitialState = "estimated",
        *,
        history: int | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> Inputs:
        """Returns the inputs with which a simulator replays these rollouts.

        Args:
            segment_length: Steps after which the simulation is re-synchronised with the data;
                ``None`` for whole rollouts. The last segment of a rollout may be shorter.
            initial_state: ``"estimated"`` smooths and differentiates the measurements around each
                segment's start; ``"recorded"`` takes the measurements as exact; ``"uncertain"``
                draws the initial state of every simulation from the estimate and its error.
            history: Steps of commands before each segment to include, for delays, lags and goals
                of servos; by default those of five seconds, if they take little memory.
            dtype: Floating-point type of the tensors.

        Raises:
            DataError: An argument is out of range.
        """
        return segments.inputs(
            self,
            segment_length=segment_length,
            initial_state=initial_state,
            history=history,
            dtype=dtype,
        )

    def observation(
        self, inputs: Inputs | int | None = None, channels: Sequence[str] | None = None
    ) -> Tensor:
        """Returns the measurements after each step, to compare with a simulated trajectory.

        Args:
            inputs: Result of :meth:`inputs`, or a segment length as given to it.
            channels: Names of the wanted channels, in the wanted order; all if ``None``.

        Returns:
            ``(segments, steps, channels)``, zero where ``inputs.mask`` is false.

        Raises:
            DataError: A channel was not recorded.
        """
        return segments.observation(self, inputs, channels)

    def series(self, channels: Sequence[str] | None = None) -> list[Tensor]:
        """Returns the measurements *before* each step, ``(T, C)`` float64 per rollout.

        Unusable stretches are left out. These are the ground truth of the paper's metrics; see
        :func:`segments.stitch`.
        """
        names = self.channel_names if channels is None else tuple(channels)
        columns = segments.columns_of(names, self.channel_names)
        source = [sampling.values for sampling in self.samplings] or self.readings
        return [
            torch.from_numpy(values[rows][:, columns])
            for values, rows in zip(source, self._rows_of_series, strict=True)
        ]

    @property
    def times_of_series(self) -> list[Array]:
        """Time stamps of the rows of :meth:`series` in s, ``(T,)`` per rollout."""
        return [time[rows] for time, rows in zip(self.time, self._rows_of_series, strict=True)]

    @property
    def _rows_of_series(self) -> list[NDArray[np.int64]]:
        """The rows before each step of the usable stretches, per rollout."""
        return [
            np.concatenate([np.arange(first, end) for first, end in ((0, 0), *spans)])
            for spans in self.spans
        ]
