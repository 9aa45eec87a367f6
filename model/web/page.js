// The page: its parts, and what mouse, fingers and keys do.

const element = (id) => document.getElementById(id);

class Page {
  constructor(scene, trees, shader) {
    Object.assign(this, { scene, trees, shader, canvas: element("view"), chosen: -1, pointers: new Map() });
    const { manifest } = scene;
    this.camera = new Camera(manifest.fov, manifest.target);
    this.objects = manifest.objects.map(freshObject);
  }

  async start() {
    this.gl = openWebGl(this.canvas);
    this.fit();
    this.tracer = new Tracer(this.gl, this.scene, this.trees, this.shader);
    this.show("Compiling the shader …");
    await this.tracer.start();
    this.makeControls();
    if (!this.readLink()) this.goTo(this.scene.manifest.start);
    this.frames = new Frames(this.tracer, this.camera, (drawn) => this.drew(drawn));
    this.update();
    this.listen();
    this.running = this.frames.run();
    this.running.catch(fail);
  }

  show(text) {
    element("status").textContent = text;
  }

  drew({ width, height, rays, ms }) {
    this.canvas.classList.add("drawn");
    const time = ms === undefined ? "" : `, ${ms < 10 ? ms.toFixed(1) : Math.round(ms)} ms a frame`;
    this.show(`${width} × ${height}, ${rays} ${rays === 1 ? "ray" : "rays"} a pixel${time}`);
  }

  // The canvas has as many pixels as are shown.
  fit() {
    const box = this.canvas.getBoundingClientRect(), ratio = Math.min(window.devicePixelRatio || 1, 2);
    this.canvas.width = Math.max(1, Math.round(box.width * ratio));
    this.canvas.height = Math.max(1, Math.round(box.height * ratio));
  }

  update() {
    this.tracer.place(this.objects);
    this.frames.changed();
    this.writeLink();
  }

  moved() {
    element("views").value = "";
    this.showTruth();
    this.frames.changed();
    this.writeLink();
  }

  // ---- Cameras of the dataset

  goTo(name) {
    const [split, view] = name.split("/"), matrices = this.scene.arrays[`cameras/${split}`];
    if (!matrices) return;
    this.camera.pivot = [...this.scene.manifest.target];
    this.camera.set([...matrices.subarray(12 * view, 12 * view + 12)]);
    element("views").value = name;
    this.showTruth();
    if (this.frames) this.frames.changed(), this.writeLink();
  }

  showTruth() {
    const source = (this.scene.manifest.truth || {})[element("views").value], image = element("truth");
    element("fade-label").hidden = image.hidden = !source;
    if (source) image.src = source;
    image.style.opacity = element("fade").value / 100;
  }

  // ---- Controls

  makeControls() {
    const views = element("views"), list = element("objects");
    views.replaceChildren(new Option("free", ""));
    for (const [split, count] of Object.entries(this.scene.manifest.views)) {
      const group = document.createElement("optgroup");
      group.label = split;
      for (let view = 0; view < count; view++) group.append(new Option(`${split} ${view}`, `${split}/${view}`));
      views.append(group);
    }
    list.replaceChildren(...this.scene.manifest.objects.map((object, index) => {
      const item = document.createElement("li"), box = document.createElement("input"), name = document.createElement("button");
      Object.assign(box, { type: "checkbox", checked: this.objects[index].shown, ariaLabel: `Show ${object.name}` });
      box.addEventListener("change", () => this.edit(index, { shown: box.checked }));
      Object.assign(name, { type: "button", textContent: object.name, ariaPressed: "false" });
      name.addEventListener("click", () => this.choose(this.chosen === index ? -1 : index));
      item.append(box, name);
      return item;
    }));
  }

  edit(index, change) {
    Object.assign(this.objects[index], change);
    this.refresh();
    this.update();
  }

  choose(index) {
    this.chosen = index;
    const fields = element("chosen");
    fields.hidden = index < 0;
    if (index >= 0) {
      const { name } = this.scene.manifest.objects[index], legend = document.createElement("legend");
      legend.textContent = name;
      fields.replaceChildren(legend, ...this.sliders(index));
    }
    this.refresh();
  }

