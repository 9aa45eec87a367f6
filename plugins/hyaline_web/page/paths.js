// What a ray meets that was clicked on: its light path, branch by branch, and the layers along the straight line.

const MAX_SEGMENTS = 64, MAX_LAYERS = 32, SHOWN_BRANCHES = 8;

class RayView {
  constructor(group, list, page) {
    Object.assign(this, { group, list, page, segments: [], layers: [] });
  }

  get isEmpty() {
    return !this.layers.length && !this.segments.length;
  }

  clear() {
    Object.assign(this, { segments: [], layers: [] });
    this.list.replaceChildren();
    this.group.replaceChildren();
  }

  // Follows the ray through a point of a picture of some size.
  async ask(x, y, width, height) {
    const { tracer, camera } = this.page, names = this.page.objects.all.map((item) => item.name);
    this.clear();
    this.layers = await tracer.layers(camera, MAX_LAYERS, x, y, width, height);
    this.segments = tracer.followsLight ? await tracer.lightPath(camera, MAX_SEGMENTS, x, y, width, height) : [];
    const line = (text) => Object.assign(document.createElement("li"), { textContent: text });
    this.list.append(...this.layers.map(({ object, distance }, index) => line(`Layer ${index}: ${names[object]}, ${distance.toFixed(3)} m`)));
    for (let branch = 0; branch < SHOWN_BRANCHES; branch++) {
      const own = this.segments.filter((segment) => segment.branch === branch);
      if (!own.length) break;
      const met = own.map(({ object }) => (object < 0 ? "outside" : names[object])).join(" → ");
      this.list.append(line(`Branch ${branch + 1}: ${met} (${(100 * own[own.length - 1].share).toFixed(1)} % of the light)`));
    }
    if (this.isEmpty) this.list.append(line("The ray meets nothing."));
    this.draw();
  }

  // The paths as lines, the layers as dots on the straight one.
  draw() {
    if (this.isEmpty) return;
    const { camera, canvas } = this.page, size = [canvas.clientWidth, canvas.clientHeight];
    const place = (point) => camera.project(point, ...size);
    const lines = this.segments.flatMap(({ from, to, branch, share }) => {
      const ends = [place(from), place(to)];
      if (ends.includes(null)) return [];
      const look = { stroke: `hsl(${(branch * 67) % 360} 90% 60%)`, opacity: Math.max(0.25, Math.min(1, 3 * share)) };
      return [drawn("path", { d: `M${ends[0].join(" ")}L${ends[1].join(" ")}`, class: "segment", ...look })];
    });
    const dots = this.layers.map(({ point }) => place(point)).filter(Boolean)
      .map(([x, y]) => drawn("circle", { cx: x, cy: y, r: 3.5, class: "layer" }));
    this.group.replaceChildren(...lines, ...dots);
  }
}

function drawn(kind, attributes) {
  const made = document.createElementNS(element("overlay").namespaceURI, kind);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}
