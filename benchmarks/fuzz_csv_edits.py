"""Damages CSV files in the ways that files get damaged, and any file byte by byte.

Bytes, cells, rows, headers, delimiters, quoting, encodings, line ends and odd numbers are changed.
"""

import csv
import io
import random
from collections.abc import Callable

NUMBERS = (
    *("nan", "NaN", "inf", "-inf", "Infinity", "1e999", "-1e999", "1e308", "1e-400", "5e-324"),
    *("1_000", "1,5", "1.5.2", "--1", "+-1", "1e", "e5", ".", "-", "+", "1e+", "1e5e5", "0x1p3"),
    *("0" * 400, "9" * 400, "0." + "3" * 5000, "1" + "0" * 4300, "1e00000000000001", "1d5"),
    *("٣٫٤", "１２", "½", "−1", "1 000", "1\u00a0000", "1'000", "$5", "5%", "1j", "0.1f", "0b1"),
    *("true", "None", "NULL", "NA", "#REF!", "=1+1", "12:30", "2021-01-01", "1e-5 m", "🙂"),
    *("", " ", "\t", "\x00", "\x1a", "\ufeff1", "\u200b1", "1\u2028", "\ud7ff"),
    *("-0", "-0.0", "007", "1.", ".5", "1E3"),
)

NAMES = (
    *("", " ", "rollout", "time", "reward", "step", "x", "Time", "ROLLOUT", "time ", "\ufefftime"),
    *("a,b", 'a"b', "a\nb", "θ", "angle [rad]", "1x", "../x", "a/b", "nan", "x" * 3000, "\x00"),
    *("🙂", "__class__"),
)

ENCODINGS = ("utf-16", "utf-16-le", "utf-32", "latin-1", "cp1252", "utf-7", "utf-8-sig", "cp037")

Rows = list[list[str]]
Rng = random.Random


def valid_rows(rng: Rng) -> Rows:
    """Returns a small valid file as cells."""
    channels, actions = rng.randint(1, 3), rng.randint(0, 2)
    header = ["rollout", "time", *(f"x{i}" for i in range(channels))]
    header += [f"u{i}" for i in range(actions)]
    if rng.random() < 0.2:
        header.append("reward")
    time_step = rng.choice((0.1, 0.002, 0.004, 1 / 3))
    rows = [header]
    for rollout in range(rng.randint(1, 3)):
        steps = rng.randint(1, 8)
        for k in range(steps + 1):
            cells = [str(rollout), repr(k * time_step)]
            cells += [repr(rng.gauss(0, 1)) for _ in range(channels)]
            ending = len(header) - len(cells)
            cells += [repr(rng.gauss(0, 1)) if k < steps else "" for _ in range(ending)]
            rows.append(cells)
    return rows


def _cell(rng: Rng, rows: Rows) -> tuple[int, int]:
    row = rng.randrange(len(rows))
    return row, rng.randrange(len(rows[row])) if rows[row] else 0


def replace_cell(rng: Rng, rows: Rows) -> None:
    row, column = _cell(rng, rows)
    if rows[row]:
        rows[row][column] = rng.choice(NUMBERS)


def perturb_number(rng: Rng, rows: Rows) -> None:
    row, column = _cell(rng, rows)
    if rows[row]:
        text = list(rows[row][column])
        at = rng.randint(0, len(text))
        text[at : at + rng.randint(0, 2)] = rng.choice("0123456789eE+-. _\"',;\t\r\n\x00xNa")
        rows[row][column] = "".join(text)


def rename_column(rng: Rng, rows: Rows) -> None:
    if rows and rows[0]:
        rows[0][rng.randrange(len(rows[0]))] = rng.choice(NAMES)


def drop_column(rng: Rng, rows: Rows) -> None:
    column = rng.randrange(max((len(row) for row in rows), default=1) or 1)
    for row in rows:
        del row[column : column + 1]


def copy_column(rng: Rng, rows: Rows) -> None:
    source, target = _cell(rng, rows)[1], _cell(rng, rows)[1]
    for row in rows:
        if source < len(row):
            row.insert(target, row[source])


def shuffle_columns(rng: Rng, rows: Rows) -> None:
    width = max((len(row) for row in rows), default=0)
    order = rng.sample(range(width), width)
    rows[:] = [[row[i] for i in order if i < len(row)] for row in rows]


def drop_row(rng: Rng, rows: Rows) -> None:
    del rows[rng.randrange(len(rows))]


def copy_row(rng: Rng, rows: Rows) -> None:
    rows.insert(rng.randint(0, len(rows)), list(rng.choice(rows)))


def swap_rows(rng: Rng, rows: Rows) -> None:
    a, b = rng.randrange(len(rows)), rng.randrange(len(rows))
    rows[a], rows[b] = rows[b], rows[a]


def cut_row(rng: Rng, rows: Rows) -> None:
    row, column = _cell(rng, rows)
    del rows[row][column : column + rng.randint(1, 3)]


