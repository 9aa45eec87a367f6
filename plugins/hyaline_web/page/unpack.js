// The scene's arrays: base64 of a zlib stream, in which the bytes of each array lie sorted by their place in a number.

const KINDS = { uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, float32: Float32Array, float64: Float64Array };

function decodeBase64(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const binary = atob(text), bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Each listed array: {name, dtype, shape, differences}. Numbers lie by their last axis, then by their bytes.
function sortBack(bytes, offset, entry) {
  const kind = KINDS[entry.dtype], width = kind.BYTES_PER_ELEMENT;
  const count = entry.shape.reduce((a, b) => a * b, 1);
  const last = entry.shape.length > 1 ? entry.shape[entry.shape.length - 1] : 1, rows = last ? count / last : 0;
  const raw = new Uint8Array(count * width);
  for (let c = 0; c < last; c++)
    for (let b = 0; b < width; b++, offset += rows)
      for (let r = 0, to = c * width + b; r < rows; r++, to += last * width) raw[to] = bytes[offset + r];
  const values = new kind(raw.buffer);
  if (entry.differences) for (let i = 0; i < count; i++) values[i] = unfolded(values[i]) + (i < last ? 0 : values[i - last]);
  return values;
}

// 0, 1, 2, 3, 4, ... as 0, -1, 1, -2, 2, ...
function unfolded(code) {
  return (code >>> 1) ^ -(code & 1);
}

async function unpack(entries, text) {
  const bytes = await inflate(decodeBase64(text.trim())), arrays = {};
  let offset = 0;
  for (const entry of entries) {
    arrays[entry.name] = sortBack(bytes, offset, entry);
    offset += arrays[entry.name].byteLength;
    await pause();
  }
  if (offset !== bytes.length) throw new Error("the scene in this page is damaged");
  return arrays;
}

// Lets the page answer.
function pause() {
  return new Promise((resolve) => setTimeout(resolve, 0));
}
