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

// Truth and prediction in one place, parted by a slider; or their difference; or side by side, as without scripts.
for (const figure of document.querySelectorAll(".compare")) {
  const [truth, prediction, error] = figure.querySelectorAll(".panels > div");
  const tools = document.createElement("div");
  tools.className = "tools";
  const slider = document.createElement("input");
  slider.type = "range";
  slider.min = 0;
  slider.max = 100;
  slider.value = 50;
  slider.setAttribute("aria-label", "Where the truth ends and the prediction begins, in percent");
  const panels = figure.querySelector(".panels");
  const edge = document.createElement("div");
  edge.className = "edge";
  panels.append(edge);
  const part = () => panels.style.setProperty("--cut", `${slider.value}%`);
  slider.addEventListener("input", part);
  // The edge follows whoever drags on the picture.
  const follow = (event) => {
    if (slider.hidden || !panels.hasPointerCapture(event.pointerId)) return;
    const frame = panels.getBoundingClientRect();
    slider.value = (100 * (event.clientX - frame.left)) / frame.width;
    part();
  };
  panels.addEventListener("pointerdown", (event) => {
    panels.setPointerCapture(event.pointerId);
    follow(event);
  });
  panels.addEventListener("pointermove", follow);
  const buttons = ["Slider", "Error", "Side by side"].map((words) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = words;
    button.addEventListener("click", () => choose(words));
    return button;
  });
  truth.classList.add("left");
  prediction.classList.add("right");
  const choose = (words) => {
    buttons.forEach((button) => button.setAttribute("aria-pressed", String(button.textContent === words)));
    figure.classList.toggle("sliding", words !== "Side by side");
    figure.classList.toggle("parting", words === "Slider");
    truth.classList.toggle("away", words === "Error");
    prediction.classList.toggle("away", words === "Error");
    error.classList.toggle("away", words === "Slider");
    slider.hidden = words !== "Slider";
  };
  tools.append(...buttons, slider);
  figure.append(tools);
  choose("Slider");
}

// Several pictures, all of them or one alone and large.
for (const group of document.querySelectorAll(".choice")) {
  const panels = [...group.children].filter((child) => child.dataset.name !== undefined);
  const tools = document.createElement("div");
  tools.className = "tools";
  const choose = (panel) => {
    for (const other of panels) other.hidden = panel !== null && other !== panel;
    group.classList.toggle("alone", panel !== null);
    [null, ...panels].forEach((other, place) => tools.children[place].setAttribute("aria-pressed", String(other === panel)));
  };
  for (const panel of [null, ...panels]) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = panel === null ? "all" : panel.dataset.name;
    button.addEventListener("click", () => choose(panel));
    tools.append(button);
  }
  group.prepend(tools);
  choose(null);
}
