// The scene's arrays as the floats that are drawn with: they are so already, or few bits of them.

// Corners of all faces; of each object whole numbers from a corner of its box.
function vertexFloats(arrays, manifest) {
  if (arrays.vertices instanceof Float32Array) return arrays.vertices;
  const floats = new Float32Array(arrays.vertices.length);
  for (const { firstVertex, numVertices, low, step } of manifest.objects)
    for (let i = 3 * firstVertex; i < 3 * (firstVertex + numVertices); i++) floats[i] = low[i % 3] + step[i % 3] * arrays.vertices[i];
  return floats;
}

// Normals, where the shader wants them, and uv.
function vertexTable(arrays, manifest) {
  const count = arrays.uv.length / 2, table = new Float32Array(4 * count), { normals } = arrays;
  const normalScale = normals instanceof Uint32Array ? 2 / manifest.normalSteps : 0, uvScale = arrays.uv instanceof Float32Array ? 1 : 1 / manifest.uvSteps;
  for (let i = 0; i < count; i++)
    for (let axis = 0; axis < 2; axis++) {
      const code = normals ? normals[2 * i + axis] : 0;
      table[4 * i + axis] = normalScale ? code * normalScale - 1 : code;
      table[4 * i + 2 + axis] = arrays.uv[2 * i + axis] * uvScale;
    }
  return table;
}

// Texels: as they are, or in steps, each as its difference from a guess (plugins/hyaline_web/page/scene.py).
function texelTable(arrays, manifest) {
  if (arrays.texels instanceof Float32Array) return arrays.texels;
  const channels = 4 * manifest.defines.FEATURE_TEXELS, table = new Float32Array(arrays.texels.length);
  for (const [[base, size]] of manifest.objects.flatMap((object) => object.texels))
    for (let y = 0, i = channels * base; y < size; y++)
      for (let x = 0; x < size; x++)
        for (let c = 0; c < channels; c++, i++) {
          const up = y ? table[i - channels * size] : 0, left = x ? table[i - channels] : up, above = y ? up : left;
          const corner = x && y ? table[i - channels * (size + 1)] : above, least = Math.min(left, above);
          table[i] = Math.min(Math.max(left + above - corner, least), left + above - least) + unfolded(arrays.texels[i]);
        }
  for (let i = 0; i < table.length; i++) table[i] *= arrays.texelStep[0];
  return table;
}

// What metals mirror over their surface: linear, or in 8 bits of sRGB (plugins/hyaline_web/page/scene.py).
function tintTable(tints) {
  const table = new Float32Array((4 * tints.length) / 3), isLinear = tints instanceof Float32Array;
  const linear = (code) => (code <= 0.04045 ? code / 12.92 : ((code + 0.055) / 1.055) ** 2.4);
  for (let i = 0; i < tints.length; i++) table[4 * Math.floor(i / 3) + (i % 3)] = isLinear ? tints[i] : linear(tints[i] / 255);
  return table;
}
