"""Reports in a browser: charts are drawn, nothing is complained of, cut off or overlapping.

A Chromium is looked for in ``NPDR_CHROMIUM``, where ``.ci/install_chromium`` puts it, where
Playwright puts its own, and on the path.
"""

import os
import shutil
from pathlib import Path

import pytest

from npdr_ppl.display.reports import write_report, write_runs_report
from tests.helpers.arm_discovery import write_arm_discovery
from tests.helpers.page_layout import UNFOLD, layout_faults

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

INSTALLED = Path(__file__).parents[2] / ".venv" / "chromium"
ON_PATH = ("chromium", "chromium-browser", "google-chrome")
KINDS = ("fit", "compare", "train", "discover", "arm", "several")
WIDTHS = (320, 390, 768, 1280)
"""CSS pixels of a small phone, a phone, a tablet and a laptop."""

SHEET = 680
"""Width in CSS pixels of an A4 page between margins of 15 mm."""

DRAWN = """() => {
  const charts = [...document.querySelectorAll("[data-chart]")];
  const isDrawn = (chart) => chart.querySelector(".cartesianlayer :is(.trace, .hm)");
  const curves = document.querySelectorAll(".npdr .track, .npdr path").length;
  return (charts.length > 0 || curves > 0) && charts.every(isDrawn);
}"""


def find_chromium(own):
    """Returns the browser's path, or None."""
    candidates = [os.environ.get("NPDR_CHROMIUM"), INSTALLED / "chromium", own]
    candidates += [shutil.which(name) for name in ON_PATH]
    return next((str(path) for path in candidates if path and Path(path).is_file()), None)


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        path = find_chromium(playwright.chromium.executable_path)
        if path is None:
            pytest.skip("there is no Chromium; .ci/install_chromium gets one")
        libraries = [str(INSTALLED / "lib"), os.environ.get("LD_LIBRARY_PATH", "")]
        chromium = playwright.chromium.launch(
            executable_path=path,
            args=["--no-sandbox", "--headless=shell", "--disable-gpu"],
            env={**os.environ, "LD_LIBRARY_PATH": ":".join(filter(None, libraries))},
        )
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def pages(runs, tmp_path_factory):
    """The written files by kind."""
    folder = tmp_path_factory.mktemp("pages")
    write_arm_discovery(folder / "arm")
    every = {**runs, "arm": folder / "arm"}
    found = {kind: write_report(run, folder / f"{kind}.html") for kind, run in every.items()}
    again = folder / "the_same_arm_measured_again_on_a_tuesday_evening"
    write_arm_discovery(again)
    several = [folder / "arm", again, runs["fit"]]
    return found | {"several": write_runs_report(several, folder / "several.html")}


@pytest.fixture
def opened(browser, pages):
    """Opens a page, and fails if the browser complains or asks the network for anything."""
    complaints, requests, made = [], [], []

    def open_page(kind):
        page = browser.new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        page.goto(pages[kind].as_uri())
        page.wait_for_function(DRAWN, timeout=15_000)
        made.append(page)
        return page

    yield open_page
    for page in made:
        page.close()
    assert not complaints
    assert all(url.startswith(("file:", "data:", "blob:")) for url in requests), requests


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_cut_off_at_any_width(opened, kind):
    page = opened(kind)
    found = []
    for is_open in (False, True):
        if is_open:
            page.evaluate(UNFOLD)
        for width in WIDTHS:
            page.set_viewport_size({"width": width, "height": 800})
            for scheme, paper in (("light", "rgb(255, 255, 255)"), ("dark", "rgb(13, 17, 23)")):
                page.emulate_media(color_scheme=scheme)
                page.wait_for_timeout(150)  # Plotly draws again.
                shown = page.evaluate("getComputedStyle(document.body).backgroundColor")
                assert shown == paper
                found += [(width, scheme, is_open, fault) for fault in layout_faults(page)]
    assert not found


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_printed_page_is_white_and_fits_the_sheet(opened, kind):
    page = opened(kind)
    page.evaluate(UNFOLD)
    page.set_viewport_size({"width": SHEET, "height": 960})
    page.emulate_media(media="print", color_scheme="dark")
    page.wait_for_timeout(300)
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert not layout_faults(page, paper=SHEET)
    assert page.pdf(format="A4").startswith(b"%PDF")


@pytest.mark.slow
def test_the_first_screen_has_verdict_curves_and_gap(opened):
    page = opened("arm")
    page.set_viewport_size({"width": 1280, "height": 800})
    for selector in (".verdict", ".lead svg path.revised", ".lead .gaps"):
        box = page.locator(selector).first.bounding_box()
        assert box["y"] + box["height"] <= 800


@pytest.mark.slow
def test_a_link_to_a_folded_section_unfolds_it(opened):
    page = opened("arm")
    page.get_by_role("link", name="Provenance").click()
    assert (
        page.locator("section:has(h2:text-is('Provenance')) details").get_attribute("open") == ""
    )


@pytest.mark.slow
def test_the_check_finds_faults(opened):
    page = opened("arm")
    page.set_viewport_size({"width": 390, "height": 800})
    page.add_style_tag(content="td { white-space: nowrap; width: 3rem; overflow: hidden; }")
    page.evaluate(UNFOLD)
    assert any("hides" in fault for fault in layout_faults(page))
