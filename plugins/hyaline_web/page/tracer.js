// Drawing with WebGL2: the scene in textures, and frames of one ray a pixel that add up.

const TEXTURE_WIDTH = 2048;
const TASKS = { picture: 0, layers: 1, path: 2 };
const TINTS_UNIT = 8;  // What is drawn into is bound to 7.

const CORNERS = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0); }`;

// The mean of all frames, as sRGB; between the pixels of a smaller picture, linear.
const SHOW = `#version 300 es
precision highp float;
uniform highp sampler2D sum;
uniform vec2 size;
out vec4 color;
void main() {
    ivec2 last = textureSize(sum, 0) - 1;
    vec2 at = clamp(gl_FragCoord.xy / size * vec2(last + 1) - 0.5, vec2(0.0), vec2(last));
    ivec2 low = ivec2(at), high = min(low + 1, last);
    at -= vec2(low);
    vec4 below = mix(texelFetch(sum, low, 0), texelFetch(sum, ivec2(high.x, low.y), 0), at.x);
    vec4 above = mix(texelFetch(sum, ivec2(low.x, high.y), 0), texelFetch(sum, high, 0), at.x);
    vec4 total = mix(below, above, at.y);
    vec3 linear = clamp(total.rgb / max(total.a, 1.0), 0.0, 1.0);
    vec3 curved = 1.055 * pow(max(linear, 0.0031308), vec3(1.0 / 2.4)) - 0.055;
    color = vec4(mix(curved, 12.92 * linear, vec3(lessThanEqual(linear, vec3(0.0031308)))), 1.0);
}`;

// What is asked of the browser; the message tells what is missing.
function openWebGl(canvas) {
  const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
  if (!gl) throw new Error("This browser offers no WebGL 2, with which the scene is drawn.");
  if (!gl.getExtension("EXT_color_buffer_float"))
    throw new Error("This browser cannot draw into float textures (EXT_color_buffer_float), which the scene needs.");
  return gl;
}

async function compile(gl, fragment) {
  const parallel = gl.getExtension("KHR_parallel_shader_compile"), program = gl.createProgram();
  const shaders = [[gl.VERTEX_SHADER, CORNERS], [gl.FRAGMENT_SHADER, fragment]].map(([kind, text]) => {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    return shader;
  });
  gl.linkProgram(program);
  while (parallel && !gl.isContextLost() && !gl.getProgramParameter(program, parallel.COMPLETION_STATUS_KHR))
    await new Promise((resolve) => setTimeout(resolve, 20));
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost())
    throw new Error(`The shader does not compile here: ${shaders.map((shader) => gl.getShaderInfoLog(shader)).join(" ")}`);
  const places = {};
  const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) || 0;
  for (let i = 0; i < count; i++) {
    const { name } = gl.getActiveUniform(program, i);
    places[name] = gl.getUniformLocation(program, name);
  }
  return { program, places };
}

function makeTexture(gl, unit, format, width, height, values) {
  const texture = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  for (const [key, value] of [["MIN_FILTER", gl.NEAREST], ["MAG_FILTER", gl.NEAREST], ["WRAP_S", gl.CLAMP_TO_EDGE], ["WRAP_T", gl.CLAMP_TO_EDGE]])
    gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${key}`], value);
  gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, gl.RGBA, gl.FLOAT, values);
  return texture;
}

// Resolves when the graphics processor has done all that it was told.
function finished(gl) {
  const sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
  gl.flush();
  return new Promise((resolve) => {
    const poll = () => {
      if (!gl.isContextLost() && gl.clientWaitSync(sync, 0, 0) === gl.TIMEOUT_EXPIRED) setTimeout(poll, 1);
      else gl.deleteSync(sync), resolve();
    };
    setTimeout(poll, 0);
  });
}

class Tracer {
  constructor(gl, scene, trees, source) {
    Object.assign(this, { gl, scene, trees, source });
  }

  async start() {
    const { gl } = this;
    gl.getExtension("EXT_color_buffer_float");  // It is lost with the graphics processor.
    const lines = Object.entries({ TEXTURE_WIDTH, STACK: 2 * DEPTH + 2, OBJECTS_ROOT: 0, SHELLS_ROOT: TOP_NODES }).map(([name, value]) => `#define ${name} ${value}`);
    const precision = "precision highp float;\nprecision highp int;\nprecision highp sampler2D;";
    this.tracing = await compile(gl, ["#version 300 es", precision, ...lines, this.source].join("\n"));
    this.showing = await compile(gl, SHOW);
    gl.bindVertexArray(gl.createVertexArray());
    this.fill();
    this.frame = gl.createFramebuffer();
    this.sums = null;
  }

