// Returns what is cut, covers something else, or needs scrolling to the side: a sentence each.
const { clientWidth } = document.documentElement, found = [];
const named = (what) => `${what.tagName.toLowerCase()}.${what.className || what.id} "${what.textContent.slice(0, 30)}"`;
const shown = (what) => what && what.getClientRects().length > 0;
const contents = (what) => {
  const range = document.createRange();
  range.selectNodeContents(what);
  const { bottom } = what.getBoundingClientRect(); // of a long text two lines are shown
  return [...range.getClientRects()].filter((box) => box.width > 0 && box.top < bottom - 1);
};
const within = (box, other) => box.left >= other.left - 1 && box.right <= other.right + 1;
const window_box = { left: 0, right: clientWidth };

if (document.documentElement.scrollWidth > clientWidth) found.push(`the page is ${document.documentElement.scrollWidth} wide`);
for (const box of document.querySelectorAll("main, section, section > div, table")) {
  if (box.scrollWidth > box.clientWidth + 1) found.push(`${named(box)} is ${box.scrollWidth} wide, and shows ${box.clientWidth}`);
}
for (const what of document.querySelectorAll("header *, main *")) {
  if (shown(what) && !what.closest("[hidden], thead") && !within(what.getBoundingClientRect(), window_box)) found.push(`${named(what)} is beyond the window`);
}
for (const cell of document.querySelectorAll("td, tbody th, #node-list li, #event-list li, #trouble, #groups th")) {
  if (!shown(cell)) continue;
  if (contents(cell).some((box) => !within(box, cell.getBoundingClientRect()))) found.push(`${named(cell)} is wider than its place`);
}
for (const row of document.querySelectorAll("#point-rows tr:not(.reason)")) {
  for (const name of ["value", "age", "quality"]) {
    const cell = row.querySelector(`td.${name}`);
    if (!shown(cell) || !cell.textContent || !contents(cell).length) found.push(`${named(row)} shows no ${name}`);
  }
  const write = row.querySelector("td:last-child button");
  if (!write.hidden && !shown(write)) found.push(`${named(row)} shows no write control`);
  const boxes = [...row.children].filter((cell) => shown(cell) && cell.textContent).map((cell) => [cell, contents(cell)]);
  for (const [one, of_one] of boxes) {
    for (const [other, of_other] of boxes) {
      const covers = (a, b) => a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 4 && b.top < a.bottom - 4;
      if (one !== other && of_one.some((a) => of_other.some((b) => covers(a, b)))) found.push(`${named(one)} covers ${named(other)}`);
    }
  }
}
const units = [...document.querySelectorAll("#point-rows td.unit")].filter((cell) => cell.textContent && !cell.hidden);
if (!units.length || !units.every(shown)) found.push("units are not shown");
return [...new Set(found)];
