"""The website: built without a warning, opened from disk, readable at every width, searchable."""

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from report_layout import WIDTHS, chromium

pytest.importorskip("sphinx", reason="the extra docs is not installed; `make docs` installs it")

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
RESOURCE = re.compile(r"<(?:link|script|img|source)\b[^>]*?(?:href|src)=\"([^\"]+)\"")
STYLE_RESOURCE = re.compile(r"url\(\s*['\"]?([^'\")]+)|@import\s+['\"]([^'\"]+)")

CUT_OFF = """() => {
  const hides = (e) => getComputedStyle(e).overflowX !== "visible"
    && e.scrollWidth > e.clientWidth + 1 && e.tagName !== "PRE";
  const faults = [...document.querySelectorAll("article *")].filter(hides).map((e) => e.className);
  if (document.documentElement.scrollWidth > innerWidth) faults.push("the page");
  return faults;
}"""
"""Names what is wider than its place; long lines of code may be scrolled."""

SOME_PAGE = "take_it_home.html"


def build(docs, site):
    """Builds the site as `make docs` does; returns its process."""
    command = ["-m", "sphinx", "--quiet", "--fail-on-warning", "--keep-going"]
    return subprocess.run(
        [sys.executable, *command, str(docs), str(site)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    done = build(DOCS, folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def browser():
    pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with chromium() as found:
        if found is None:
            pytest.skip("there is no Chromium; .ci/install_chromium gets one")
        yield found


@pytest.fixture
def page(browser):
    """A page of the browser, which must not complain or ask the network for anything."""
    complaints, requests = [], []
    page = browser.new_page()
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    yield page
    page.close()
    assert not complaints
    assert all(url.startswith(("file:", "data:")) for url in requests), requests


@pytest.mark.slow
def test_the_site_fetches_nothing_from_elsewhere(site):
    for path in site.rglob("*.html"):
        for found in RESOURCE.findall(path.read_text()):
            assert "//" not in found, f"{path.name} refers to {found}"
    for path in site.rglob("*.css"):
        for found in STYLE_RESOURCE.findall(path.read_text()):
            assert not "".join(found).startswith(("http", "//")), f"{path.name}: {found}"


@pytest.mark.slow
def test_the_navigation_has_every_page_in_its_order(site):
    sections = tomllib.loads((DOCS / "navigation.toml").read_text())["section"]
    side = (site / "index.html").read_text().partition('class="sidebar-tree"')[2]
    links = re.findall(
        r'class="reference internal" href="([^"#]+)"', side.partition("</aside>")[0]
    )
    below = [name for s in sections if "below" in s for _, name in s["pages"]]
    listed = [name for s in sections if "below" not in s for _, name in s["pages"]]
    shown = [link.replace(".html", ".md") for link in links]
    assert [link for link in shown if link not in below] == listed
    assert [link for link in shown if link in below] == below


@pytest.mark.slow
@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_is_cut_off(site, page, width):
    page.set_viewport_size({"width": width, "height": 900})
    faults = {}
    for path in sorted(site.rglob("*.html")):
        page.goto(path.as_uri())
        found = page.evaluate(CUT_OFF)
        if found:
            faults[path.name] = found
    assert not faults


@pytest.mark.slow
def test_a_page_has_the_readers_colours(site, page):
    shades = []
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        page.goto((site / SOME_PAGE).as_uri())
        shade = page.evaluate("getComputedStyle(document.body).backgroundColor")
        shades.append(sum(int(part) for part in re.findall(r"\d+", shade)[:3]))
    light, dark = shades
    assert light > 3 * 240
    assert dark < 3 * 40


@pytest.mark.slow
def test_a_search_from_disk_finds_the_page(site, page):
    page.goto((site / "search.html").as_uri() + "?q=randomisation")
    results = page.locator("#search-results li a")
    results.first.wait_for(timeout=15_000)
    assert any(SOME_PAGE in (link.get_attribute("href") or "") for link in results.all())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "warning"),
    [
        ("[gone](gone.md)", "gone.md"),
        ("[place](index.md#gone)", "gone"),
        ("{py:meth}`npdr_ppl.errors.DataError.gone`", "DataError.gone"),
        ("{py:class}`npdr_ppl.errors.DataError`", None),
    ],
)
def test_a_wrong_link_or_name_is_an_error(tmp_path, text, warning):
    docs = tmp_path / "docs"
    docs.mkdir()
    shutil.copy(DOCS / "conf.py", docs)
    shutil.copytree(DOCS / "website", docs / "website")
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (docs / "navigation.toml").write_text('[[section]]\ntitle = "A"\npages = [["B", "page.md"]]\n')
    (docs / "index.md").write_text("# A title\n")
    (docs / "page.md").write_text(f"# A page\n\n{text}\n")
    done = build(docs, tmp_path / "site")
    if warning is None:
        assert done.returncode == 0, done.stderr
    else:
        assert done.returncode != 0
        assert warning in done.stderr
