"""The part of a Python file that a name needs runs by itself and has nothing else."""

from npdr_ppl.excerpts import bound_names, excerpt, import_lines

FILE = '''"""A file."""

from __future__ import annotations

import math
import os.path, json
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from decimal import Decimal

# How steep it is.
# In 1/m.
SLOPE = 2.0
"""A docstring."""
TABLE = [1]
TABLE.append(2)
for number in (3, 4):
    if number > 3:
        TABLE.append(number)
UNUSED = os.path.join("a", "b")

try:
    from cmath import tau
except ImportError:
    tau = 6.28


def helper(x: Decimal) -> Any:
    return SLOPE * math.pi * x


@staticmethod
def unused():
    return json


class Law:
    kind: ClassVar[str] = "law"

    def force(self, x):
        return helper(x) * sum(TABLE) * tau


print(Law())
if __name__ == "__main__":
    Law().force(1.0)
'''


def text_of(part):
    return "\n".join([*import_lines(set(part.imports)), part.body])


def test_an_excerpt_has_what_a_name_needs_and_no_more():
    part = excerpt(FILE, {"Law"})
    text = text_of(part)
    scope = {}
    exec(text.replace("x: Decimal", "x"), scope)
    assert scope["Law"]().force(1.0) > 0.0 and scope["TABLE"] == [1, 2, 4]
    assert part.futures == ("annotations",)
    assert '# How steep it is.\n# In 1/m.\nSLOPE = 2.0\n"""A docstring."""\n' in text
    for other in ("UNUSED", "unused", "json", "print", "__main__", "os"):
        assert other not in text
    assert {"Law", "helper", "SLOPE", "TABLE", "math", "Any"} <= set(part.bound)


def test_names_collide_if_they_mean_something_else():
    part = excerpt(FILE, {"helper"})
    assert not part.collides_with({"math": "import math", "other": "x"})
    assert not part.collides_with(bound_names(FILE))
    assert part.collides_with(bound_names("import cmath as math"))
    assert part.collides_with(bound_names("SLOPE = 3.0"))
    # Both bind the package itself.
    assert bound_names("import a.b") == bound_names("import a.c") == {"a": "import a"}


def test_imports_are_merged():
    lines = {"from a import c", "from a import b", "import z.y", "import m as n"}
    assert import_lines(lines) == ["import m as n", "import z.y", "from a import b, c"]
    (wrapped,) = import_lines({f"from a import name_{k:02}" for k in range(20)})
    assert max(map(len, wrapped.splitlines())) <= 99 and compile(wrapped, "x", "exec")
