// Before anyone has drawn: an example draws itself five times, is learned, and varies.
const EACH = 420, GROW = 900, REST = 1300; // milliseconds of a stroke, of all samples, and until the canvas is free
const example = () => JSON.parse(find("example").textContent);

// Whether somebody has begun, or nothing should move by itself.
const begun = () => recorder.kind !== "draw" || !recorder.scene || recorder.down || recorder.penKeys || recorder.busy > 0
  || state.work.demonstrations.length > 0 || opening || closed || find("canvas").hidden;

function onCanvas(line) {
  const [left, lower, width, height] = recorder.scene.film.window;
  return line.map(([x, y]) => [left + x / 1000 * width, lower + y / 1000 * height]);
}

function playExample() {
  if (begun() || matchMedia("(prefers-reduced-motion: reduce)").matches) return;
  const { shown, samples } = example(), start = performance.now(), learned = EACH * shown.length;
  const part = (line, share) => onCanvas(line.slice(0, Math.max(1, Math.round(share * line.length))));
  const move = (now) => {
    const passed = now - start;
    if (begun() || passed > learned + GROW + REST) {
      if (recorder.scene) { redraw(); told(); }
      return;
    }
    redraw();
    shown.forEach((line, number) => {
      const share = Math.min(1, passed / EACH - number);
      if (share > 0) ink(board(), part(line, share), passed < learned && share < 1 ? 1 : 0.3);
    });
    if (passed >= learned) for (const line of samples) ink(board(), part(line, Math.min(1, (passed - learned) / GROW)), 1);
    find("next").textContent = passed < learned ? "Five strokes" : "Learned: samples";
    requestAnimationFrame(move);
  };
  requestAnimationFrame(move);
}
