"""Faults of a page's layout, found in a browser: what overflows, is cut off, or overlaps."""

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
