// Strokes that draw themselves on the canvas: an example before anyone has drawn, and samples of what was learned.
const EACH = 420, GROW = 900, REST = 1300; // milliseconds of a stroke, of all samples, and until the canvas is free
const FAINT = 0.25; // opacity of strokes below samples
const POINTS = 80; // of a line that changes into another one
const example = () => JSON.parse(find("example").textContent);
const still = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

// Whether somebody has begun, or nothing should move by itself.
const begun = () => recorder.kind !== "draw" || !recorder.scene || recorder.down || recorder.penKeys || recorder.busy > 0
  || state.work.demonstrations.length > 0 || opening || closed || find("canvas").hidden;

function onCanvas(line) {
  const [left, lower, width, height] = recorder.scene.film.window;
  return line.map(([x, y]) => [left + x / 1000 * width, lower + y / 1000 * height]);
}

const firstPart = (line, share) => line.slice(0, Math.max(1, Math.round(Math.min(1, share) * line.length)));

function playExample() {
  if (begun() || still()) return;
  const { shown, samples } = example(), start = performance.now(), learned = EACH * shown.length;
  const move = (now) => {
    const passed = now - start;
    if (begun() || passed > learned + GROW + REST) {
      if (recorder.scene) { redraw(); told(); }
      return;
    }
    redraw();
    shown.forEach((line, number) => {
      const share = passed / EACH - number;
      if (share > 0) ink(board(), firstPart(onCanvas(line), share), passed < learned && share < 1 ? 1 : FAINT);
    });
    if (passed >= learned) for (const line of samples) ink(board(), firstPart(onCanvas(line), (passed - learned) / GROW), 1);
    find("next").textContent = passed < learned ? "Five strokes" : "Learned: samples";
    requestAnimationFrame(move);
  };
  requestAnimationFrame(move);
}

// The line that a film draws, in its unit, at POINTS even steps.
function lineOf(film) {
  const shape = film.shapes.find((one) => one.kind === "way");
  const line = shape ? Array.from({ length: film.frames }, (_, frame) => placed(shape, film, frame) || []).flat() : [];
  return line.length ? Array.from({ length: POINTS }, (_, number) => line[Math.round(number * (line.length - 1) / (POINTS - 1))]) : [];
}

// Lets samples grow out of the strokes on the canvas, and out of earlier samples while these are learned. They stay until somebody draws on.
function grow(samples) {
  if (recorder.kind !== "draw" || !recorder.scene || recorder.down) return;
  const strokes = state.work.demonstrations.map((one) => lineOf(one.film)).filter((line) => line.length);
  const to = samples.slice(0, strokes.length).map(lineOf).filter((line) => line.length);
  const grown = recorder.grown = { of: shownNow(), strokes, from: recorder.grown ? shapesNow(recorder.grown) : strokes, to, start: still() ? -GROW : performance.now() };
  const move = () => {
    redraw();
    if (recorder.grown === grown && performance.now() < grown.start + GROW) requestAnimationFrame(move);
  };
  move();
}

// Where the samples are on their way from other lines.
function shapesNow({ from, to, start }) {
  const share = Math.min(1, (performance.now() - start) / GROW), part = share * share * (3 - 2 * share);
  const between = (one, other) => one + part * (other - one);
  return to.map((line, number) => line.map(([x, y], at) => from[number] ? [between(from[number][at][0], x), between(from[number][at][1], y)] : [x, y]));
}

function drawGrown(canvas) {
  for (const line of recorder.grown.strokes) ink(canvas, line, FAINT);
  for (const line of shapesNow(recorder.grown)) ink(canvas, line, 1, 0.7);
}
