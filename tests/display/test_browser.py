"""Reports in a browser: charts are drawn, nothing is complained of, cut off or overlapping."""

import pytest
from report_layout import SHEET, UNFOLD, WIDTHS, all_faults, chromium, layout_faults

from npdr_ppl.display.reports import write_report, write_runs_report
from tests.helpers.arm_discovery import write_arm_discovery

pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

KINDS = ("fit", "compare", "train", "discover", "arm", "several")

SMALL = 320
"""CSS pixels of a small phone."""

DRAWN = """() => {
  const charts = [...document.querySelectorAll("[data-chart]")];
  const isDrawn = (chart) => chart.querySelector(".cartesianlayer :is(.trace, .hm)");
  const curves = document.querySelectorAll(".npdr .track, .npdr path").length;
  return (charts.length > 0 || curves > 0) && charts.every(isDrawn);
}"""


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        if found is None:
            pytest.skip("there is no Chromium; .ci/install_chromium gets one")
        yield found


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
def test_nothing_is_cut_off_at_any_width_or_on_paper(opened, kind):
    assert not all_faults(opened(kind), (SMALL, *WIDTHS))


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_page_has_the_readers_colours_and_prints_on_white(opened, scheme):
    page = opened("fit")
    shade = "getComputedStyle(document.body).backgroundColor"
    page.emulate_media(color_scheme=scheme)
    assert page.evaluate(shade) == (
        "rgb(13, 17, 23)" if scheme == "dark" else "rgb(255, 255, 255)"
    )
    page.emulate_media(media="print", color_scheme=scheme)
    page.wait_for_timeout(300)  # Plotly draws again.
    assert page.evaluate(shade) == "rgb(255, 255, 255)"
    ink = page.locator("[data-chart] .xtick text").first.evaluate("e => getComputedStyle(e).fill")
    assert ink == "rgb(27, 31, 36)", "the chart's text is black on paper"
    assert page.pdf(format="A4", width=f"{SHEET}px").startswith(b"%PDF")


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
    section = "section:has(h2:text-is('Provenance'))"
    page.wait_for_selector(f"{section} details[open]", timeout=5000)  # milliseconds


@pytest.mark.slow
def test_the_check_finds_faults(opened):
    page = opened("arm")
    page.set_viewport_size({"width": 390, "height": 800})
    page.add_style_tag(content="td { white-space: nowrap; width: 3rem; overflow: hidden; }")
    page.evaluate(UNFOLD)
    assert any("hides" in fault for fault in layout_faults(page))
