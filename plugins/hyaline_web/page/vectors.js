// Vectors and rotations: lists of three numbers, and of three rows of them.

const UNIT_AXES = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];

const add = (a, b, scale = 1) => a.map((value, axis) => value + scale * b[axis]);
const dot = (a, b) => a.reduce((sum, value, axis) => sum + value * b[axis], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const norm = (a) => Math.sqrt(dot(a, a));
const unit = (a) => a.map((value) => value / norm(a));
const radians = (degrees) => (degrees * Math.PI) / 180;

function rotate(vector, axis, angle) {
  const cos = Math.cos(angle), sin = Math.sin(angle), along = dot(axis, vector) * (1 - cos), side = cross(axis, vector);
  return vector.map((value, i) => value * cos + side[i] * sin + axis[i] * along);
}

// Rows of the rotation by angles in degrees about x, then about y, then about z.
function turnOf(angles) {
  const columns = UNIT_AXES.map((vector) => angles.reduce((turned, angle, axis) => rotate(turned, UNIT_AXES[axis], radians(angle)), vector));
  return UNIT_AXES.map((_, row) => columns.map((column) => column[row]));
}
