"""Reports in a browser: charts are drawn, nothing is complained of, a phone needs no scrolling.

A Chromium is looked for in ``NPDR_CHROMIUM``, where ``.ci/install_chromium`` puts it, where
Playwright puts its own, and on the path.
"""

import os
import shutil
from pathlib import Path

import pytest

from npdr_ppl.display.reports import write_report

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

INSTALLED = Path(__file__).parents[2] / ".venv" / "chromium"
ON_PATH = ("chromium", "chromium-browser", "google-chrome")
DRAWN = """() => {
  const charts = [...document.querySelectorAll("[data-chart]")];
  const isDrawn = (chart) => chart.querySelector(".cartesianlayer :is(.trace, .hm)");
  return charts.length > 0 && charts.every(isDrawn);
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


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fit", "compare", "train", "discover"])
@pytest.mark.parametrize(("width", "scheme"), [(320, "dark"), (360, "light"), (1200, "dark")])
def test_a_page_is_whole_at_any_width(browser, runs, tmp_path, kind, width, scheme):
    path = write_report(runs[kind], tmp_path / "report.html")
    page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
    complaints, requests = [], []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(path.as_uri())
    page.wait_for_function(DRAWN, timeout=15_000)
    assert not complaints
    assert all(url.startswith(("file:", "data:", "blob:")) for url in requests), requests
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert paper == ("rgb(13, 17, 23)" if scheme == "dark" else "rgb(255, 255, 255)")
    page.close()
