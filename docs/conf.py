"""Settings of the website that ``make docs`` builds from the pages of this folder with Sphinx.

The pages are plain Markdown. What only the website needs is added here: the navigation, from
``navigation.toml``, and the links of the names in docstrings.
"""

import importlib
import tomllib
from pathlib import Path
from typing import Any

from docutils.nodes import Node, TextElement, literal
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.nodes import make_refnode

DOCS = Path(__file__).parent
PROJECT = tomllib.loads((DOCS.parent / "pyproject.toml").read_text())["project"]
SECTIONS = tomllib.loads((DOCS / "navigation.toml").read_text())["section"]
BEFORE_NAPOLEON = 400
"""Sphinx calls functions in the order of their priority, which is 500 if not given."""

project = "npdr_ppl"
version = release = PROJECT["version"]
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
default_role = "literal"
nitpicky = True  # a name in a docstring that nothing has is a warning

myst_heading_anchors = 4
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 80
add_module_names = False
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False

html_theme = "furo"
html_title = f"npdr_ppl {release}"
html_static_path = ["website"]
html_css_files = ["tables.css"]
html_js_files = ["tables.js"]
html_copy_source = False
html_show_sourcelink = False
html_show_search_summary = False  # a page that is opened from disk cannot read others
html_theme_options = {
    "light_css_variables": {"font-stack": "system-ui, sans-serif"},
    "dark_css_variables": {"font-stack": "system-ui, sans-serif"},
}


def navigation(page: str) -> str:
    """Returns the tables of contents that a page gets, in MyST's Markdown.

    Args:
        page: Path below this folder, with ``.md``.
    """
    parts = []
    for section in SECTIONS:
        if section.get("below", "index.md") == page:
            lines = [f"{title} </{name}>" for title, name in section["pages"]]
            parts += ["", "```{toctree}", ":hidden:", f":caption: {section['title']}", "", *lines]
            parts += ["```"]
    return "\n".join(parts) + "\n"


def add_navigation(app: Sphinx, name: str, source: list[str]) -> None:
    """Appends the tables of contents to the pages that have any."""
    source[0] += navigation(f"{name}.md")


def link_name(
    app: Sphinx, environment: BuildEnvironment, reference: pending_xref, shown: TextElement
) -> Node | None:
    """Links a name that Sphinx did not find, or shows it as text; None, a warning, if wrong.

    A class of another module is written in docstrings without its module. Names of signatures are
    types, which the type checker has checked; those that are on no page are text.
    """
    if reference["refdomain"] != "py":
        return None
    if not isinstance(shown, literal):
        return shown
    module, owner = reference.get("py:module"), reference.get("py:class")
    name = reference["reftarget"]
    python = environment.domains.python_domain
    places = python.find_obj(environment, module, owner, name, None, 1)
    if len(places) == 1:
        ((found, place),) = places
        return make_refnode(
            app.builder, reference["refdoc"], place.docname, place.node_id, shown, found
        )
    spellings = [name, f"{module}.{name}", f"{module}.{owner}.{name}"]
    return shown if any(can_be_found(spelling) for spelling in spellings) else None


def can_be_found(name: str) -> bool:
    """Whether Python finds a dotted name: a module, or an attribute of one."""
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:cut]))
        except (ImportError, ValueError):
            continue
        try:
            for part in parts[cut:]:
                fields = getattr(found, "__annotations__", {})
                found = fields[part] if part in fields else getattr(found, part)
        except AttributeError:
            return False
        return True
    return False


def keep_first_line(
    app: Sphinx, kind: str, name: str, found: Any, options: Any, lines: list[str]
) -> None:
    """Begins the docstring of an attribute by an empty line.

    Without it, Napoleon takes the words before a colon in the first line for a type.
    """
    if kind in ("attribute", "data", "property"):
        lines.insert(0, "")


def setup(app: Sphinx) -> dict[str, Any]:
    """Connects the functions above to Sphinx."""
    app.connect("source-read", add_navigation)
    app.connect("missing-reference", link_name)
    app.connect("autodoc-process-docstring", keep_first_line, priority=BEFORE_NAPOLEON)
    return {"parallel_read_safe": True}
