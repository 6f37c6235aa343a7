const table = document.querySelector("table.registrations"), body = table.tBodies[0];
const search = document.querySelector("input[type=search]"), choice = document.querySelector("select");
const said = document.querySelector("[role=status]"), more = document.querySelector("button.more");
const all = [...body.rows].map((row) => ({ row, cells: [...row.cells].map((cell) => cell.textContent) }));
const text = all.map(({ cells }) => cells.join(" ").toLowerCase());
const rowsAtOnce = Number(table.dataset.pageRows);
let order = all.map((_, k) => k), shown = rowsAtOnce;

// Only the first rows are in the document: a browser takes seconds to lay out ten thousand.
function show() {
  const words = search.value.toLowerCase().split(/\s+/).filter(Boolean), status = choice.value;
  const found = order.filter((k) => words.every((word) => text[k].includes(word))
    && (!status || (status === "look" ? all[k].row.classList.contains("look") : all[k].cells[2].endsWith(status.slice(3)))));
  body.replaceChildren(...found.slice(0, shown).map((k) => all[k].row));
  const displayed = Math.min(shown, found.length);
  said.textContent = `${displayed} of ${found.length}` + (found.length < all.length ? ` that match, ${all.length} in all` : "");
  more.hidden = displayed === found.length;
  more.textContent = `Show ${Math.min(rowsAtOnce, found.length - displayed)} more`;
}

function sort(column, descending) {
  const value = (k) => all[k].cells[column], number = (k) => Number.parseFloat(value(k));
  const numeric = table.tHead.rows[0].cells[column].classList.contains("num");
  const compare = numeric ? (a, b) => number(a) - number(b) : (a, b) => value(a).localeCompare(value(b), undefined, { numeric: true });
  const known = (k) => !numeric || Number.isFinite(number(k));
  order = all.map((_, k) => k).filter(known).sort((a, b) => (descending ? compare(b, a) : compare(a, b)));
  order.push(...all.map((_, k) => k).filter((k) => !known(k)));
}

// A first click sorts numbers from the largest, text from A; a second one reverses; a third one restores the ranking.
table.tHead.addEventListener("click", (event) => {
  const head = event.target.closest("th"), button = event.target.closest("button");
  if (!button) return;
  const first = head.classList.contains("num") ? "descending" : "ascending";
  const second = first === "descending" ? "ascending" : "descending";
  const before = head.getAttribute("aria-sort"), now = before === first ? second : before === second ? "" : first;
  for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
  if (now) head.setAttribute("aria-sort", now);
  if (now) sort(head.cellIndex, now === "descending"); else order = all.map((_, k) => k);
  shown = rowsAtOnce;
  show();
});
for (const control of [search, choice]) control.addEventListener("input", () => { shown = rowsAtOnce; show(); });
more.addEventListener("click", () => { shown += rowsAtOnce; show(); });
show();