  // All that does not change, in textures; the order is that of the units.
  fill() {
    const { gl } = this, { arrays, manifest } = this.scene;
    this.nodes = this.triangles = null;
    this.fillTrees();
    this.table(2, gl.RGBA32F, vertexTable(arrays, manifest));
    this.shells = manifest.shells;
    this.capacity = manifest.objects.length + MAX_COPIES;
    this.objectWidth = 8 + manifest.defines.LEVELS + manifest.defines.RELIEF;
    this.objectRows = this.capacity * this.shells;
    this.objectTable = new Float32Array(4 * this.objectWidth * this.objectRows);
    this.objects = makeTexture(gl, 3, gl.RGBA32F, this.objectWidth, this.objectRows, this.objectTable);
    this.table(4, manifest.quality === "exact" ? gl.RGBA32F : gl.RGBA16F, texelTable(arrays, manifest));
    this.table(5, gl.RGBA32F, arrays.weights);
    if (manifest.defines.TINTS) this.table(TINTS_UNIT, gl.RGBA32F, tintTable(arrays.tints));
  }

  fillTrees() {
    const { gl, trees } = this, nodes = new Float32Array(32 * TOP_NODES + trees.nodes.length);
    nodes.set(trees.nodes, 32 * TOP_NODES);
    gl.deleteTexture(this.nodes), gl.deleteTexture(this.triangles);
    this.nodes = this.table(0, gl.RGBA32F, nodes);
    this.triangles = this.table(1, gl.RGBA32F, trees.triangles);
  }

  // A texture of as many rows as it takes.
  table(unit, format, values) {
    const { gl } = this, height = Math.max(1, Math.ceil(values.length / (4 * TEXTURE_WIDTH)));
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("The scene is larger than this device's textures.");
    const padded = new Float32Array(4 * TEXTURE_WIDTH * height);
    padded.set(values);
    return makeTexture(gl, unit, format, TEXTURE_WIDTH, height, padded);
  }

  get followsLight() {
    return this.scene.manifest.followsLight;
  }

