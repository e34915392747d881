"""What SECURITY.md promises is tested: the tests that it names exist."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "SECURITY.md").read_text()


def promises():
    """Table rows and list items of all chapters but the last, which asks for reports."""
    chapters = TEXT.split("\n## ")[1:-1]
    rows, items = [], []
    for chapter in chapters:
        rows += [line for line in chapter.splitlines() if line.startswith("| ")][1:]
        items += re.findall(r"^\* .*?(?=^\* |\Z)", chapter, re.DOTALL | re.MULTILINE)
    return rows + items


def test_the_named_files_exist():
    named = re.findall(r"`((?:tests|docs|npdr_ppl)/[\w/]+\.\w+)`", TEXT)
    assert len(named) > 15
    assert not [name for name in named if not (ROOT / name).is_file()]


def test_every_promise_names_a_test():
    found = promises()
    assert len(found) >= 16
    assert all(re.search(r"`tests/[\w/]+\.py`", promise) for promise in found)
