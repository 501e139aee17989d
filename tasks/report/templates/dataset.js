const table = document.getElementById("sequences"), heads = [...table.tHead.rows[0].cells];
const rows = [...table.tBodies], asked = new URLSearchParams(location.hash.slice(1));
const filter = document.getElementById("filter"), shown = document.getElementById("shown");
const value = (row, column) => row.rows[0].cells[column].dataset.v;
const remember = () => history.replaceState(null, "", asked.size ? "#" + asked : location.pathname);

function sort(column, down) {
  const text = heads[column].classList.contains("text"), sign = down ? -1 : 1;
  const order = rows.slice().sort((a, b) => {
    const [x, y] = [value(a, column), value(b, column)];
    if (!x || !y) return (x ? 0 : 1) - (y ? 0 : 1);  // what has no figure comes last, either way
    return sign * (text ? x.localeCompare(y, undefined, { numeric: true }) : x - y);
  });
  table.append(...order);
  heads.forEach((head, index) => head.removeAttribute("aria-sort"));
  heads[column].setAttribute("aria-sort", down ? "descending" : "ascending");
}

function show() {
  const words = filter.value.toLowerCase();
  for (const row of rows) row.hidden = !row.textContent.toLowerCase().includes(words);
  const count = rows.filter(row => !row.hidden).length;
  shown.textContent = words ? `${count} of ${rows.length}` : "";
}

heads.forEach((head, column) => head.querySelector("button")?.addEventListener("click", () => {
  const down = head.getAttribute("aria-sort") === "ascending";
  asked.set("sort", column);
  asked.set("down", Number(down));
  remember();
  sort(column, down);
}));
filter.addEventListener("input", () => {
  if (filter.value) asked.set("with", filter.value); else asked.delete("with");
  remember();
  show();
});
if (heads[asked.get("sort")] && asked.has("sort")) sort(Number(asked.get("sort")), asked.get("down") === "1");
filter.value = asked.get("with") ?? "";
show();
if ("goesOn" in document.body.dataset) setInterval(() => { if (document.activeElement !== filter) location.reload(); }, 20000);
