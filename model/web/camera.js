// A camera that turns about a point: its place, its right, upper and backward directions, and its lens.

const add = (a, b, scale = 1) => a.map((value, axis) => value + scale * b[axis]);
const dot = (a, b) => a.reduce((sum, value, axis) => sum + value * b[axis], 0);

function rotate(vector, axis, angle) {
  const cos = Math.cos(angle), sin = Math.sin(angle), along = dot(axis, vector) * (1 - cos);
  const cross = [axis[1] * vector[2] - axis[2] * vector[1], axis[2] * vector[0] - axis[0] * vector[2], axis[0] * vector[1] - axis[1] * vector[0]];
  return vector.map((value, i) => value * cos + cross[i] * sin + axis[i] * along);
}

class Camera {
  constructor(fov, pivot) {
    Object.assign(this, { fov, pivot: [...pivot], place: [0, 0, 0], turn: [1, 0, 0, 0, 1, 0, 0, 0, 1] });
  }

  // As the dataset keeps it: the first three rows of world_from_camera.
  set(matrix) {
    const column = (c) => [matrix[c], matrix[4 + c], matrix[8 + c]];
    this.turn = [...column(0), ...column(1), ...column(2)];
    this.place = column(3);
  }

  get matrix() {
    return [0, 1, 2].flatMap((row) => [this.turn[row], this.turn[3 + row], this.turn[6 + row], this.place[row]]);
  }

  axis(index) {
    return this.turn.slice(3 * index, 3 * index + 3);
  }

  // Around the pivot: about the vertical, and up or down, but never over the top.
  orbit(azimuth, elevation) {
    const back = this.axis(2), now = Math.asin(Math.max(-1, Math.min(1, back[2])));
    const up = Math.max(-1.5, Math.min(1.5, now + elevation)) - now;
    const right = this.axis(0);
    const moved = (vector) => rotate(rotate(vector, right, -up), [0, 0, 1], azimuth);
    this.place = add(this.pivot, moved(add(this.place, this.pivot, -1)));
    this.turn = [0, 1, 2].flatMap((index) => moved(this.axis(index)));
  }

  zoom(factor) {
    const away = add(this.place, this.pivot, -1);
    this.place = add(this.pivot, away, factor);
  }

  // By shares of the distance to the pivot, to the right and upwards.
  pan(right, up) {
    const distance = Math.sqrt(dot(add(this.place, this.pivot, -1), add(this.place, this.pivot, -1)));
    const shift = add(add([0, 0, 0], this.axis(0), right * distance), this.axis(1), up * distance);
    this.place = add(this.place, shift);
    this.pivot = add(this.pivot, shift);
  }

  // The direction through a point of a picture of some size.
  through(x, y, width, height) {
    const focal = focalLength(this, width, height), right = (x - 0.5 * width) / focal, up = (0.5 * height - y) / focal;
    const d = add(add(add([0, 0, 0], this.axis(2), -1), this.axis(0), right), this.axis(1), up);
    return d.map((value) => value / Math.sqrt(dot(d, d)));
  }
}
