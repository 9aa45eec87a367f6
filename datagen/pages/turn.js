// Drawings in space that turn: by dragging, or with the arrow keys; + and - zoom. Without scripts they stand still.
for (const drawing of document.querySelectorAll("svg.turnable")) {
  let azimuth = Number(drawing.dataset.azimuth);
  let elevation = Number(drawing.dataset.elevation);
  const strokes = [...drawing.querySelectorAll("[data-points]")].map((path) => ({
    path,
    numbers: path.dataset.points.split(" ").map(Number),
    areDots: path.dataset.dots !== undefined,
  }));
  const draw = () => {
    const [a, e] = [(azimuth * Math.PI) / 180, (elevation * Math.PI) / 180];
    for (const { path, numbers, areDots } of strokes) {
      const places = [];
      for (let place = 0; place < numbers.length; place += 3) {
        const [x, y, z] = numbers.slice(place, place + 3);
        const across = y * Math.cos(a) - x * Math.sin(a);
        const down = (x * Math.cos(a) + y * Math.sin(a)) * Math.sin(e) - z * Math.cos(e);
        places.push(`${across.toFixed(1)} ${down.toFixed(1)}`);
      }
      path.setAttribute("d", areDots ? places.map((place) => `M${place}h0`).join("") : `M${places.join("L")}`);
    }
  };
  const turn = (across, down) => {
    azimuth -= across;
    elevation = Math.max(-90, Math.min(90, elevation + down));
    requestAnimationFrame(draw);
  };
  drawing.classList.add("turns");
  drawing.setAttribute("tabindex", "0");
  drawing.setAttribute("aria-label", `${drawing.getAttribute("aria-label")}; arrow keys turn it, + and - zoom`);
  drawing.addEventListener("pointerdown", (event) => drawing.setPointerCapture(event.pointerId));
  drawing.addEventListener("pointermove", (event) => {
    if (drawing.hasPointerCapture(event.pointerId)) turn(event.movementX / 2, event.movementY / 2);
  });
  const side = drawing.viewBox.baseVal.width;
  let zoom = 1;
  const zooms = { "+": 1.25, "-": 0.8 };
  const keys = { ArrowLeft: [-10, 0], ArrowRight: [10, 0], ArrowUp: [0, -10], ArrowDown: [0, 10] };
  drawing.addEventListener("keydown", (event) => {
    if (event.key in zooms) {
      zoom *= zooms[event.key];
      drawing.setAttribute("viewBox", `${-side / 2 / zoom} ${-side / 2 / zoom} ${side / zoom} ${side / zoom}`);
    }
    if (!(event.key in keys)) return;
    event.preventDefault();
    turn(...keys[event.key]);
  });
}
