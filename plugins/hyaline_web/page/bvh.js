// Trees of boxes: over the faces of an object, in its own space, and over the objects in the world.
//
// A node is 16 numbers, a box and what it holds, twice: low (3), first face or next node, high (3), faces or 0.

const BINS = 12, LEAF = 4, DEPTH = 30, TOP_NODES = 512;

function emptyBox() {
  return [Infinity, Infinity, Infinity, -Infinity, -Infinity, -Infinity];
}

function halfArea(box) {
  const x = box[3] - box[0], y = box[4] - box[1], z = box[5] - box[2];
  return x < 0 ? 0 : x * y + y * z + z * x;
}

function grow(box, boxes, at) {
  for (let axis = 0; axis < 3; axis++) {
    if (boxes[at + axis] < box[axis]) box[axis] = boxes[at + axis];
    if (boxes[at + 3 + axis] > box[3 + axis]) box[3 + axis] = boxes[at + 3 + axis];
  }
}

// The tree over boxes (6 numbers each): its nodes, numbered from `firstNode`, and the order of the boxes in its leaves,
// which count from `firstItem`; leaves of the tree over objects hold one each, named by its own number.
function buildTree(boxes, count, firstNode, firstItem, leaf) {
  const order = new Uint32Array(count), nodes = [];
  for (let i = 0; i < count; i++) order[i] = i;

  function split(begin, end, depth) {
    const centers = emptyBox();
    for (let i = begin; i < end; i++)
      for (let axis = 0; axis < 3; axis++) {
        const center = boxes[6 * order[i] + axis] + boxes[6 * order[i] + 3 + axis];
        if (center < centers[axis]) centers[axis] = center;
        if (center > centers[3 + axis]) centers[3 + axis] = center;
      }
    const levels = Math.ceil(Math.log2((end - begin) / leaf)) + 1;
    let best = { cost: Infinity, axis: -1, bin: 0 };
    if (depth + levels < DEPTH) best = cheapestSplit(begin, end, centers);
    let middle = begin;
    if (best.axis >= 0) {
      const scale = BINS / (centers[3 + best.axis] - centers[best.axis]);
      for (let i = begin; i < end; i++)
        if (binOf(order[i], best.axis, centers, scale) <= best.bin) {
          const other = order[middle];
          order[middle++] = order[i];
          order[i] = other;
        }
    }
    if (middle === begin || middle === end) {
      // No plane parts them, or the tree is deep already: halves by the widest axis.
      const extent = [0, 1, 2].map((axis) => centers[3 + axis] - centers[axis]);
      const axis = extent.indexOf(Math.max(...extent));
      const center = (item) => boxes[6 * item + axis] + boxes[6 * item + 3 + axis];
      order.subarray(begin, end).sort((a, b) => center(a) - center(b) || a - b);
      middle = (begin + end) >> 1;
    }
    return middle;
  }

  function binOf(item, axis, centers, scale) {
    const place = (boxes[6 * item + axis] + boxes[6 * item + 3 + axis] - centers[axis]) * scale;
    return Math.min(BINS - 1, Math.floor(place));
  }

  function cheapestSplit(begin, end, centers) {
    const best = { cost: Infinity, axis: -1, bin: 0 };
    for (let axis = 0; axis < 3; axis++) {
      const extent = centers[3 + axis] - centers[axis];
      if (!(extent > 0)) continue;
      const counts = new Uint32Array(BINS), bins = Array.from({ length: BINS }, emptyBox);
      for (let i = begin; i < end; i++) {
        const bin = binOf(order[i], axis, centers, BINS / extent);
        counts[bin]++;
        grow(bins[bin], boxes, 6 * order[i]);
      }
      const right = new Float64Array(BINS), rest = emptyBox();
      for (let bin = BINS - 1, after = 0; bin > 0; bin--) {
        grow(rest, bins[bin], 0);
        after += counts[bin];
        right[bin - 1] = after * halfArea(rest);
      }
      const left = emptyBox();
      for (let bin = 0, before = 0; bin < BINS - 1; bin++) {
        grow(left, bins[bin], 0);
        before += counts[bin];
        const cost = before * halfArea(left) + right[bin];
        if (before && before < end - begin && cost < best.cost) Object.assign(best, { cost, axis, bin });
      }
    }
    return best;
  }

  // Writes what a box holds into one half of a node.
  function hold(at, begin, end, depth) {
    const box = emptyBox();
    for (let i = begin; i < end; i++) grow(box, boxes, 6 * order[i]);
    if (begin === end) box.fill(1e30, 0, 3), box.fill(-1e30, 3, 6);
    const isLeaf = end - begin <= leaf;
    const next = !isLeaf ? node(begin, end, depth) : leaf === 1 && end > begin ? order[begin] : firstItem + begin;
    for (let axis = 0; axis < 3; axis++) (nodes[at + axis] = box[axis]), (nodes[at + 4 + axis] = box[3 + axis]);
    nodes[at + 3] = next;
    nodes[at + 7] = isLeaf ? end - begin : 0;
  }

  function node(begin, end, depth) {
    const at = nodes.length;
    for (let i = 0; i < 16; i++) nodes.push(0);
    const middle = end - begin <= leaf ? end : split(begin, end, depth);
    hold(at, begin, middle, depth + 1);
    hold(at + 8, middle, end, depth + 1);
    return firstNode + at / 16;
  }

  node(0, count, 0);
  return { nodes, order };
}

