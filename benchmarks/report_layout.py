"""Faults of reports in a browser: what overflows, is cut off or overlaps, and messages.

Opens HTML files in a headless Chromium at three widths, light and dark, folded and unfolded, and
on paper, and prints the number of faults, a line per file:

    python benchmarks/report_layout.py fit/report.html discovery/report.html

A Chromium is looked for in ``NPDR_CHROMIUM``, where ``.ci/install_chromium`` puts it, where
Playwright puts its own, and on the path.
"""

import os
import shutil
import sys
from contextlib import contextmanager
from pathlib import Path

INSTALLED = Path(__file__).parents[1] / ".venv" / "chromium"
ON_PATH = ("chromium", "chromium-browser", "google-chrome")

WIDTHS = (390, 768, 1280)
"""CSS pixels of a phone, a tablet and a laptop."""

SHEET = 680
"""Width in CSS pixels of an A4 page between margins of 15 mm."""

FAULTS = """(paper) => {
  const faults = [];
  const width = paper || document.documentElement.clientWidth;
  const name = (e) => `<${e.tagName.toLowerCase()} class="${e.getAttribute("class") || ""}">`;
  if (document.documentElement.scrollWidth > width) {
    faults.push(`the page is ${document.documentElement.scrollWidth} px wide`);
  }
  const isDrawn = (e) => e.checkVisibility() && !e.closest("script, style, [data-chart]");
  for (const element of document.body.querySelectorAll("*")) {
    if (!isDrawn(element) || element.closest("svg")) continue;
    const hides = getComputedStyle(element).overflowX !== "visible";
    if (hides && element.scrollWidth > element.clientWidth + 1) {
      faults.push(`${name(element)} hides ${element.scrollWidth - element.clientWidth} px`);
    }
  }
  // Every text lies on the page and inside its own cell, box or track.
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  const boxes = "td, th, dd, dt, pre, p, figcaption, summary, .npdr";
  while (texts.nextNode()) {
    const text = texts.currentNode;
    if (!text.data.trim() || !isDrawn(text.parentElement)) continue;
    const range = document.createRange();
    range.selectNodeContents(text);
    const box = text.parentElement.closest(boxes);
    const around = box ? box.getBoundingClientRect() : { left: 0, right: width };
    for (const part of range.getClientRects()) {
      if (part.left < around.left - 1 || part.right > around.right + 1 || part.right > width + 1) {
        faults.push(`"${text.data.trim().slice(0, 40)}" leaves ${box ? name(box) : "the page"}`);
      }
    }
  }
  for (const axis of document.querySelectorAll(".ticks, .rows")) {
    const labels = [...axis.querySelectorAll("span")].filter(isDrawn);
    const places = labels.map((label) => label.getBoundingClientRect());
    for (let k = 1; k < places.length; k++) {
      const [a, b] = [places[k - 1], places[k]];
      const across = Math.min(a.right, b.right) - Math.max(a.left, b.left);
      const down = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
      if (across > 1 && down > 1) {
        faults.push(`labels "${labels[k - 1].innerText}" and "${labels[k].innerText}" overlap`);
      }
    }
  }
  for (const chart of document.querySelectorAll("[data-chart] .main-svg")) {
    if (isDrawn(chart.closest("figure")) && chart.getBoundingClientRect().right > width + 1) {
      faults.push("a chart is wider than the page");
    }
  }
  return [...new Set(faults)];
}"""

UNFOLD = "document.querySelectorAll('details').forEach((d) => { d.open = true; })"


def layout_faults(page, *, paper=None):
    """Returns a sentence for each fault of a page that a browser has opened.

    Args:
        page: Playwright's page.
        paper: Width of a sheet in CSS pixels; the window's width if not given.
    """
    return page.evaluate(FAULTS, paper)


def find_chromium(own):
    """Returns the browser's path, or None.

    Args:
        own: Where Playwright would have put its own.
    """
    candidates = [os.environ.get("NPDR_CHROMIUM"), INSTALLED / "chromium", own]
    candidates += [shutil.which(name) for name in ON_PATH]
    return next((str(path) for path in candidates if path and Path(path).is_file()), None)


@contextmanager
def chromium():
    """Starts a headless Chromium; None if there is no browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        path = find_chromium(playwright.chromium.executable_path)
        if path is None:
            yield None
            return
        libraries = [str(INSTALLED / "lib"), os.environ.get("LD_LIBRARY_PATH", "")]
        browser = playwright.chromium.launch(
            executable_path=path,
            args=["--no-sandbox", "--headless=shell", "--disable-gpu"],
            env={**os.environ, "LD_LIBRARY_PATH": ":".join(filter(None, libraries))},
        )
        yield browser
        browser.close()


def all_faults(page, widths=WIDTHS):
    """Returns the faults of an open page as (width or "paper", scheme, is unfolded, fault)."""
    found = []
    for is_open in (False, True):
        if is_open:
            page.evaluate(UNFOLD)
        for width in widths:
            page.set_viewport_size({"width": width, "height": 800})
            for scheme in ("light", "dark"):
                page.emulate_media(color_scheme=scheme)
                page.wait_for_timeout(150)  # Plotly draws again.
                found += [(width, scheme, is_open, fault) for fault in layout_faults(page)]
    page.set_viewport_size({"width": SHEET, "height": 960})
    page.emulate_media(media="print")
    page.wait_for_timeout(300)
    found += [("paper", "light", True, fault) for fault in layout_faults(page, paper=SHEET)]
    page.emulate_media(media="screen")
    return found


def main(files):
    """Prints the faults of every file; returns their number."""
    total = 0
    with chromium() as browser:
        if browser is None:
            sys.exit("There is no Chromium; .ci/install_chromium gets one.")
        for file in files:
            page, messages = browser.new_page(), []
            page.on("console", lambda message, kept=messages: kept.append(message.text))
            page.on("pageerror", lambda error, kept=messages: kept.append(str(error)))
            page.goto(Path(file).resolve().as_uri())
            page.wait_for_load_state("networkidle")
            faults = all_faults(page)
            total += len(faults) + len(messages)
            size = Path(file).stat().st_size / 1e6
            print(f"{file} ({size:.1f} MB): {len(faults)} faults, {len(messages)} messages")
            for one in (*faults, *messages):
                print("   ", one)
            page.close()
    return total


if __name__ == "__main__":
    sys.exit(min(1, main(sys.argv[1:])))
