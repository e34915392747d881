"""What a stranger wants is at most two clicks from the front page of the documentation."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)

TASKS = {
    "five minutes with the demonstration": ("quick_start.md", "make demo"),
    "my robot from MJCF and a log": ("bring_your_simulator.md", "MJCF file alone"),
    "my own simulator": ("bring_your_simulator.md#any-other-engine", "Any other engine"),
    "compare backends": ("backends.md", "npdr compare"),
    "understand the decisions": ("diagnostics.md", "revise the model"),
    "the gallery of real devices": ("gallery/emps.md", "npdr discover emps"),
    "write an effect or a backend": ("extend.md#an-effect", "## An effect"),
    "how it works, and how often it is right": ("discovery_validation.md", "false"),
}
"""Where each task is described, and words that the page must have."""

CLICKS = 2


def anchor(heading):
    """Returns the anchor of a heading, as the site makes it."""
    words = re.sub(r"[^\w\s-]", "", re.sub(r"[`*]", "", heading)).strip().lower()
    return re.sub(r"[\s-]+", "-", words)


def links(page):
    """Returns the pages, with anchors, that a page links to, and its own headings."""
    text = (DOCS / page).read_text()
    found = set()
    for link in LINK.findall(text):
        name, _, place = link.partition("#")
        if "://" in link or (name and not name.endswith(".md")):
            continue
        target = (DOCS / page).parent / name if name else DOCS / page
        target = target.resolve()
        if target.is_relative_to(DOCS) and target.exists():
            path = target.relative_to(DOCS).as_posix()
            found |= {path, f"{path}#{place}" if place else path}
    return found


def contents(page):
    """Returns the places in a page's own list of headings, which are a click away."""
    return {f"{page}#{anchor(h)}" for h in HEADING.findall((DOCS / page).read_text())}


def reachable(clicks):
    """Returns all places that are at most some clicks from the front page."""
    places = {"index.md"}
    for _ in range(clicks):
        pages = {place.partition("#")[0] for place in places}
        places = places.union(*(links(page) | contents(page) for page in pages))
    return places


@pytest.mark.parametrize("task", TASKS)
def test_a_task_is_two_clicks_away(task):
    place, words = TASKS[task]
    assert place in reachable(CLICKS)
    page, _, heading = place.partition("#")
    assert words in (DOCS / page).read_text()
    assert not heading or place in contents(page), "the heading exists"


def test_every_link_of_the_front_page_leads_somewhere():
    text = (DOCS / "index.md").read_text()
    for link in LINK.findall(text):
        name, _, heading = link.partition("#")
        assert (DOCS / name).exists(), link
        assert not heading or link in contents(name), link
