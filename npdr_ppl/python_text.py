"""Texts as parts of Python code that is written, so that none of them can become code.

Names of joints, channels and files are those of files that may come from anywhere.
"""

import json
import re

__all__ = ["plain", "quoted"]


def plain(text: str) -> str:
    """Returns a text for comments and docstrings: on one line, and without quotes."""
    return " ".join(re.sub(r'["\\]', "'", text).split())


def quoted(name: str | int) -> str:
    """Returns a name as Python."""
    return json.dumps(name, ensure_ascii=False)
