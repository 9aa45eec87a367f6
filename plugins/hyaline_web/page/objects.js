// The objects as they stand now: which are shown, where, and of which material; copies of them; and all that as text.

const MAX_COPIES = 32;
const OPTICS = ["event", "ior", "roughness", "color", "tint", "priority", "mediumIor", "spread", "absorption"];

class Objects {
  constructor(manifest) {
    this.listed = manifest.objects;
    this.knowsMaterials = manifest.followsLight;
    this.maxSolids = manifest.defines.NESTED ? manifest.defines.MAX_NESTED : Infinity;
    this.materials = this.knowsMaterials ? knownMaterials(manifest) : [];
    this.reset();
  }

  reset() {
    this.all = this.listed.map((item, index) => this.fresh(index, item.name));
  }

  // An object as it was learned; `of` is the one whose shape and texels it has.
  fresh(of, name) {
    const item = this.listed[of];
    return {
      of, name, shown: item.numFaces > 0, offset: [0, 0, 0], turn: [0, 0, 0],
      material: this.materials.findIndex((known) => isSame(known, item)), ...opticsOf(item),
    };
  }

  isCopy(index) {
    return index >= this.listed.length;
  }

  // Puts a copy beside an object, which stays; its index. Undefined where there is no room for one.
  copy(index, step) {
    const original = this.all[index];
    if (this.all.length >= this.listed.length + MAX_COPIES || !this.hasRoomFor(original)) return undefined;
    const name = freeName(this.listed[original.of].name, this.all);
    const shown = this.listed[original.of].numFaces > 0;
    this.all.push({ ...structuredClone(original), name, shown, offset: add(original.offset, step) });
    return this.all.length - 1;
  }

  // Takes a copy away; an object of the scene is hidden.
  remove(index) {
    if (this.isCopy(index)) this.all.splice(index, 1);
    else this.all[index].shown = false;
  }

  // A ray keeps one bit for each solid that it may be in.
  hasRoomFor(optics) {
    return optics.priority === null || this.all.filter((item) => item.priority !== null).length < this.maxSolids;
  }

  // The places, among those that are known, of the materials that an object may be made of. The texture of a metal lies
  // in the uv of its own shape, and fits no other.
  materialsFor(index) {
    const item = this.all[index], { isClosed: isSolid, tint } = this.listed[item.of];
    return this.materials.map((_, place) => place).filter((place) => {
      const known = this.materials[place];
      if (known.tint && String(known.tint) !== String(tint)) return false;
      return place === item.material || known.priority === null || (isSolid && (item.priority !== null || this.hasRoomFor(known)));
    });
  }

  wear(index, material) {
    Object.assign(this.all[index], opticsOf(this.materials[material]), { material });
  }

  // ---- As text: what differs from the page as it opens

  write(parts) {
    // Copies go by the names that `read` gives them: an earlier copy may have been taken away.
    const named = this.all.slice(0, this.listed.length);
    for (const item of this.all.slice(this.listed.length)) {
      const original = this.listed[item.of].name;
      parts.append("copy", original);
      named.push({ name: freeName(original, named) });
    }
    this.all.forEach((item, index) => {
      const text = textOf(item);
      if (this.isCopy(index) || text !== textOf(this.fresh(item.of, item.name))) parts.set(keyOf(named[index].name), text);
    });
  }

  read(parts) {
    this.reset();
    for (const name of parts.getAll("copy").slice(0, MAX_COPIES)) {
      const of = this.listed.findIndex((item) => item.name === name);
      if (of >= 0) this.all.push(this.fresh(of, freeName(name, this.all)));
    }
    this.all.forEach((item, index) => this.readOne(index, (parts.get(keyOf(item.name)) || "").split(" ").map(Number)));
  }

  readOne(index, numbers) {
    const [shown, x, y, z, turnX, turnY, turnZ, material, ior, mediumIor, red, green, blue] = numbers;
    if (blue === undefined || !numbers.every(Number.isFinite)) return;
    if (this.materialsFor(index).includes(material)) this.wear(index, material);
    const change = { shown: shown === 1, offset: [x, y, z], turn: [turnX, turnY, turnZ], ior, mediumIor, absorption: [red, green, blue] };
    Object.assign(this.all[index], change);
  }
}

// An object may have the name of one of the link's own keys.
const keyOf = (name) => (name === "view" || name === "copy" ? `${name}.` : name);

function freeName(name, items) {
  let count = 1;
  while (items.some((item) => item.name === `${name}_copy${count}`)) count++;
  return `${name}_copy${count}`;
}

const short = (value) => Number(value.toPrecision(6)).toString();

function textOf(item) {
  return [item.shown ? 1 : 0, ...item.offset, ...item.turn, item.material, item.ior, item.mediumIor, ...item.absorption].map(short).join(" ");
}

function opticsOf(item) {
  return structuredClone(Object.fromEntries(OPTICS.map((key) => [key, item[key]])));
}

function isSame(one, other) {
  return JSON.stringify(opticsOf(one)) === JSON.stringify(opticsOf(other));
}

// Each material once: what edits make of objects, then the others, called by the first object that is made of each.
function knownMaterials({ edits, objects }) {
  const known = [];
  for (const item of [...edits, ...objects])
    if (!known.some((other) => isSame(other, item))) known.push({ ...opticsOf(item), name: item.name });
  return known;
}

// The place of each object among the solids, in the order in which they fill space; -1 for what is none.
// Source: datagen/scene/media.py.
function mediumRanks(objects) {
  const ranks = objects.map(() => -1);
  objects.map((_, index) => index).filter((index) => objects[index].priority !== null)
    .sort((a, b) => objects[b].priority - objects[a].priority || a - b).forEach((index, rank) => (ranks[index] = rank));
  return ranks;
}

// The middle of an object's box where it stands now; `bounds` are those of its shape.
function middleOf(object, bounds) {
  return [0, 1, 2].map((axis) => 0.5 * (bounds[axis] + bounds[axis + 3]) + object.offset[axis]);
}

// Rows of the rotation (times the scale), and the shift, of an object that was turned, and made smaller, about its
// middle.
function worldFromObject(object, bounds, scale = 1) {
  if (scale === 1 && !object.turn.some(Boolean)) return { turn: UNIT_AXES, shift: object.offset };
  const turn = turnOf(object.turn).map((row) => row.map((value) => scale * value)), middle = middleOf({ offset: [0, 0, 0] }, bounds);
  return { turn, shift: object.offset.map((value, axis) => value + middle[axis] - dot(turn[axis], middle)) };
}

// The box of an object in the world.
function worldBox(object, bounds, scale) {
  const { turn, shift } = worldFromObject(object, bounds, scale), box = emptyBox();
  for (let corner = 0; corner < 8; corner++) {
    const point = [0, 1, 2].map((axis) => bounds[axis + (corner & (1 << axis) ? 3 : 0)]);
    // A little wider: boxes are kept as floats.
    turn.forEach((row, axis) => {
      const value = dot(row, point) + shift[axis], slack = 1e-6 * (1 + Math.abs(value));
      box[axis] = Math.min(box[axis], value - slack);
      box[axis + 3] = Math.max(box[axis + 3], value + slack);
    });
  }
  return box;
}