def lengthen_row(rng: Rng, rows: Rows) -> None:
    rng.choice(rows).extend([rng.choice(("", "1", "x"))] * rng.randint(1, 50))


def fill_last_rows(rng: Rng, rows: Rows) -> None:
    for row in rows:
        row[:] = [cell or rng.choice(("0", "1.5")) for cell in row]


def empty_column(rng: Rng, rows: Rows) -> None:
    column = _cell(rng, rows)[1]
    for row in rows[1:]:
        if column < len(row):
            row[column] = ""


def scale_column(rng: Rng, rows: Rows) -> None:
    column, factor = _cell(rng, rows)[1], rng.choice((57.3, -1.0, 0.0, 1e-320, 1e200, 1e308))
    for row in rows[1:]:
        try:
            row[column] = repr(float(row[column]) * factor)
        except (IndexError, ValueError):
            continue


def insert_blank(rng: Rng, rows: Rows) -> None:
    rows.insert(rng.randint(0, len(rows)), rng.choice(([], [""], ["  "], ["# note"])))


def shift_time(rng: Rng, rows: Rows) -> None:
    offset = rng.choice((1e9, -1e9, 1e18, 1e300, 0.05, -5.0))
    for row in rows[1 + rng.randrange(len(rows)) :]:
        try:
            row[1] = repr(float(row[1]) + offset)
        except (IndexError, ValueError):
            continue


def only_header(rng: Rng, rows: Rows) -> None:
    del rows[1 + rng.randrange(3) :]


def flip_bytes(rng: Rng, data: bytearray) -> None:
    for _ in range(rng.randint(1, 8)):
        if data:
            data[rng.randrange(len(data))] = rng.randrange(256)


def insert_bytes(rng: Rng, data: bytearray) -> None:
    at = rng.randint(0, len(data))
    data[at:at] = rng.randbytes(rng.randint(1, 20))


def truncate(rng: Rng, data: bytearray) -> None:
    del data[rng.randint(0, len(data)) :]


def insert_marks(rng: Rng, data: bytearray) -> None:
    marks = (b"\x00", b"\xef\xbb\xbf", b"\xff\xfe", b"\x1a", b'"', b'""', b"\r", b"\n\r", b"\x0b")
    for _ in range(rng.randint(1, 5)):
        at = rng.randint(0, len(data))
        data[at:at] = rng.choice((*marks, b"\x0c", b"\x85", b"\xe2\x80\xa8", b"\xed\xa0\x80"))


def random_bytes(rng: Rng, data: bytearray) -> None:
    data[:] = rng.randbytes(rng.choice((0, 1, 3, 50, 2000)))


def random_text(rng: Rng, data: bytearray) -> None:
    alphabet = 'rolutime,0123456789.e+-"\r\n;\t '
    data[:] = "".join(rng.choices(alphabet, k=rng.randint(0, 400))).encode()


def repeat(rng: Rng, data: bytearray) -> None:
    data[:] = bytes(data) * rng.randint(2, 4)


def drop_bytes(rng: Rng, data: bytearray) -> None:
    unwanted = rng.choice((b"\n", b",", b".", b"0", b"e"))
    data[:] = bytes(data).replace(unwanted, b"", rng.choice((1, 3, -1)))


ROW_EDITS: tuple[Callable[[Rng, Rows], None], ...] = (
    replace_cell,
    replace_cell,
    perturb_number,
    perturb_number,
    rename_column,
    drop_column,
    copy_column,
    shuffle_columns,
    drop_row,
    copy_row,
    swap_rows,
    cut_row,
    lengthen_row,
    fill_last_rows,
    empty_column,
    scale_column,
    insert_blank,
    shift_time,
    only_header,
)

BYTE_EDITS: tuple[Callable[[Rng, bytearray], None], ...] = (
    flip_bytes,
    insert_bytes,
    truncate,
    insert_marks,
    random_bytes,
    random_text,
    repeat,
    drop_bytes,
)


def malformed(rng: Rng) -> bytes:
    """Returns a valid file with one to four kinds of damage."""
    rows = valid_rows(rng)
    for _ in range(rng.choice((0, 1, 1, 1, 2, 3))):
        if rows:
            rng.choice(ROW_EDITS)(rng, rows)
    text = io.StringIO()
    writer = csv.writer(
        text,
        delimiter=rng.choice("," * 30 + ";\t|"),
        quoting=rng.choice((csv.QUOTE_MINIMAL,) * 8 + (csv.QUOTE_ALL, csv.QUOTE_NONNUMERIC)),
        lineterminator=rng.choice(("\n", "\n", "\n", "\r\n", "\r", "\n\n", "\n\r", "\r\r\n")),
    )
    writer.writerows(rows)
    encoding = rng.choice(ENCODINGS) if rng.random() < 0.05 else "utf-8"
    data = bytearray(text.getvalue().encode(encoding, errors="replace"))
    for _ in range(rng.choice((0, 0, 1, 1, 2))):
        rng.choice(BYTE_EDITS)(rng, data)
    return bytes(data)