  sliders(index) {
    const object = this.objects[index], reach = this.scene.manifest.reach, made = [];
    const slider = (label, low, high, step, get, set) => {
      const line = document.createElement("label"), input = document.createElement("input"), output = document.createElement("output");
      Object.assign(input, { type: "range", min: low, max: high, step, value: get() });
      input.addEventListener("input", () => (set(Number(input.value)), this.update(), input.refresh()));
      input.refresh = () => ((input.value = get()), (output.textContent = Number(get().toFixed(3)).toString()));
      input.refresh();
      line.append(label, input, output);
      made.push(line);
    };
    ["x", "y", "z"].forEach((name, axis) => slider(`Move ${name} (m)`, -reach, reach, reach / 500,
      () => object.offset[axis], (value) => (object.offset[axis] = value)));
    slider("Turn (degrees)", -180, 180, 1, () => (object.angle * 180) / Math.PI, (value) => (object.angle = (value * Math.PI) / 180));
    const index_ = object.rank >= 0 ? "mediumIor" : "ior";
    if (["refracts", "passes", "coated"].includes(object.event))
      slider("Refractive index", 1, 2.6, 0.01, () => object[index_], (value) => (object[index_] = value));
    if (object.rank >= 0)
      ["red", "green", "blue"].forEach((name, c) => slider(`Absorb ${name} (1/m)`, 0, Math.max(40, 4 * object.absorption[c]), 0.1,
        () => object.absorption[c], (value) => (object.absorption[c] = value)));
    return made;
  }

  refresh() {
    element("objects").querySelectorAll("li").forEach((item, index) => {
      item.querySelector("input").checked = this.objects[index].shown;
      item.querySelector("button").ariaPressed = String(index === this.chosen);
    });
    for (const input of element("chosen").querySelectorAll("input")) if (input.refresh) input.refresh();
  }

  reset() {
    this.objects = this.scene.manifest.objects.map(freshObject);
    this.choose(-1);
    this.goTo(this.scene.manifest.start);
    this.update();
  }

  // ---- Mouse, fingers, keys

