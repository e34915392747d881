"""The part of a Python file that some of its names need, to be copied into another file.

Names and other texts of a user's file become part of such files only by :func:`quoted` and
:func:`plain`.

A file is split into its top-level statements. Those that define a needed name, and the names that
these use in turn, are kept in their order; imports are kept apart, so that they can be merged.
"""

import ast
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

__all__ = ["Excerpt", "bound_names", "excerpt", "import_lines"]

_DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)

_WIDTH = 99
"""Longest line of imports, in characters; the same as in this project."""


@dataclass(frozen=True)
class Excerpt:
    """Part of a Python file.

    Attributes:
        imports: The imports, one name each, e.g. ``"from typing import Any"``.
        futures: Names imported from ``__future__``.
        body: All other statements.
        bound: The names that it defines, with the text of what each is bound to.
    """

    imports: tuple[str, ...] = ()
    futures: tuple[str, ...] = ()
    body: str = ""
    bound: Mapping[str, str] = field(default_factory=dict)

    def collides_with(self, bound: Mapping[str, str]) -> bool:
        """Returns whether it binds one of other names to something else."""
        return any(bound.get(name, text) != text for name, text in self.bound.items())


def bound_names(text: str) -> dict[str, str]:
    """Returns the top-level names of a Python file, with the text of what each is bound to."""
    bound: dict[str, str] = {}
    for statement in ast.parse(text).body:
        for name, what in _binds(statement, text):
            bound[name] = f"{bound[name]}\n{what}" if bound.get(name, what) != what else what
    return bound


def excerpt(text: str, names: set[str]) -> Excerpt:
    """Returns the part of a Python file that names need.

    Statements that only have effects, such as calls, are left out unless they change a needed
    name, as ``TABLE.append(1)`` does; so is what only runs in a program.

    Args:
        text: The file's text.
        names: Some of its top-level names.
    """
    statements = [s for s in ast.parse(text).body if not _is_program(s)]
    kept = _needed(statements, text, names)
    is_used = {name for s in statements if s in kept for name in _uses(s)} | names
    imports: dict[str, None] = {}
    futures: list[str] = []
    bound: dict[str, str] = {}
    body: list[ast.stmt] = []
    for statement in statements:
        if isinstance(statement, ast.ImportFrom) and statement.module == "__future__":
            futures += [alias.name for alias in statement.names]
        elif statement in kept:
            own = dict(_binds(statement, text))
            lines = _imports(statement)
            if lines:
                used = {name for name in own if name in is_used or name == "*"}
                imports |= {line: None for name, line in lines if name in used}
                own = {name: own[name] for name in used}
            else:
                body.append(statement)
            bound |= own
        elif body and _is_docstring_of(statement, body[-1]):
            body.append(statement)
    return Excerpt(tuple(imports), tuple(futures), _joined(body, text), bound)


def import_lines(imports: set[str]) -> list[str]:
    """Returns import statements in alphabetical order, those from one module in one statement.

    Args:
        imports: Statements that import one name each.
    """
    whole = sorted(line for line in imports if line.startswith("import "))
    names: dict[str, list[str]] = {}
    for line in sorted(imports - set(whole)):
        module, _, name = line.partition(" import ")
        names.setdefault(module, []).append(name)
    lines = []
    for module, found in names.items():
        line = f"{module} import {', '.join(found)}"
        if len(line) > _WIDTH:
            line = "\n".join([f"{module} import (", *(f"    {name}," for name in found), ")"])
        lines.append(line)
    return [*whole, *lines]


def _needed(statements: list[ast.stmt], text: str, names: set[str]) -> set[ast.stmt]:
    """Returns the statements that define names, and what these use in turn."""
    imported = {name for s in statements for name, _ in _imports(s)}
    needed, kept = set(names), set()
    grows = True
    while grows:
        grows = False
        for statement in set(statements) - kept:
            bound = {name for name, _ in _binds(statement, text)}
            changed = _changes(statement) - imported
            if needed & (bound | changed) or "*" in bound:
                kept.add(statement)
                if not _imports(statement):
                    needed |= _uses(statement)
                grows = True
    return kept


