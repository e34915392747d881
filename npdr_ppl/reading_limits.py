"""How much a file may cost: limits that every reader checks before it allocates memory.

A small file can describe a huge array. Each reader therefore compares the shapes, sizes and counts
that a file states with these limits before it reads the data.
"""

from dataclasses import dataclass

from npdr_ppl.errors import DataError
from npdr_ppl.settings import check_range

__all__ = ["LIMITS", "ReadingLimits", "check_expansion"]


@dataclass(frozen=True)
class ReadingLimits:
    """Limits for one file.

    Attributes:
        file_bytes: Largest file in bytes; an hour at 1 kHz with ten channels takes less.
        numbers: Largest count of numbers in a file; as float64 they take 0.8 GB.
        free_bytes: Bytes in memory that any file may describe: 10⁶ samples of eight columns, or a
            texture of 4096 × 4096 pixels.
        expansion: Bytes in memory per byte of the file that a larger recording may describe.
            Compression of measured data gains a factor of about two, that of a bomb a thousand.
        columns: Largest count of columns; robots have tens of channels.
        rollouts: Largest count of rollouts; each costs about 0.1 ms to check.
        line_length: Longest row of a CSV file in characters; ``columns`` numbers of 25
            characters take a tenth of it.
        blank_lines: Largest count of blank lines of a CSV file beyond one for each row. Some
            programs on Windows write one after each row.
        text_bytes: Longest text beside the data, such as attributes, names and footers, in bytes;
            ours have less than a tenth of it.
        json_bytes: Largest JSON file or text of a run in bytes; policies with many parameters take
            2 MB.
        json_values: Largest count of keys and values of such a JSON file.
        parts: Largest count of parts of a file, such as data sets or chunks; posteriors
            have hundreds of data sets.
        robot_parts: Largest count of elements of a robot's description, with all repetitions;
            large robots have a thousand.
        robot_attributes: Largest count of attributes of a robot's description; ten for each of
            ``robot_parts`` are less than half of it.
        depth: Deepest nesting of parts; our files are nested three times, robots' bodies thirty.
        instructions: Largest count of instructions of a pickle; a rollout has a thousand.
    """

    file_bytes: int = 2**30
    numbers: int = 10**8
    free_bytes: int = 2**26
    expansion: int = 20
    columns: int = 1_000
    rollouts: int = 10_000
    line_length: int = 2**18
    blank_lines: int = 100_000
    text_bytes: int = 2**20
    json_bytes: int = 2**23
    json_values: int = 200_000
    parts: int = 10_000
    robot_parts: int = 4_000
    robot_attributes: int = 100_000
    depth: int = 200
    instructions: int = 1_000_000

    def __post_init__(self) -> None:
        check_range(self, 1, 2**40, "file_bytes", "free_bytes", "line_length", "text_bytes")
        check_range(self, 1, 2**30, "json_bytes", "json_values")
        check_range(
            self,
            1,
            10**10,
            "numbers",
            "columns",
            "rollouts",
            "blank_lines",
            "parts",
            "robot_parts",
            "robot_attributes",
            "instructions",
        )
        check_range(self, 1, 1_000, "expansion", "depth")


LIMITS = ReadingLimits()
"""The limits that all readers use."""


def check_expansion(described_bytes: float, file_bytes: int) -> None:
    """Checks the memory that a file's content needs, before it is read.

    Args:
        described_bytes: Bytes that the content takes in memory, as the file states it.
        file_bytes: Size of the file in bytes.

    Raises:
        DataError: The content is too large, or much larger than the file.
    """
    allowed = min(8 * LIMITS.numbers, max(LIMITS.free_bytes, LIMITS.expansion * file_bytes))
    if described_bytes > allowed:
        raise DataError(
            f"its content takes {described_bytes / 1e6:.4g} MB in memory, more than the "
            f"{allowed / 1e6:.0f} MB that are read from a file of {file_bytes / 1e6:.2g} MB."
        )
