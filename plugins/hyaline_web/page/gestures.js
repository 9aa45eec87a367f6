// Mouse, fingers and keys on the picture.

const FLY_SPEED = 0.7;  // Of the distance to the pivot, a second.
const FLY_KEYS = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0] };
const TURN_KEYS = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
const ZOOM_KEYS = { "+": 0.9, "=": 0.9, "-": 1 / 0.9 };
const STILL_PIXELS = 4;  // A pointer that travelled less has clicked.

class Gestures {
  constructor(page) {
    Object.assign(this, { page, canvas: page.canvas, camera: page.camera, pointers: new Map(), flying: new Set(), looks: false });
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.up(event));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("keyup", (event) => this.flying.delete(event.key.toLowerCase()));
    canvas.addEventListener("blur", () => this.flying.clear());
  }

  // A point of the picture, and the picture's size, in the units of the page.
  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top, box.width, box.height];
  }

  wheel(event) {
    event.preventDefault();
    const factor = Math.exp(0.001 * event.deltaY);
    if (this.looks) this.camera.fly(0, 0, 1 - factor);
    else this.camera.zoom(factor);
    this.page.moved();
  }

  down(event) {
    const { page } = this;
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    this.travelled = 0;
    this.held = null;
    // Of several fingers none clicks, whichever is lifted last.
    this.mayClick = this.pointers.size === 1 && event.button === 0 && !event.shiftKey;
    if (!this.mayClick) return;
    const found = page.tracer.pick(this.camera, ...this.at(event));
    this.under = found ? found.object : -1;
    if (found && found.object === page.chosen)
      this.held = add(this.camera.place, this.camera.through(...this.at(event)), found.distance);
  }

  drag(event) {
    const last = this.pointers.get(event.pointerId);
    if (!last) return;
    const step = [event.clientX - last[0], event.clientY - last[1]], size = Math.min(this.canvas.clientWidth, this.canvas.clientHeight);
    this.travelled += Math.abs(step[0]) + Math.abs(step[1]);
    if (this.travelled < STILL_PIXELS) return;
    const others = [...this.pointers.entries()].filter(([id]) => id !== event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (others.length) {
      const [, other] = others[0], distance = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]);
      this.camera.zoom(distance(last) / Math.max(distance([event.clientX, event.clientY]), 1));
      this.camera.fly(-step[0] / size / 2, step[1] / size / 2, 0);
    } else if (this.held) return this.dragObject(event);
    else if (event.shiftKey || event.buttons & 2) this.camera.fly(-step[0] / size, step[1] / size, 0);
    else if (this.looks) this.camera.look(step[0] * 0.003, step[1] * 0.003);
    else this.camera.orbit(-step[0] * 0.006, step[1] * 0.006);
    this.page.moved();
  }

  // Over the horizontal plane through the point where it was taken; with Alt up and down.
  dragObject(event) {
    const { page } = this, d = this.camera.through(...this.at(event)), from = this.camera.place;
    const back = this.camera.axis(2), normal = event.altKey ? [back[0], back[1], 0] : [0, 0, 1];
    const slope = dot(normal, d), t = dot(normal, add(this.held, from, -1)) / slope;
    if (Math.abs(slope) < 0.02 || !(t > 0)) return;
    const shift = add(add(from, d, t), this.held, -1).map((value, axis) => (event.altKey === (axis === 2) ? value : 0));
    this.held = add(this.held, shift);
    page.edit(page.chosen, { offset: add(page.objects.all[page.chosen].offset, shift) });
  }

  up(event) {
    if (this.pointers.delete(event.pointerId) && this.mayClick && this.travelled < STILL_PIXELS && event.type === "pointerup")
      this.page.clicked(this.under, ...this.at(event));
  }

  key(event) {
    const { page, camera } = this, name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (TURN_KEYS[name]) {
      const [right, up] = TURN_KEYS[name];
      if (event.shiftKey) camera.fly(right / 2, up / 2, 0);
      else if (this.looks) camera.look(-right, up);
      else camera.orbit(right, up);
      page.moved();
    } else if (ZOOM_KEYS[name]) camera.zoom(ZOOM_KEYS[name]), page.moved();
    else if (FLY_KEYS[name]) this.startFlying(name);
    else if (!page.command(name)) return;
    event.preventDefault();
  }

  startFlying(name) {
    const isUnderWay = this.flying.size > 0;
    this.flying.add(name);
    if (!isUnderWay) this.fly(performance.now());
  }

  fly(before) {
    requestAnimationFrame((now) => {
      const share = (FLY_SPEED * Math.min(Math.max(now - before, 16), 100)) / 1000;
      const step = [...this.flying].reduce((sum, name) => add(sum, FLY_KEYS[name], share), [0, 0, 0]);
      this.camera.fly(...step);
      this.page.moved();
      if (this.flying.size) this.fly(now);
    });
  }
}
