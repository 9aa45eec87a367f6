// Drawing with WebGL2: the scene in textures, and frames of one ray a pixel that add up.

const TEXTURE_WIDTH = 2048, EVENTS = { ends: 0, refracts: 1, passes: 2, coated: 3, mirrors: 4 };

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
    const { gl } = this, { defines } = this.scene.manifest;
    gl.getExtension("EXT_color_buffer_float");  // It is lost with the graphics processor.
    const lines = Object.entries({ ...defines, TEXTURE_WIDTH, STACK: 2 * DEPTH + 2 }).map(([name, value]) => `#define ${name} ${value}`);
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
    const { gl, trees } = this, { arrays, manifest } = this.scene;
    const nodes = new Float32Array(16 * TOP_NODES + trees.nodes.length);
    nodes.set(trees.nodes, 16 * TOP_NODES);
    this.nodes = this.table(0, gl.RGBA32F, nodes);
    this.table(1, gl.RGBA32F, trees.triangles);
    this.table(2, gl.RGBA32F, vertexTable(arrays));
    this.objectWidth = 7 + manifest.defines.LEVELS;
    this.objectTable = new Float32Array(4 * this.objectWidth * manifest.objects.length);
    this.objects = makeTexture(gl, 3, gl.RGBA32F, this.objectWidth, manifest.objects.length, this.objectTable);
    this.table(4, manifest.quality === "exact" ? gl.RGBA32F : gl.RGBA16F, texelTable(arrays, manifest));
    this.table(5, gl.RGBA32F, arrays.weights);
  }

  // A texture of as many rows as it takes.
  table(unit, format, values) {
    const { gl } = this, height = Math.max(1, Math.ceil(values.length / (4 * TEXTURE_WIDTH)));
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("The scene is larger than this device's textures.");
    const padded = new Float32Array(4 * TEXTURE_WIDTH * height);
    padded.set(values);
    return makeTexture(gl, unit, format, TEXTURE_WIDTH, height, padded);
  }

  // What may change: where objects stand, which are shown, what they do to light.
  place(objects) {
    const { gl, trees } = this, { manifest } = this.scene, table = this.objectTable, row = 4 * this.objectWidth;
    table.fill(0);
    objects.forEach((object, index) => {
      const at = index * row, { turn, shift } = worldFromObject(object, trees.bounds[index]);
      for (let axis = 0; axis < 3; axis++) table.set([...turn[axis], shift[axis]], at + 4 * axis);
      table.set([EVENTS[object.event], object.ior, object.roughness, object.rank], at + 12);
      table.set([...object.color, 0], at + 16);
      table.set([trees.roots[index], 0, 0, 0], at + 20);
      if (object.rank >= 0) table.set([object.mediumIor, ...object.absorption], object.rank * row + 24);
      manifest.objects[index].texels.forEach(([base, size], level) => table.set([base, size, 0, 0], at + 28 + 4 * level));
    });
    gl.activeTexture(gl.TEXTURE3);
    gl.bindTexture(gl.TEXTURE_2D, this.objects);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, this.objectWidth, objects.length, gl.RGBA, gl.FLOAT, table);
    const shown = objects.map((_, index) => index).filter((index) => objects[index].shown && manifest.objects[index].numFaces);
    const boxes = objects.map((object, index) => worldBox(object, trees.bounds[index]));
    const top = new Float32Array(4 * TEXTURE_WIDTH);
    top.set(buildTopTree(boxes, shown));
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.nodes);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, 1, gl.RGBA, gl.FLOAT, top);
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
    this.aim(this.sums[1], camera, width, height, focalLength(camera, width, height), ray, 0);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, first, width, count);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
  }

  // The object at a point of a picture of some size, and its distance; null where there is none.
  pick(camera, x, y, width, height) {
    const { gl } = this, found = new Float32Array(4), target = makeTexture(gl, 7, gl.RGBA32F, 1, 1, null);
    const ray = { place: [x - 0.5 * width + 0.5, y - 0.5 * height + 0.5], chunk: 1, samples: 1, sample: 0, seed: 0, isFirst: true };
    this.aim(target, camera, 1, 1, focalLength(camera, width, height), ray, 1);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, found);
    gl.deleteTexture(target);
    return found[0] < 0 ? null : { object: found[0], distance: found[1] };
  }

  aim(target, camera, width, height, focal, ray, task) {
    const { gl } = this, { program, places } = this.tracing;
    gl.useProgram(program);
    ["nodes", "triangles", "vertices", "objects", "texels", "weights", "before"].forEach((name, unit) => gl.uniform1i(places[name], unit));
    gl.uniform3fv(places.camera_place, camera.place);
    gl.uniformMatrix3fv(places.camera_turn, false, camera.turn);
    gl.uniform1f(places.focal, focal);
    gl.uniform2f(places.size, width, height);
    gl.uniform2f(places.place, ...ray.place);
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

// The lens is that of the dataset's square pictures, which the shorter side of the page shows whole.
function focalLength(camera, width, height) {
  return (0.5 * Math.min(width, height)) / Math.tan(0.5 * camera.fov);
}

function vertexTable(arrays) {
  const count = arrays.uv.length / 2, table = new Float32Array(4 * count);
  const normalScale = arrays.normals instanceof Float32Array ? 0 : 2 / 0xfffffe, uvScale = arrays.uv instanceof Float32Array ? 1 : 1 / 65535;
  for (let i = 0; i < count; i++)
    for (let axis = 0; axis < 2; axis++) {
      const code = arrays.normals[2 * i + axis];
      table[4 * i + axis] = normalScale ? code * normalScale - 1 : code;
      table[4 * i + 2 + axis] = arrays.uv[2 * i + axis] * uvScale;
    }
  return table;
}

// Texels as floats: they are so already, or bytes with a scale for each channel of each object.
function texelTable(arrays, manifest) {
  if (arrays.texels instanceof Float32Array) return arrays.texels;
  const channels = 4 * manifest.defines.FEATURE_TEXELS, table = new Float32Array(arrays.texels.length);
  manifest.objects.forEach((object, index) => {
    const [base, size] = object.texels[0];
    for (let i = channels * base; i < channels * (base + size * size); i++) {
      const at = index * channels + (i % channels);
      table[i] = arrays.texelLow[at] + arrays.texelStep[at] * arrays.texels[i];
    }
  });
  return table;
}

// Rows of the rotation and the shift of an object that was turned about its middle, by an angle around the vertical.
function worldFromObject(object, bounds) {
  const cos = Math.cos(object.angle), sin = Math.sin(object.angle);
  const turn = [[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]];
  if (!object.angle) return { turn, shift: object.offset };
  const middle = [0, 1, 2].map((axis) => 0.5 * (bounds[axis] + bounds[axis + 3]));
  const turned = turn.map((row) => row.reduce((sum, value, axis) => sum + value * middle[axis], 0));
  return { turn, shift: object.offset.map((value, axis) => value + middle[axis] - turned[axis]) };
}

function worldBox(object, bounds) {
  const { turn, shift } = worldFromObject(object, bounds), box = emptyBox();
  for (let corner = 0; corner < 8; corner++) {
    const point = [0, 1, 2].map((axis) => bounds[axis + (corner & (1 << axis) ? 3 : 0)]);
    // A little wider: boxes are kept as floats.
    turn.forEach((row, axis) => {
      const value = row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + shift[axis], slack = 1e-6 * (1 + Math.abs(value));
      box[axis] = Math.min(box[axis], value - slack);
      box[axis + 3] = Math.max(box[axis + 3], value + slack);
    });
  }
  return box;
}
