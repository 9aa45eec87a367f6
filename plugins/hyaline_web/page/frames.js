// Which frames are drawn when: coarse while something moves; when all is still, finer and finer, then averaged over many
// rays.

const MOVING_MS = 50, STILL_MS = 4000, BAND_MS = 40, SETTLED_MS = 180, MAX_PASSES = 16;

function greatestDivisor(a, b) {
  return b ? greatestDivisor(b, a % b) : a;
}

class Frames {
  constructor(tracer, camera, tell) {
    Object.assign(this, { tracer, camera, tell, speed: 4, version: 0, changedAt: -1e9, stopped: false, busy: Promise.resolve() });
  }

  // Something is to be drawn anew.
  changed() {
    this.version++;
    this.changedAt = performance.now();
  }

  // Ray number `frame` of every pixel. The first pass is the product's own grid, later ones lie elsewhere in its cells.
  rayOf(frame, samples) {
    const manyRays = this.tracer.scene.manifest.defines.MANY_RAYS || samples;
    const side = Math.round(Math.sqrt(samples)), pass = Math.floor(frame / samples);
    // Cells far from each other come one after the other.
    let step = Math.max(1, Math.round(samples * 0.618));
    while (greatestDivisor(step, samples) > 1) step++;
    const cell = ((frame % samples) * step) % samples;
    const inCell = pass ? [(0.5 + pass * 0.7548776662466927) % 1, (0.5 + pass * 0.5698402909980532) % 1] : [0.5, 0.5];
    const place = [((cell % side) + inCell[0]) / side, (Math.floor(cell / side) + inCell[1]) / side];
    return { place, chunk: Math.max(1, Math.floor(manyRays / samples)), samples, sample: cell, seed: pass, isFirst: frame === 0 };
  }

  // Draws one frame in bands of rows, each of which the graphics processor does in a short time; false if `isStale`.
  async draw(ray, isStale = () => false) {
    const { tracer } = this, { width, height } = tracer;
    for (let first = 0; first < height; ) {
      const count = Math.min(height - first, Math.max(1, Math.floor((this.speed * BAND_MS) / width)));
      const before = performance.now();
      tracer.rows(this.camera, ray, first, count);
      await finished(tracer.gl);
      // Pixels for each millisecond; a band that was done at once says only that more can be done.
      const measured = (width * count) / Math.max(performance.now() - before, 1);
      this.speed = Math.min(Math.max(0.7 * this.speed + 0.3 * measured, 0.2), 4 * this.speed);
      first += count;
      if (isStale() || tracer.gl.isContextLost()) return false;
    }
    tracer.swap();
    return true;
  }

  // Width and height that can be drawn in some time.
  sizeFor(milliseconds) {
    const { width, height } = this.tracer.gl.canvas;
    return this.scaled(Math.max(48 / Math.min(width, height), Math.sqrt((this.speed * milliseconds) / (width * height))));
  }

  // Width and height of a share of the canvas.
  scaled(share) {
    const { width, height } = this.tracer.gl.canvas;
    return [width, height].map((side) => Math.max(1, Math.round(side * Math.min(1, share))));
  }

  async run() {
    let drawn = -1, frame = 0, isCoarse = false;
    const { samples } = this.tracer.scene.manifest;
    while (!this.stopped) {
      await new Promise((resolve) => requestAnimationFrame(resolve));
      if (this.held || this.stopped || this.tracer.gl.isContextLost()) continue;
      const isMoving = performance.now() - this.changedAt < SETTLED_MS, version = this.version;
      if (drawn !== version || (isCoarse && !isMoving)) {
        this.tracer.resize(...this.sizeFor(isMoving || drawn < 0 ? MOVING_MS : STILL_MS));
        frame = 0;
        isCoarse = isMoving || drawn < 0;
      } else if (!isCoarse && frame === 1 && this.tracer.width < this.tracer.gl.canvas.width) {
        this.tracer.resize(...this.scaled((2 * this.tracer.width) / this.tracer.gl.canvas.width));
        frame = 0;
      }
      if (frame >= samples * MAX_PASSES || (isCoarse && frame > 0)) continue;
      const start = performance.now(), ray = isCoarse ? { ...this.rayOf(0, samples), place: [0.5, 0.5] } : this.rayOf(frame, samples);
      this.busy = this.draw(ray, () => this.held || (!isCoarse && this.version !== version));
      if (!(await this.busy)) continue;
      this.tracer.show();
      frame++;
      drawn = version;
      this.tell({ width: this.tracer.width, height: this.tracer.height, rays: frame, ms: performance.now() - start });
    }
  }

  // Does something with the tracer, and draws nothing else meanwhile.
  async alone(task) {
    this.held = true;
    await this.busy;
    try {
      return await task();
    } finally {
      this.held = false;
      this.changed();
    }
  }

  async rays(width, height, count, samples) {
    this.tracer.resize(width, height);
    for (let frame = 0; frame < count; frame++) await this.draw(this.rayOf(frame, samples));
  }

  // Draws the whole canvas with so many rays a pixel, and nothing after it: for pictures of the page.
  async still(rays) {
    this.held = true;
    await this.busy;
    const { tracer } = this, { width, height } = tracer.gl.canvas;
    await this.rays(width, height, rays, tracer.scene.manifest.samples);
    tracer.show();
    this.tell({ width, height, rays });
  }

  // A picture of its own size, of the rays that the product takes.
  picture(width, height, samples) {
    return this.alone(async () => {
      await this.rays(width, height, samples, samples);
      return this.tracer.bytes();
    });
  }
}