  listen() {
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.up(event));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.camera.zoom(Math.exp(0.001 * event.deltaY));
      this.moved();
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.frames.held = true;
      this.show("The graphics processor was lost; waits for it …");
    });
    canvas.addEventListener("webglcontextrestored", () => this.restart().catch(fail));
    new ResizeObserver(() => (this.fit(), this.frames.changed())).observe(canvas);
    element("views").addEventListener("change", (event) => this.goTo(event.target.value));
    element("fade").addEventListener("input", () => this.showTruth());
    element("reset").addEventListener("click", () => this.reset());
    element("link").addEventListener("click", () => this.copyLink());
    element("picture").addEventListener("click", () => this.savePicture());
    window.addEventListener("hashchange", () => this.readLink() && this.update());
  }

  // After the graphics processor was lost, and all textures with it.
  async restart() {
    await this.tracer.start();
    this.frames.speed /= 4;  // If it was lost over a frame that took too long, the next ones are smaller.
    this.update();
    this.frames.held = false;
  }

  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top, box.width, box.height];
  }

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    this.travelled = 0;
    this.held = null;
    if (this.pointers.size === 1 && event.button === 0 && !event.shiftKey) {
      const found = this.tracer.pick(this.camera, ...this.at(event));
      this.under = found ? found.object : -1;
      if (found && found.object === this.chosen)
        this.held = add(this.camera.place, this.camera.through(...this.at(event)), found.distance);
    }
  }

  drag(event) {
    const last = this.pointers.get(event.pointerId);
    if (!last) return;
    const step = [event.clientX - last[0], event.clientY - last[1]], size = Math.min(this.canvas.clientWidth, this.canvas.clientHeight);
    this.travelled += Math.abs(step[0]) + Math.abs(step[1]);
    if (this.travelled < 4) return;
    const others = [...this.pointers.entries()].filter(([id]) => id !== event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (others.length) {
      const [, other] = others[0], distance = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]);
      this.camera.zoom(distance(last) / Math.max(distance([event.clientX, event.clientY]), 1));
      this.camera.pan(-step[0] / size / 2, step[1] / size / 2);
    } else if (this.held) return this.dragObject(event);
    else if (event.shiftKey || event.buttons & 2) this.camera.pan(-step[0] / size, step[1] / size);
    else this.camera.orbit(-step[0] * 0.006, step[1] * 0.006);
    this.moved();
  }

  // Over the horizontal plane through the point where it was taken; with Alt up and down.
  dragObject(event) {
    const object = this.objects[this.chosen], d = this.camera.through(...this.at(event)), from = this.camera.place;
    const back = this.camera.axis(2), normal = event.altKey ? [back[0], back[1], 0] : [0, 0, 1];
    const slope = dot(normal, d), t = dot(normal, add(this.held, from, -1)) / slope;
    if (Math.abs(slope) < 0.02 || !(t > 0)) return;
    const shift = add(add(from, d, t), this.held, -1).map((value, axis) => (event.altKey === (axis === 2) ? value : 0));
    this.held = add(this.held, shift);
    this.edit(this.chosen, { offset: add(object.offset, shift) });
  }

  up(event) {
    if (this.pointers.delete(event.pointerId) && this.travelled < 4 && event.button === 0 && event.type === "pointerup") this.choose(this.under);
  }

  key(event) {
    const turn = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
    const zoom = { "+": 0.9, "=": 0.9, "-": 1 / 0.9 }[event.key];
    if (turn && event.shiftKey) this.camera.pan(turn[0] / 2, turn[1] / 2), this.moved();
    else if (turn) this.camera.orbit(...turn), this.moved();
    else if (zoom) this.camera.zoom(zoom), this.moved();
    else if (event.key === "Escape") this.choose(-1);
    else if (event.key === "r") this.reset();
    else if (event.key === "h" && this.chosen >= 0) this.edit(this.chosen, { shown: !this.objects[this.chosen].shown });
    else return;
    event.preventDefault();
  }

  // ---- The link: what differs from the page as it opens

  writeLink() {
    const parts = new URLSearchParams(), short = (value) => Number(value.toPrecision(6)).toString();
    const view = element("views").value;
    parts.set("view", view || [...this.camera.matrix, ...this.camera.pivot].map(short).join(" "));
    this.objects.forEach((object, index) => {
      const { name } = this.scene.manifest.objects[index], fresh = freshObject(this.scene.manifest.objects[index]);
      const values = (item) => [item.shown ? 1 : 0, ...item.offset, item.angle, item.ior, item.mediumIor, ...item.absorption].map(short).join(" ");
      if (values(object) !== values(fresh)) parts.set(name, values(object));
    });
    history.replaceState(null, "", `#${parts}`);
  }

  // True where there was a link that could be read.
  readLink() {
    const parts = new URLSearchParams(location.hash.slice(1)), view = parts.get("view");
    if (view === null) return false;
    this.scene.manifest.objects.forEach((item, index) => {
      const [shown, x, y, z, angle, ior, mediumIor, ...absorption] = (parts.get(item.name) || "").split(" ").map(Number);
      const values = [x, y, z, angle, ior, mediumIor, ...absorption];
      this.objects[index] = freshObject(item);
      if (values.length === 9 && values.every(Number.isFinite))
        Object.assign(this.objects[index], { shown: shown === 1, offset: [x, y, z], angle, ior, mediumIor, absorption });
    });
    const numbers = view.split(" ").map(Number);
    if (numbers.length === 15 && numbers.every(Number.isFinite)) {
      this.camera.set(numbers.slice(0, 12));
      this.camera.pivot = numbers.slice(12);
      element("views").value = "";
    } else this.goTo(this.scene.manifest.start), this.goTo(view);
    this.refresh();
    return true;
  }

  async copyLink() {
    try {
      await navigator.clipboard.writeText(location.href);
      this.show("The link is copied.");
    } catch {
      this.show("This browser copies nothing for pages from disk; the link is in the address bar.");
    }
  }

  // For tests and scripts: a square picture of a view as bytes, red, green, blue and 255, rows from above.
  async picture(view, size, samples, edits = {}) {
    const before = this.objects;
    this.objects = this.scene.manifest.objects.map((item) => ({ ...freshObject(item), ...edits[item.name] }));
    this.tracer.place(this.objects);
    this.goTo(view);
    try {
      return [...(await this.frames.picture(size, size, samples))];
    } finally {
      this.objects = before;
      this.tracer.place(before);
    }
  }

  savePicture() {
    const link = document.createElement("a");
    this.tracer.show();
    link.download = `${this.scene.manifest.name}.png`;
    link.href = this.canvas.toDataURL("image/png");
    link.click();
  }
}

function freshObject(item) {
  const { event, ior, roughness, color, rank, mediumIor, absorption } = item;
  return { shown: item.numFaces > 0, offset: [0, 0, 0], angle: 0, event, ior, roughness, color, rank, mediumIor, absorption: [...absorption] };
}

function fail(error) {
  element("message").textContent = `${error.message} What you see is a still picture.`;
  element("message").hidden = false;
  element("status").textContent = "Not drawn live.";
}

async function open() {
  if (typeof DecompressionStream === "undefined") throw new Error("This browser is too old to unpack the scene (no DecompressionStream).");
  const manifest = JSON.parse(element("manifest").textContent), data = element("data");
  const scene = { manifest, arrays: await unpack(manifest.arrays, data.textContent) };
  data.remove();
  element("status").textContent = "Sorting the surfaces …";
  const page = new Page(scene, await buildTrees(scene), element("shader").textContent);
  await page.start();
  return page;
}

// For tests and scripts: the page, and its pictures as Python would take them.
window.hyaline = open();
window.hyaline.catch(fail);
