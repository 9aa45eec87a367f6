// A camera: its place, its right, upper and backward directions, its lens, and a point that it turns about.

const STEEPEST = 1.5;  // Radians of elevation: a camera never turns over the top.

class Camera {
  // The lens in focal lengths: half the sides of the dataset's pictures, and how far right of their middle, and below
  // it, the principal point is.
  constructor(lens, pivot) {
    Object.assign(this, { lens, pivot: [...pivot], place: [0, 0, 0], turn: [1, 0, 0, 0, 1, 0, 0, 0, 1] });
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

  get distance() {
    return norm(add(this.place, this.pivot, -1));
  }

  axis(index) {
    return this.turn.slice(3 * index, 3 * index + 3);
  }

  // How a vector turns when the camera turns about the vertical, and when it rises.
  turning(azimuth, rise) {
    const right = this.axis(0), now = Math.asin(Math.max(-1, Math.min(1, this.axis(2)[2])));
    const up = Math.max(-STEEPEST, Math.min(STEEPEST, now + rise)) - now;
    return (vector) => rotate(rotate(vector, right, -up), [0, 0, 1], azimuth);
  }

  // Around the pivot.
  orbit(azimuth, elevation) {
    const moved = this.turning(azimuth, elevation);
    this.place = add(this.pivot, moved(add(this.place, this.pivot, -1)));
    this.turn = [0, 1, 2].flatMap((index) => moved(this.axis(index)));
  }

  // Turns the head; the pivot stays as far ahead as it was.
  look(azimuth, elevation) {
    const { distance } = this, moved = this.turning(azimuth, -elevation);
    this.turn = [0, 1, 2].flatMap((index) => moved(this.axis(index)));
    this.pivot = add(this.place, this.axis(2), -distance);
  }

  zoom(factor) {
    this.place = add(this.pivot, add(this.place, this.pivot, -1), factor);
  }

  // To the right, upwards and ahead, by shares of the distance to the pivot, which comes along.
  fly(right, up, ahead) {
    const { distance } = this;
    const shift = [right, up, -ahead].reduce((sum, share, index) => add(sum, this.axis(index), share * distance), [0, 0, 0]);
    this.place = add(this.place, shift);
    this.pivot = add(this.pivot, shift);
  }

  // The direction through a point of a picture of some size.
  through(x, y, width, height) {
    const focal = focalLength(this, width, height), { shift } = this.lens;
    const right = (x - 0.5 * width) / focal - shift[0], up = (0.5 * height - y) / focal + shift[1];
    return unit(add(add(add([0, 0, 0], this.axis(2), -1), this.axis(0), right), this.axis(1), up));
  }

  // Where a point stands in a picture of some size; null behind the camera.
  project(point, width, height) {
    const away = add(point, this.place, -1), focal = focalLength(this, width, height), depth = -dot(away, this.axis(2));
    if (depth < 1e-3) return null;
    const [right, up] = [0, 1].map((index) => dot(away, this.axis(index)) / depth), { shift } = this.lens;
    return [0.5 * width + focal * (right + shift[0]), 0.5 * height + focal * (shift[1] - up)];
  }
}

// Pixels: the dataset's pictures just fit into the page's.
function focalLength(camera, width, height) {
  return Math.min((0.5 * width) / camera.lens.half[0], (0.5 * height) / camera.lens.half[1]);
}
