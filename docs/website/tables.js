// Marks the tables that are wider than the page, which tables.css then shows as lists.

function nameCells(table) {
  const columns = [...table.querySelectorAll("thead th")].map((cell) => cell.innerText.trim());
  for (const row of table.querySelectorAll("tbody tr")) {
    [...row.cells].forEach((cell, column) => {
      if (columns[column]) cell.dataset.column = columns[column];
    });
  }
}

function stackWideTables() {
  for (const table of document.querySelectorAll("article table.docutils")) {
    table.classList.remove("stacked");
    const around = table.parentElement;
    table.classList.toggle("stacked", around.scrollWidth > around.clientWidth + 1);
  }
}

document.addEventListener("DOMContentLoaded", () => {
  document.querySelectorAll("article table.docutils").forEach(nameCells);
  stackWideTables();
  window.addEventListener("resize", stackWideTables);
});
