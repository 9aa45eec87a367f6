// The page: what its parts tell each other.

const LINK_MS = 400, MESSAGE_MS = 4000;

class Page {
  constructor(scene, trees, shader) {
    Object.assign(this, { scene, trees, shader, canvas: element("view"), chosen: -1 });
    this.camera = new Camera(scene.manifest.lens, scene.manifest.target);
    this.objects = new Objects(scene.manifest);
  }

  async start() {
    this.gl = openWebGl(this.canvas);
    this.fit();
    this.tracer = new Tracer(this.gl, this.scene, this.trees, this.shader);
    this.show("Compiling the shader …");
    await this.tracer.start();
    this.frames = new Frames(this.tracer, this.camera, (drawn) => this.drew(drawn));
    this.gestures = new Gestures(this);
    this.rays = new RayView(element("rays"), element("met"), this);
    this.panel = new Panel(this);
    if (!this.readLink()) this.goTo(this.scene.manifest.start), this.panel.listObjects();
    this.listen();
    this.update();
    this.running = this.frames.run();
    this.running.catch(fail);
  }

  listen() {
    this.canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.frames.held = true;
      this.show("The graphics processor was lost; waits for it …");
    });
    this.canvas.addEventListener("webglcontextrestored", () => this.restart().catch(fail));
    new ResizeObserver(() => this.resized()).observe(this.canvas);
    this.watchResolution();
    window.addEventListener("hashchange", (event) => this.readLink(new URL(event.newURL).hash) && this.update());
  }

  resized() {
    this.fit();
    this.frames.changed();
    this.rays.draw();
  }

  // A window that moves to another screen keeps its size in CSS pixels.
  watchResolution() {
    const moved = () => (this.resized(), this.watchResolution());
    matchMedia(`(resolution: ${window.devicePixelRatio}dppx)`).addEventListener("change", moved, { once: true });
  }

  // After the graphics processor was lost, and all textures with it.
  async restart() {
    await this.tracer.start();
    this.frames.speed /= 4;  // If it was lost over a frame that took too long, the next ones are smaller.
    this.update();
    this.frames.held = false;
  }

  // The figures of frames, which change all the time, are not read aloud.
  show(text, live = "polite") {
    Object.assign(element("status"), { ariaLive: live, textContent: text });
  }

  // What the figures of the next frames do not replace.
  answer(text) {
    this.answeredAt = performance.now();
    this.show(text);
  }

  drew({ width, height, rays, ms }) {
    if (this.beatsStill(width)) this.canvas.classList.add("drawn"), (element("busy").hidden = true);
    if (performance.now() - this.answeredAt < MESSAGE_MS) return;
    const time = ms === undefined ? "" : `, ${ms < 10 ? ms.toFixed(1) : Math.round(ms)} ms a frame`;
    this.show(`${width} × ${height}, ${rays} ${rays === 1 ? "ray" : "rays"} a pixel${time}`, "off");
  }

  // Whether a frame so wide shows more than the still picture: at least as many pixels of the same view, or another one.
  beatsStill(width) {
    const { naturalWidth, naturalHeight } = element("still"), { clientWidth, clientHeight } = this.canvas;
    const isOther = this.link() !== `#${new URLSearchParams({ view: this.scene.manifest.start })}`;
    const stillWidth = clientWidth * Math.max(naturalWidth / clientWidth, naturalHeight / clientHeight);
    return isOther || width >= Math.min(stillWidth, this.canvas.width);
  }

  // The canvas has as many pixels as are shown.
  fit() {
    const box = this.canvas.getBoundingClientRect(), ratio = Math.min(window.devicePixelRatio || 1, 2);
    this.canvas.width = Math.max(1, Math.round(box.width * ratio));
    this.canvas.height = Math.max(1, Math.round(box.height * ratio));
  }

  // ---- What has changed

  // An object.
  update() {
    this.tracer.place(this.objects.all);
    this.rays.clear();
    this.changed();
  }

  // The camera, which stands at none of the dataset's any more.
  moved() {
    element("views").value = "";
    this.showTruth();
    this.changed();
  }

  changed() {
    this.hideError();
    this.frames.changed();
    this.rays.draw();
    this.writeLink();
  }

  // ---- Objects

  edit(index, change) {
    Object.assign(this.objects.all[index], change);
    this.panel.refresh();
    this.update();
  }

  choose(index) {
    this.chosen = index;
    this.panel.describe();
  }

  copy() {
    const middle = middleOf(this.objects.all[this.chosen], this.trees.bounds[this.objects.all[this.chosen].of]);
    const aside = 0.15 * norm(add(middle, this.camera.place, -1)), right = this.camera.axis(0);
    const index = this.objects.copy(this.chosen, [right[0] * aside, right[1] * aside, 0]);
    if (index === undefined) return this.answer("There is no room for another copy.");
    this.panel.listObjects();
    this.choose(index);
    this.update();
  }

  remove() {
    const isCopy = this.objects.isCopy(this.chosen);
    this.objects.remove(this.chosen);
    if (isCopy) this.chosen = -1;
    this.panel.listObjects();
    this.update();
  }

  wear(index, material) {
    this.objects.wear(index, material);
    this.panel.describe();
    this.update();
  }

  reset() {
    this.objects.reset();
    this.chosen = -1;
    this.panel.listObjects();
    this.goTo(this.scene.manifest.start);
    this.update();
  }

  // ---- What is asked of the page

  clicked(object, ...at) {
    if (element("follow").checked) this.rays.ask(...at).catch(fail);
    else this.choose(object);
  }

  // What a key or a button stands for; false for none.
  command(name) {
    const hasChosen = this.chosen >= 0;
    if (name === "Escape") this.choose(-1);
    else if (name === "r") this.reset();
    else if (name === "f") (this.gestures.looks = !this.gestures.looks), this.panel.refresh();
    else if (name === "h" && hasChosen) this.edit(this.chosen, { shown: !this.objects.all[this.chosen].shown });
    else if (name === "c" && hasChosen) this.copy();
    else if (name === "Delete" && hasChosen) this.remove();
    else return false;
    return true;
  }

  goTo(name) {
    const [split, view] = name.split("/"), matrices = this.scene.arrays[`cameras/${split}`];
    if (!matrices) return;
    this.camera.pivot = [...this.scene.manifest.target];
    this.camera.set([...matrices.subarray(12 * view, 12 * view + 12)]);
    element("views").value = name;
    this.showTruth();
    this.changed();
  }

  showTruth() {
    const view = element("views").value, source = (this.scene.manifest.truth || {})[view], image = element("truth");
    element("compare").hidden = image.hidden = !source;
    element("error").hidden = view.startsWith("train/");  // Their truth has lost too much.
    if (source) image.src = source;
    image.style.clipPath = `inset(0 ${100 - element("fade").value}% 0 0)`;
  }

  hideError() {
    element("difference").hidden = true;
    element("score").textContent = "";
  }

  // How far a picture with the rays of `model predict` is from the truth of this view: as a picture, and as PSNR.
  async showError() {
    const truth = element("truth"), shown = element("difference"), view = element("views").value;
    if (!shown.hidden) return this.hideError();
    element("score").textContent = "Drawing …";
    await truth.decode();
    Object.assign(shown, { width: truth.naturalWidth, height: truth.naturalHeight });
    const { width, height } = shown, drawn = await this.frames.picture(width, height, this.scene.manifest.samples);
    if (element("views").value !== view) return;
    const drawing = shown.getContext("2d");
    drawing.drawImage(truth, 0, 0);
    const pixels = drawing.getImageData(0, 0, width, height), errors = drawn.map((value, place) => Math.abs(value - pixels.data[place]));
    errors.forEach((error, place) => (pixels.data[place] = place % 4 < 3 ? 8 * error : 255));
    drawing.putImageData(pixels, 0, 0);
    shown.hidden = false;
    const squares = errors.reduce((sum, error) => sum + error * error, 0) / (3 * width * height);
    element("score").textContent = `${(10 * Math.log10(255 * 255 / squares)).toFixed(2)} dB`;
  }

  // ---- The link: what differs from the page as it opens

  link() {
    const parts = new URLSearchParams(), view = element("views").value;
    parts.set("view", view || [...this.camera.matrix, ...this.camera.pivot].map(short).join(" "));
    this.objects.write(parts);
    return `#${parts}`;
  }

  // Browsers ignore or refuse more than some 100 changes of the address in 30 s.
  writeLink() {
    this.linkTimer ??= setTimeout(() => {
      this.linkTimer = undefined;
      history.replaceState(null, "", this.link());
    }, LINK_MS);
  }

  // True where there was a link that could be read.
  readLink(hash = location.hash) {
    const parts = new URLSearchParams(hash.slice(1)), view = parts.get("view");
    if (view === null) return false;
    this.objects.read(parts);
    this.chosen = -1;
    this.panel.listObjects();
    const numbers = view.split(" ").map(Number);
    this.goTo(this.scene.manifest.start);
    if (numbers.length === 15 && numbers.every(Number.isFinite)) {
      this.camera.set(numbers.slice(0, 12));
      this.camera.pivot = numbers.slice(12);
      this.moved();
    } else this.goTo(view);
    return true;
  }

  async copyLink() {
    try {
      await navigator.clipboard.writeText(location.href.split("#")[0] + this.link());
      this.answer("The link is copied.");
    } catch {
      this.answer("This browser copies nothing for pages from disk; the link is in the address bar.");
    }
  }

  // ---- Pictures

  // For tests and scripts: a picture of a view as bytes, red, green, blue and 255, rows from above. Edits are
  // by name; that of a copy says whose `copyOf` it is.
  async picture(view, width, height, samples, edits = {}) {
    const before = this.objects.all;
    this.objects.reset();
    for (const [name, { copyOf, material, ...change }] of Object.entries(edits)) {
      const index = copyOf === undefined ? this.objects.all.findIndex((item) => item.name === name)
        : this.objects.copy(this.objects.all.findIndex((item) => item.name === copyOf), [0, 0, 0]);
      if (material !== undefined) this.objects.wear(index, this.objects.materials.findIndex((known) => known.name === material));
      Object.assign(this.objects.all[index], change);
    }
    this.tracer.place(this.objects.all);
    this.goTo(view);
    try {
      return [...(await this.frames.picture(width, height, samples))];
    } finally {
      this.objects.all = before;
      this.tracer.place(before);
    }
  }

  savePicture() {
    const link = { download: `${this.scene.manifest.name}.png`, href: this.canvas.toDataURL("image/png") };
    Object.assign(document.createElement("a"), link).click();
  }
}

function fail(error) {
  element("message").textContent = `${error.message} What you see is a still picture.`;
  element("message").hidden = false;
  element("status").textContent = "Not drawn live.";
  element("busy").hidden = element("hint").hidden = true;
}

async function open() {
  if (typeof DecompressionStream === "undefined") throw new Error("This browser is too old to unpack the scene (no DecompressionStream).");
  const manifest = JSON.parse(element("manifest").textContent), data = element("data");
  const scene = { manifest, arrays: await unpack(manifest.arrays, data.textContent) };
  scene.arrays.vertices = vertexFloats(scene.arrays, manifest);
  data.remove();
  element("status").textContent = "Sorting the surfaces …";
  const page = new Page(scene, await buildTrees(scene), element("shader").textContent);
  await page.start();
  return page;
}

// For tests and scripts: the page, and its pictures as Python would take them.
window.hyaline = open();
window.hyaline.catch(fail);
