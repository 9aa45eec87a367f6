// Handles over the picture, for mouse and fingers: three arrows to move an object, three rings to turn it.

const HANDLE_SHARE = 0.22, RING_SHARE = 0.15, RING_POINTS = 48, EDGE_ON = 0.12;

function drawn(kind, attributes) {
  const made = document.createElementNS(element("overlay").namespaceURI, kind);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

class Gizmo {
  // `moved` is told of each change of the object: its new offset, or its new turn.
  constructor(group, camera, at, moved) {
    Object.assign(this, { group, camera, at, moved, object: null });
    this.handles = UNIT_AXES.flatMap((axis, index) => ["turn", "move"].map((kind) => this.makeHandle(kind, axis, "xyz"[index])));
  }

  makeHandle(kind, axis, name) {
    const group = drawn("g", { class: `handle ${kind} ${name}` }), handle = { kind, axis, group };
    // Beside the line that is seen a wide one that is not, for fingers.
    group.append(...(handle.paths = [drawn("path", { class: "touch" }), drawn("path", { class: "line" })]));
    group.addEventListener("pointerdown", (event) => this.take(event, handle));
    group.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) group.addEventListener(name, () => (this.held = null));
    this.group.append(group);
    return handle;
  }

  // For an object that stands about a point; none without object.
  show(object, middle, width, height) {
    Object.assign(this, { object, middle, size: [width, height] });
    const isSeen = object && this.camera.project(middle, width, height);
    this.group.toggleAttribute("hidden", !isSeen);
    if (!isSeen) return;
    const away = norm(add(middle, this.camera.place, -1)), reach = (away * Math.min(width, height)) / focalLength(this.camera, width, height);
    for (const { kind, axis, paths } of this.handles) {
      const line = kind === "move" ? this.arrow(axis, reach * HANDLE_SHARE) : this.ring(axis, reach * RING_SHARE);
      for (const path of paths) path.setAttribute("d", line);
    }
  }

  arrow(axis, length) {
    const points = [this.middle, add(this.middle, axis, length)].map((point) => this.camera.project(point, ...this.size));
    if (points.includes(null)) return "";
    const [from, to] = points, along = add(to, from, -1), total = Math.hypot(...along);
    if (total < 8) return "";  // Seen from its end.
    const [x, y] = along.map((value) => (value * 10) / total);
    const head = [[-x - 0.5 * y, -y + 0.5 * x], [-x + 0.5 * y, -y - 0.5 * x]].map((step) => add(to, step).join(" "));
    return `M${from.join(" ")}L${to.join(" ")}M${head[0]}L${to.join(" ")}L${head[1]}`;
  }

  ring(axis, radius) {
    const [u, v] = sidesOf(axis);
    const points = Array.from({ length: RING_POINTS }, (_, step) => {
      const angle = (2 * Math.PI * step) / RING_POINTS;
      return this.camera.project(add(add(this.middle, u, radius * Math.cos(angle)), v, radius * Math.sin(angle)), ...this.size);
    });
    return points.includes(null) ? "" : `M${points.map((point) => point.join(" ")).join("L")}Z`;
  }

  take(event, handle) {
    event.currentTarget.setPointerCapture(event.pointerId);
    this.held = { ...handle, middle: this.middle, offset: this.object.offset, turn: turnOf(this.object.turn), from: [event.clientX, event.clientY] };
    this.held.start = this.reading(event);
    event.preventDefault();
  }

  drag(event) {
    const { held } = this, now = held && this.reading(event);
    if (!held || now === null || held.start === null) return;
    const change = now - held.start;
    if (held.kind === "move") this.moved({ offset: add(held.offset, held.axis, change) });
    else this.moved({ turn: anglesOf(turnedFurther(held.turn, held.axis, change)) });
  }

  // How far along the held arrow, or how far around the held ring, the pointer is; null where that cannot be said.
  reading(event) {
    const { kind, axis, middle, from } = this.held, d = this.camera.through(...this.at(event)), slope = dot(axis, d);
    const away = add(middle, this.camera.place, -1);
    if (kind === "move") return 1 - slope * slope < 1e-3 ? null : (slope * dot(d, away) - dot(axis, away)) / (1 - slope * slope);
    if (Math.abs(slope) < EDGE_ON) return 0.01 * (event.clientX - from[0]);
    const point = add(d.map((value) => (value * dot(axis, away)) / slope), away, -1), [u, v] = sidesOf(axis);
    return Math.atan2(dot(point, v), dot(point, u));
  }
}

// Two directions that form a right-handed frame with an axis.
function sidesOf(axis) {
  const index = axis.indexOf(1);
  return [UNIT_AXES[(index + 1) % 3], UNIT_AXES[(index + 2) % 3]];
}
