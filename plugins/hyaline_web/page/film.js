// A turn around the scene as a WebM film: first all of its pictures are drawn, then they are played to a recorder.

const FILM_FRAMES = 72, FILM_RATE = 24, FILM_SIDE = 640, FILM_MS = 1500;

// Records pictures in real time, each for as long as it will be shown; the film as a Blob.
async function recordFilm(pictures, width, height) {
  const kinds = ["video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm"];
  const mimeType = typeof MediaRecorder === "undefined" ? undefined : kinds.find((kind) => MediaRecorder.isTypeSupported(kind));
  if (!mimeType) throw new Error("This browser records no WebM.");
  const canvas = Object.assign(document.createElement("canvas"), { width, height }), context = canvas.getContext("2d");
  context.drawImage(pictures[0], 0, 0);
  const stream = canvas.captureStream(0), [track] = stream.getVideoTracks(), parts = [];
  const recorder = new MediaRecorder(stream, { mimeType, videoBitsPerSecond: 8e6 });
  recorder.ondataavailable = (event) => parts.push(event.data);
  const heard = (name) => new Promise((resolve, reject) => {
    recorder.addEventListener(name, resolve, { once: true });
    recorder.addEventListener("error", (event) => reject(event.error), { once: true });
  });
  const started = heard("start");
  recorder.start();
  await started;
  for (const picture of pictures) {
    context.drawImage(picture, 0, 0);
    track.requestFrame();
    await new Promise((resolve) => setTimeout(resolve, 1000 / FILM_RATE));
  }
  const stopped = heard("stop");
  recorder.stop();
  await stopped;
  return new Blob(parts, { type: "video/webm" });
}

class Film {
  constructor(page) {
    Object.assign(this, { page, isWanted: false });
  }

  // Even numbers of pixels, as codecs want them: as many as are drawn in a while, in the shape of the page.
  size() {
    const { canvas, frames } = this.page, most = Math.min(1, FILM_SIDE / Math.max(canvas.width, canvas.height));
    const [width, height] = frames.sizeFor(FILM_MS), scale = Math.min(1, (most * canvas.width) / width);
    return [width, height].map((side) => Math.max(2, 2 * Math.round((side * scale) / 2)));
  }

  // The film, and the camera again where it was; null if it was stopped.
  async turntable(count = FILM_FRAMES, rays = 1) {
    const { camera, frames } = this.page, { matrix } = camera, pictures = [], [width, height] = this.size();
    this.isWanted = true;
    try {
      return await frames.alone(async () => {
        for (let frame = 0; frame < count && this.isWanted; frame++) {
          this.page.show(`Film: picture ${frame + 1} of ${count}, ${width} × ${height}`);
          pictures.push(await frames.compose(width, height, rays));
          camera.orbit((2 * Math.PI) / count, 0);
        }
        if (!this.isWanted) return null;
        this.page.show("Film: recording …");
        return await recordFilm(pictures, width, height);
      });
    } finally {
      camera.set(matrix);
      for (const picture of pictures) picture.close();
      this.isWanted = false;
    }
  }
}
