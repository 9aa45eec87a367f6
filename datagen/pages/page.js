"use strict";
// What scripts add to a page that can be read without them: tables that sort, one page at a time, pictures under a slider.

for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    head.setAttribute("aria-sort", "none");
    button.addEventListener("click", () => sortTable(table, heads, column));
  });
}

function sortTable(table, heads, column) {
  const head = heads[column];
  const isNumber = head.classList.contains("number");
  const first = isNumber && !head.textContent.includes("↓") ? "descending" : "ascending";
  const second = first === "ascending" ? "descending" : "ascending";
  const order = head.getAttribute("aria-sort") === first ? second : first;
  heads.forEach((other) => other.setAttribute("aria-sort", other === head ? order : "none"));
  const sign = order === "ascending" ? 1 : -1;
  const body = table.tBodies[0];
  const rows = [...body.rows].map((row) => [valueOf(row.cells[column].textContent, isNumber), row]);
  rows.sort(([a], [b]) => {
    if (a === null || b === null) return (a === null) - (b === null); // What is not there stays last either way.
    return sign * (isNumber ? a - b : a.localeCompare(b, "en", { numeric: true }));
  });
  body.append(...rows.map(([, row]) => row));
}

function valueOf(text, isNumber) {
  if (!isNumber) return text;
  if (text.trim() === "∞") return Infinity;
  const number = parseFloat(text.replaceAll(",", "").replace("−", "-"));
  return Number.isNaN(number) ? null : number;
}

// One page at a time: the links of the navigation show theirs and hide the others.
const pages = [...document.querySelectorAll("main > .page")];
const links = [...document.querySelectorAll("nav a")];

function turnTo() {
  const wanted = document.getElementById(location.hash.slice(1)); // Names are plain ASCII.
  if (wanted?.matches("main") && pages.some((candidate) => candidate.hidden)) return; // To skip the navigation.
  const page = pages.find((candidate) => candidate.contains(wanted)) ?? pages[0];
  for (const other of pages) other.hidden = other !== page;
  for (const link of links) {
    if (link.hash === `#${page.id}`) {
      link.setAttribute("aria-current", "page");
      link.scrollIntoView({ block: "nearest", inline: "nearest" }); // There may be more links than fit.
    } else link.removeAttribute("aria-current");
  }
  if (wanted && wanted !== page) wanted.scrollIntoView();
  else window.scrollTo(0, 0);
}

if (pages.length > 1) {
  window.addEventListener("hashchange", turnTo);
  turnTo();
}

// The pictures of a view: all side by side, or one alone and large; a truth and one prediction also under a slider.
for (const row of document.querySelectorAll(".row")) {
  const panels = [...row.children], isCompared = panels.length === 2 && row.querySelectorAll(".error").length === 1;
  if (panels.length < 2) continue;
  const tools = Object.assign(document.createElement("div"), { className: "tools" });
  const label = "Where the truth ends and the prediction begins, in percent";
  const slider = Object.assign(document.createElement("input"), { type: "range", ariaLabel: label });
  const part = () => row.style.setProperty("--cut", `${slider.value}%`);
  slider.addEventListener("input", part);
  // Where the pointer is on the picture, truth ends.
  const follow = (event) => {
    if (slider.hidden || !row.hasPointerCapture(event.pointerId)) return;
    const frame = panels[0].getBoundingClientRect();
    slider.value = (100 * (event.clientX - frame.left)) / frame.width;
    part();
  };
  row.addEventListener("pointerdown", (event) => {
    if (!slider.hidden) row.setPointerCapture(event.pointerId);
    follow(event);
  });
  row.addEventListener("pointermove", follow);
  const choices = ["all", ...panels, ...(isCompared ? ["slider"] : [])];
  const buttons = choices.map((choice) => {
    const button = document.createElement("button");
    Object.assign(button, { type: "button", textContent: choice.dataset?.name ?? choice });
    button.addEventListener("click", () => choose(choice));
    return button;
  });
  const choose = (choice) => {
    const isAlone = panels.includes(choice);
    buttons.forEach((button, place) => (button.ariaPressed = String(choices[place] === choice)));
    for (const panel of panels) panel.hidden = isAlone && panel !== choice;
    row.classList.toggle("alone", isAlone);
    row.classList.toggle("parting", choice === "slider");
    slider.hidden = choice !== "slider";
  };
  tools.append(...buttons, slider);
  row.before(tools);
  choose("all");
}