  // What may change: where objects stand, which are shown, what they do to light.
  place(objects) {
    const { gl, trees } = this, { manifest } = this.scene, table = this.objectTable, row = 4 * this.objectWidth;
    const ranks = mediumRanks(objects);
    table.fill(0);
    objects.forEach((object, index) => {
      const bounds = trees.bounds[object.of], { texels, relief } = manifest.objects[object.of];
      // A shell is the object again, smaller about the same middle, with texels of its own.
      for (let shell = 0; shell < this.shells; shell++) {
        const scale = 1 - shell / this.shells, { turn, shift } = worldFromObject(object, bounds, scale);
        const at = (shell * this.capacity + index) * row;
        for (let axis = 0; axis < 3; axis++) table.set([...turn[axis], shift[axis]], at + 4 * axis);
        table.set([manifest.defines[object.event.toUpperCase()], object.ior, object.roughness, ranks[index]], at + 12);
        const [firstTint, ...tintSize] = object.tint || [0, 0, 0];
        table.set([...object.color, firstTint], at + 16);
        table.set([trees.roots[object.of], scale, ...tintSize], at + 20);
        [...texels[shell], ...(relief ? [relief[shell]] : [])].forEach((place, level) => table.set(place, at + 32 + 4 * level));
      }
      if (ranks[index] < 0) return;
      const iors = object.spread.map((value) => object.mediumIor + value);
      table.set([...iors, Number(object.spread.some(Boolean)), ...object.absorption], ranks[index] * row + 24);
    });
    gl.activeTexture(gl.TEXTURE3);
    gl.bindTexture(gl.TEXTURE_2D, this.objects);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, this.objectWidth, this.objectRows, gl.RGBA, gl.FLOAT, table);
    this.placeTrees(objects);
  }

  // The trees over the objects that are shown: of the outermost shells, which light paths meet, and of all.
  placeTrees(objects) {
    const { gl, trees } = this, { manifest } = this.scene, tops = new Float32Array(8 * TEXTURE_WIDTH);
    const shown = objects.map((_, index) => index).filter((index) => objects[index].shown && manifest.objects[objects[index].of].numFaces);
    for (let top = 0; top < 2; top++) {
      const rows = new Map();
      for (let shell = 0; shell < (top ? this.shells : 1); shell++)
        for (const index of shown)
          rows.set(shell * this.capacity + index, worldBox(objects[index], trees.bounds[objects[index].of], 1 - shell / this.shells));
      tops.set(buildTopTree(rows, top * TOP_NODES), 4 * TEXTURE_WIDTH * top);
    }
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.nodes);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, 2, gl.RGBA, gl.FLOAT, tops);
  }

  resize(width, height) {
    if (this.sums && this.width === width && this.height === height) return;
    const { gl } = this;
    for (const old of this.sums || []) gl.deleteTexture(old);
    this.sums = [6, 6].map((unit) => makeTexture(gl, unit, gl.RGBA32F, width, height, null));
    Object.assign(this, { width, height });
  }

  // Draws one ray for the pixels of some rows, counted from below, into the sum that is not shown.
  rows(camera, ray, first, count) {
    const { gl, width, height } = this;
    gl.activeTexture(gl.TEXTURE6);
    gl.bindTexture(gl.TEXTURE_2D, this.sums[0]);
    this.aim(this.sums[1], camera, width, height, focalLength(camera, width, height), ray, TASKS.picture);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, first, width, count);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
  }

  // The answer to a task of the shader about the ray through a point of a picture of some size: `count` times four
  // numbers.
  ask(task, count, camera, x, y, width, height) {
    const { gl } = this, found = new Float32Array(4 * count), target = makeTexture(gl, 7, gl.RGBA32F, count, 1, null);
    const ray = { place: [x - 0.5 * width + 0.5 * count, y - 0.5 * height + 0.5], chunk: 1, samples: 1, sample: 0, seed: 0, isFirst: true };
    this.aim(target, camera, count, 1, focalLength(camera, width, height), ray, task);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.readPixels(0, 0, count, 1, gl.RGBA, gl.FLOAT, found);
    gl.deleteTexture(target);
    return Array.from({ length: count }, (_, index) => [...found.subarray(4 * index, 4 * index + 4)]);
  }

  // The object that is seen there, and its distance; null where there is none.
  pick(camera, ...at) {
    return this.layers(camera, 1, ...at)[0] || null;
  }

  // All that the straight ray meets, nearest first.
  layers(camera, most, ...at) {
    const d = camera.through(...at);
    return this.ask(TASKS.layers, most, camera, ...at).filter(([object]) => object >= 0)
      .map(([object, distance]) => ({ object, distance, point: add(camera.place, d, distance) }));
  }

  // The segments of the light path, branch by branch; of each the object that it meets (-1: none), and what share of
  // the light there comes through.
  lightPath(camera, most, ...at) {
    const found = this.ask(TASKS.path, 2 * most, camera, ...at), segments = [];
    for (let index = 0; index < found.length; index += 2) {
      const [start, end] = [found[index], found[index + 1]], branch = Math.floor(start[3]);
      if (branch < 0) break;
      segments.push({ from: start.slice(0, 3), to: end.slice(0, 3), branch, object: end[3], share: 2 * (start[3] - branch) });
    }
    return segments;
  }

  aim(target, camera, width, height, focal, ray, task) {
    const { gl } = this, { program, places } = this.tracing;
    gl.useProgram(program);
    ["nodes", "triangles", "vertices", "objects", "texels", "weights", "before"].forEach((name, unit) => gl.uniform1i(places[name], unit));
    gl.uniform1i(places.tints, TINTS_UNIT);
    gl.uniform3fv(places.camera_place, camera.place);
    gl.uniformMatrix3fv(places.camera_turn, false, camera.turn);
    gl.uniform1f(places.focal, focal);
    gl.uniform2f(places.size, width, height);
    gl.uniform2f(places.in_pixel, ...ray.place.map((value, axis) => value - focal * camera.lens.shift[axis]));
    for (const name of ["chunk", "samples", "seed"]) gl.uniform1ui(places[name], ray[name]);
    gl.uniform1ui(places.ray_sample, ray.sample);
    gl.uniform1f(places.keep, ray.isFirst ? 0 : 1);
    gl.uniform1i(places.task, task);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
    gl.viewport(0, 0, width, height);
  }

  swap() {
    this.sums.reverse();
  }

  // Shows the sum in the canvas, or draws it into a texture of bytes.
  show(target = null, width = this.gl.canvas.width, height = this.gl.canvas.height) {
    const { gl } = this, { program, places } = this.showing;
    gl.useProgram(program);
    gl.activeTexture(gl.TEXTURE6);
    gl.bindTexture(gl.TEXTURE_2D, this.sums[0]);
    gl.uniform1i(places.sum, 6);
    gl.uniform2f(places.size, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, width, height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // The picture as bytes, red, green, blue and 255, rows from above.
  bytes() {
    const { gl, width, height } = this, target = gl.createFramebuffer(), texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE7);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    this.show(target, width, height);
    const below = new Uint8Array(4 * width * height), above = new Uint8Array(below.length);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, below);
    for (let y = 0; y < height; y++) above.set(below.subarray(4 * width * y, 4 * width * (y + 1)), 4 * width * (height - 1 - y));
    gl.deleteFramebuffer(target), gl.deleteTexture(texture);
    return above;
  }
}