// The boxes of an object's faces; `faces` counts its vertices from 0.
function faceBoxes(positions, faces) {
  const count = faces.length / 3, boxes = new Float32Array(6 * count);
  for (let face = 0; face < count; face++)
    for (let axis = 0; axis < 3; axis++) {
      const [a, b, c] = [0, 1, 2].map((corner) => positions[3 * faces[3 * face + corner] + axis]);
      boxes[6 * face + axis] = Math.min(a, b, c);
      boxes[6 * face + 3 + axis] = Math.max(a, b, c);
    }
  return boxes;
}

// All objects' trees behind the room for the upper ones, faces in the order of the leaves: what textures hold.
async function buildTrees(scene) {
  const { manifest, arrays } = scene;
  const nodes = [], roots = [], bounds = [], triangles = new Float32Array(12 * (arrays.faces.length / 3));
  for (const object of manifest.objects) {
    const positions = arrays.vertices.subarray(3 * object.firstVertex, 3 * (object.firstVertex + object.numVertices));
    const faces = arrays.faces.subarray(3 * object.firstFace, 3 * (object.firstFace + object.numFaces));
    const boxes = faceBoxes(positions, faces), box = emptyBox();
    for (let at = 0; at < boxes.length; at += 6) grow(box, boxes, at);
    bounds.push(box);
    roots.push(2 * TOP_NODES + nodes.length / 16);
    const tree = buildTree(boxes, faces.length / 3, 2 * TOP_NODES + nodes.length / 16, object.firstFace, LEAF);
    for (const value of tree.nodes) nodes.push(value);
    tree.order.forEach((face, place) => {
      for (let corner = 0; corner < 3; corner++) {
        const vertex = faces[3 * face + corner], at = 12 * (object.firstFace + place) + 4 * corner;
        triangles.set(positions.subarray(3 * vertex, 3 * vertex + 3), at);
        triangles[at + 3] = object.firstVertex + vertex;
      }
    });
    await pause();
  }
  return { nodes: new Float32Array(nodes), roots, bounds, triangles };
}

// The tree over some rows of the table of objects, given with their boxes in the world.
function buildTopTree(rows, firstNode) {
  const names = [...rows.keys()], packed = new Float32Array(6 * names.length);
  names.forEach((name, place) => packed.set(rows.get(name), 6 * place));
  const { nodes } = buildTree(packed, names.length, firstNode, 0, 1);
  for (let at = 0; at < nodes.length; at += 8) if (nodes[at + 7]) nodes[at + 3] = names[nodes[at + 3]];
  return new Float32Array(nodes);
}
