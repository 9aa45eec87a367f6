// The controls beside the picture: cameras, objects, and what is known of the chosen one.

const element = (id) => document.getElementById(id);

function made(kind, properties, ...children) {
  const node = Object.assign(document.createElement(kind), properties);
  node.append(...children);
  return node;
}

class Panel {
  constructor(page) {
    this.page = page;
    this.listViews();
    const on = (id, event, act) => element(id).addEventListener(event, act);
    on("views", "change", (event) => page.goTo(event.target.value));
    on("fade", "input", () => page.showTruth());
    on("error", "click", () => page.showError().catch(fail));
    on("reset", "click", () => page.reset());
    on("fly", "click", () => page.command("f"));
    on("picture", "click", () => page.savePicture());
    on("link", "click", () => page.copyLink());
    on("follow", "change", () => page.rays.clear());
    on("more", "click", () => (element("more").ariaExpanded = String(element("panel").classList.toggle("open"))));
    on("view", "pointerdown", () => (element("hint").hidden = true));
  }

  listViews() {
    const groups = Object.entries(this.page.scene.manifest.views).map(([split, count]) =>
      made("optgroup", { label: split }, ...Array.from({ length: count }, (_, view) => new Option(`${split} ${view}`, `${split}/${view}`))));
    element("views").replaceChildren(new Option("free", ""), ...groups);
  }

  listObjects() {
    const { page } = this;
    keepingFocus(element("objects"), (list) => list.replaceChildren(...page.objects.all.map((object, index) => {
      const box = made("input", { type: "checkbox", checked: object.shown, ariaLabel: `Show ${object.name}` });
      box.addEventListener("change", () => page.edit(index, { shown: box.checked }));
      const name = made("button", { type: "button", textContent: object.name, ariaPressed: "false" });
      name.addEventListener("click", () => page.choose(page.chosen === index ? -1 : index));
      return made("li", {}, box, name);
    })));
    this.describe();
  }

  // The fields of the chosen object.
  describe() {
    const { page } = this, object = page.objects.all[page.chosen], fields = element("chosen");
    fields.hidden = !object;
    if (object) {
      const shape = [...this.placeSliders(object), ...this.materialFields(object)];
      const all = [made("legend", { textContent: object.name }), ...shape, this.buttons()];
      keepingFocus(fields, () => fields.replaceChildren(...all));
    } else if (fields.contains(document.activeElement)) element("objects").querySelector("button").focus();
    this.refresh();
  }

  slider(label, low, high, step, get, set) {
    const input = made("input", { type: "range", min: low, max: high, step }), output = made("output", { ariaHidden: "true" });  // The slider itself says it.
    input.refresh = () => ((input.value = get()), (output.textContent = Number(get().toFixed(3)).toString()));
    input.addEventListener("input", () => (set(Number(input.value)), this.page.update(), input.refresh()));
    return made("label", {}, label, input, output);
  }

  placeSliders(object) {
    const { reach } = this.page.scene.manifest, axes = ["x", "y", "z"];
    return [
      ...axes.map((name, axis) => this.slider(`Move ${name}, m`, -reach, reach, reach / 500,
        () => object.offset[axis], (value) => (object.offset = object.offset.map((old, i) => (i === axis ? value : old))))),
      ...axes.map((name, axis) => this.slider(`Turn ${name}, °`, -180, 180, 1,
        () => object.turn[axis], (value) => (object.turn = object.turn.map((old, i) => (i === axis ? value : old))))),
    ];
  }

  materialFields(object) {
    const { page } = this, { objects } = page, fields = [];
    if (!objects.knowsMaterials) return fields;
    const choice = made("select", {}, ...objects.materialsFor(page.chosen).map((place) => new Option(objects.materials[place].name, place)));
    choice.value = object.material;
    choice.addEventListener("change", () => page.wear(page.chosen, Number(choice.value)));
    fields.push(made("label", { className: "wide" }, "Material of", choice));
    const isSolid = object.priority !== null, index = isSolid ? "mediumIor" : "ior";
    if (["refracts", "passes", "coated"].includes(object.event))
      fields.push(this.slider("Refractive index", 1, 2.6, 0.01, () => object[index], (value) => (object[index] = value)));
    if (isSolid)
      ["red", "green", "blue"].forEach((name, c) => fields.push(this.slider(`Absorb ${name}, 1/m`, 0, Math.max(40, 4 * object.absorption[c]), 0.1,
        () => object.absorption[c], (value) => (object.absorption[c] = value))));
    return fields;
  }

  buttons() {
    const { page } = this, isCopy = page.objects.isCopy(page.chosen);
    const button = (textContent, key) => {
      const node = made("button", { type: "button", textContent });
      node.addEventListener("click", () => page.command(key));
      return node;
    };
    return made("div", { className: "buttons" }, button("Copy", "c"), button(isCopy ? "Remove" : "Hide", "Delete"));
  }

  // What may have changed without these controls.
  refresh() {
    const { page } = this;
    element("objects").querySelectorAll("li").forEach((item, index) => {
      item.querySelector("input").checked = page.objects.all[index].shown;
      item.querySelector("button").ariaPressed = String(index === page.chosen);
    });
    for (const input of element("chosen").querySelectorAll("input")) if (input.refresh) input.refresh();
    element("fly").ariaPressed = String(page.gestures.looks);
  }
}

// Rebuilds the controls inside of an element; the one in the same place gets the focus if one had it.
function keepingFocus(box, rebuild) {
  const controls = () => [...box.querySelectorAll("input, select, button")], place = controls().indexOf(document.activeElement);
  rebuild(box);
  if (place >= 0) controls().at(Math.min(place, controls().length - 1)).focus();
}
