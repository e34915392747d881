"""What SECURITY.md promises is tested: the tests that it names exist."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "SECURITY.md").read_text()


def promises():
    """Paragraphs, table rows and list items of the chapter about files."""
    chapter = TEXT.split("## What is loaded from disk, and how")[1].split("\n## ")[0]
    rows = [line for line in chapter.splitlines() if line.startswith("| ")][1:]
    items = re.findall(r"^\* .*?(?=^\* |\Z)", chapter, re.DOTALL | re.MULTILINE)
    return rows + items


def test_the_named_files_exist():
    named = re.findall(r"`((?:tests|docs|npdr_ppl)/[\w/]+\.\w+)`", TEXT)
    assert len(named) > 15
    assert not [name for name in named if not (ROOT / name).is_file()]


def test_every_promise_about_files_names_a_test():
    found = promises()
    assert len(found) >= 9
    assert all(re.search(r"`tests/[\w/]+\.py`", promise) for promise in found)