def _imports(statement: ast.stmt) -> list[tuple[str, str]]:
    """Returns the names that an import binds, each with the statement that imports only it."""
    if not isinstance(statement, ast.Import | ast.ImportFrom):
        return []
    found = []
    for alias in statement.names:
        renamed = f" as {alias.asname}" if alias.asname else ""
        line = f"import {alias.name}{renamed}"
        if isinstance(statement, ast.ImportFrom):
            line = f"from {'.' * statement.level}{statement.module or ''} {line}"
            found.append((alias.asname or alias.name, line))
        else:
            found.append((alias.asname or alias.name.partition(".")[0], line))
    return found


def _binds(statement: ast.stmt, text: str) -> Iterator[tuple[str, str]]:
    """Returns the names that a top-level statement binds, each with what it is bound to."""
    if isinstance(statement, ast.Import | ast.ImportFrom):
        for name, line in _imports(statement):
            # `import a.b` and `import a.c` both bind the package a.
            yield name, line if line.startswith("from") or " as " in line else f"import {name}"
        return
    source = ast.get_source_segment(text, statement) or ""
    if isinstance(statement, _DEFINITIONS):
        yield statement.name, source
        return
    for node in ast.walk(statement):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, source
        elif isinstance(node, _DEFINITIONS):
            yield node.name, source
        elif isinstance(node, ast.Import | ast.ImportFrom):
            for name, _ in _imports(node):
                yield name, source


def _changes(statement: ast.stmt) -> set[str]:
    """Returns the names whose values a top-level statement may change without binding them."""
    if isinstance(statement, _DEFINITIONS):
        return set()
    targets: list[ast.expr] = []
    # A loop, a condition or a context may change a name in any of its own statements.
    for part in ast.walk(statement):
        if isinstance(part, ast.Expr) and isinstance(part.value, ast.Call):
            if isinstance(part.value.func, ast.Attribute):
                targets.append(part.value.func)
        elif isinstance(part, ast.Assign):
            targets += part.targets
        elif isinstance(part, ast.AugAssign | ast.AnnAssign):
            targets.append(part.target)
    roots = set()
    for target in targets:
        while isinstance(target, ast.Attribute | ast.Subscript):
            target = target.value
        if isinstance(target, ast.Name):
            roots.add(target.id)
    return roots


def _uses(statement: ast.stmt) -> set[str]:
    return {
        node.id
        for node in ast.walk(statement)
        if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Store)
    }


def _is_program(statement: ast.stmt) -> bool:
    """Returns whether a statement is that of ``if __name__ == "__main__"``."""
    return isinstance(statement, ast.If) and any(
        isinstance(node, ast.Name) and node.id == "__name__" for node in ast.walk(statement.test)
    )


def _is_docstring_of(statement: ast.stmt, last: ast.stmt) -> bool:
    """Returns whether a statement is a text right below an assignment that is kept."""
    return (
        isinstance(last, ast.Assign | ast.AnnAssign)
        and isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
        and statement.lineno == (last.end_lineno or 0) + 1
    )


def _joined(statements: list[ast.stmt], text: str) -> str:
    """Returns the lines of statements, with the comments above each."""
    lines = text.split("\n")  # as the parser does
    parts: list[str] = []
    last: ast.stmt | None = None
    done = 0
    for statement in statements:
        decorators = getattr(statement, "decorator_list", [])
        first = min([statement.lineno, *(d.lineno for d in decorators)])
        while first - 1 > done and lines[first - 2].startswith("#"):
            first -= 1
        end = statement.end_lineno or first
        if last is not None and first > done + 1:
            is_definition = isinstance(statement, _DEFINITIONS) or isinstance(last, _DEFINITIONS)
            parts += ["", ""] if is_definition else [""]
        parts += lines[max(first - 1, done) : end]
        last, done = statement, max(done, end)
    return "\n".join(parts)
