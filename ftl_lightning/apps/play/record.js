// Showing behaviour with pen, mouse, finger or keys: drawing a line, arranging pieces, or steering one.
const TAP = 8; // pixels: a shorter line was none
const STEP = 1 / 30; // seconds between places of a path
const recorder = { kind: "", scene: null, coming: null, queue: Promise.resolve(), at: [], shown: [], path: [], times: [], down: false,
  held: null, grown: null, before: null, keys: new Set(), penKeys: false, pen: null, pointer: null, passed: 0, last: 0, busy: 0 };

const board = () => find("show");

// Nothing is shown in until another model's scene is there.
function noScene() {
  Object.assign(recorder, { scene: null, path: [], times: [], shown: [], grown: null, down: false, held: null, pointer: null, penKeys: false });
  recorder.keys.clear();
  board().getContext("2d").clearRect(0, 0, board().width, board().height);
  find("handles").replaceChildren();
  find("pen-keys").setAttribute("aria-pressed", false);
}

async function newScene() {
  const task = find("task").value || "";
  recorder.coming = ask("/api/scene", { task }).then((scene) => {
    recorder.scene = scene;
    if (!recorder.down) reset();
    return scene;
  });
  recorder.coming.catch(() => {});
  return recorder.coming;
}

function reset() {
  const scene = recorder.scene;
  Object.assign(recorder, { at: scene.pieces.map((piece) => [...piece.at]), path: [], times: [], down: false, held: null, pointer: null, passed: 0 });
  if (recorder.kind !== "draw") recorder.shown = [];
  find("steps").style.setProperty("--wide", scene.film.window[2] / scene.film.window[3]);
  handles();
  told();
  redraw();
}

// --- where things are on the canvas

function placeOf(event) {
  const box = board().getBoundingClientRect(), [left, lower, width, height] = recorder.scene.film.window;
  return [left + (event.clientX - box.left) / box.width * width, lower + (1 - (event.clientY - box.top) / box.height) * height];
}

const unitsPerPixel = () => recorder.scene.film.window[2] / board().getBoundingClientRect().width;

function inside([x, y]) {
  const [left, lower, width, height] = recorder.scene.film.window;
  return [Math.max(left, Math.min(left + width, x)), Math.max(lower, Math.min(lower + height, y))];
}

function moved() {
  const by = {};
  recorder.scene.pieces.forEach((piece, number) => {
    for (const shape of piece.shapes) by[shape] = [recorder.at[number][0] - piece.at[0], recorder.at[number][1] - piece.at[1]];
  });
  return by;
}

// How far a piece extends around its place.
function extent(piece) {
  const film = recorder.scene.film;
  return Math.max(0, ...piece.shapes.flatMap((number) => {
    const shape = film.shapes[number];
    return (placed(shape, film, 0) || []).map(([x, y]) => Math.hypot(x - piece.at[0], y - piece.at[1]) + (shape.size || 0));
  }));
}

function under(place) {
  let best = null, least = 20 * unitsPerPixel();
  recorder.scene.pieces.forEach((piece, number) => {
    const away = Math.hypot(place[0] - recorder.at[number][0], place[1] - recorder.at[number][1]) - extent(piece);
    if (away < least) [best, least] = [number, away];
  });
  return best;
}

// --- drawing what is shown

function redraw() {
  if (!recorder.scene) return;
  const film = recorder.scene.film, canvas = board();
  draw(canvas, film, 0, film.window, { moved: moved() });
  if (recorder.grown) drawGrown(canvas);
  for (const line of recorder.shown) ink(canvas, line, 0.35);
  if (recorder.kind === "draw") ink(canvas, recorder.path.map((places) => places[0]), 1);
  if (recorder.kind === "steer") ink(canvas, recorder.path.map((places) => places[0]), 0.5);
  if (recorder.penKeys && recorder.pen) ring(canvas, recorder.pen);
}

// A line as of ink: thin where it is fast, with round turns.
function ink(canvas, line, alpha, thin = 1) {
  const [left, lower, width] = recorder.scene.film.window, scale = canvas.width / width, pen = canvas.getContext("2d");
  const at = line.map(([x, y]) => [(x - left) * scale, canvas.height - (y - lower) * scale]);
  const thick = Math.max(2, thin * canvas.width / 70);
  let wide = thick;
  pen.globalAlpha = alpha;
  pen.strokeStyle = pen.fillStyle = "#1d4f91";
  pen.lineCap = pen.lineJoin = "round";
  if (at.length === 1) { pen.beginPath(); pen.arc(...at[0], thick / 2, 0, 2 * Math.PI); pen.fill(); }
  if (alpha < 1) { // one line, as pieces of a translucent one would be seen where they meet
    pen.lineWidth = 0.8 * thick;
    pen.beginPath();
    at.forEach((place, number) => number ? pen.lineTo(...place) : pen.moveTo(...place));
    pen.stroke();
  } else {
    for (let number = 1; number < at.length; number++) {
      const before = at[Math.max(0, number - 2)], from = at[number - 1], to = at[number];
      const fast = Math.hypot(to[0] - from[0], to[1] - from[1]) / canvas.width;
      wide += 0.25 * (thick * Math.max(0.55, 1.15 - 14 * fast) - wide);
      pen.lineWidth = wide;
      pen.beginPath();
      pen.moveTo((before[0] + from[0]) / 2, (before[1] + from[1]) / 2);
      pen.quadraticCurveTo(from[0], from[1], (from[0] + to[0]) / 2, (from[1] + to[1]) / 2);
      if (number === at.length - 1) pen.lineTo(...to);
      pen.stroke();
    }
  }
  pen.globalAlpha = 1;
}

function ring(canvas, place) {
  const [left, lower, width] = recorder.scene.film.window, scale = canvas.width / width, pen = canvas.getContext("2d");
  pen.beginPath();
  pen.arc((place[0] - left) * scale, canvas.height - (place[1] - lower) * scale, canvas.width / 45, 0, 2 * Math.PI);
  pen.lineWidth = canvas.width / 150;
  pen.strokeStyle = recorder.down ? "#1d4f91" : "#b4481f";
  pen.stroke();
}

// --- what is said beside the canvas

const NOUNS = { draw: "Stroke", arrange: "Arrangement", steer: "Trip" };

function told() {
  const count = state.work.demonstrations.length, scene = recorder.scene;
  const first = count ? NOUNS[recorder.kind] : `Your turn: ${NOUNS[recorder.kind].toLowerCase()}`;
  const which = count < state.work.wanted ? `${first} ${count + 1} of ${state.work.wanted}` : `${count} are there; more are welcome`;
  const limit = scene && scene.seconds ? ` of ${scene.seconds.toFixed(1)}` : "";
  const clock = recorder.kind === "steer" && recorder.passed ? ` \u00b7 ${recorder.passed.toFixed(1)}${limit} s` : "";
  find("next").textContent = recorder.busy && recorder.kind !== "draw" ? "One moment\u2026" : which + clock;
  find("keep").disabled = recorder.kind === "steer" && recorder.path.length < 2;
}

const hint = (text) => { find("hint").textContent = text; };

// --- keeping a demonstration

// Demonstrations are sent one after another, so that nobody has to wait before the next one.
function keep(path, times, line = null) {
  recorder.busy += 1;
  const scene = recorder.coming;
  Object.assign(recorder, { path: [], times: [], down: false, held: null, pointer: null, passed: 0 });
  if (line) recorder.shown.push(line);
  if (recorder.kind === "draw") redraw();
  told();
  recorder.queue = recorder.queue.then(() => attempt(async () => {
    try {
      const { scene: number } = await scene;
      worked(await ask("/api/record", { scene: number, path, seconds: times }), true);
    } finally {
      recorder.shown.shift();
      if (recorder.kind !== "draw" || recorder.busy === 1) await newScene();
    }
  })).then(() => {
    recorder.busy -= 1;
    told();
    redraw();
    if (recorder.kind === "steer" && recorder.keys.size) steering();
  });
  return recorder.queue;
}

function finish() {
  if (recorder.busy && recorder.kind !== "draw") return;
  if (recorder.kind === "arrange") keep([recorder.at.map((place) => [...place])], [0]);
  if (recorder.kind === "steer" && recorder.path.length > 1) keep(recorder.path, recorder.times);
}

function endStroke() {
  const line = recorder.path.map((places) => places[0]), away = TAP * unitsPerPixel();
  recorder.down = false;
  const long = line.some(([x, y]) => Math.hypot(x - line[0][0], y - line[0][1]) > away);
  if (!long) {
    hint(recorder.penKeys ? "Move the pen with the arrow keys while it is down." : "That was only a dot: press, draw a line, then let go.");
    Object.assign(recorder, { path: [], grown: recorder.before });
    redraw();
    return;
  }
  hint(state.recorder.hint);
  keep(recorder.path, recorder.times, line);
}

// --- pointers

function pointerDown(event) {
  if (!recorder.scene || event.button > 0 || (recorder.busy && recorder.kind !== "draw")) return;
  const place = placeOf(event);
  if (recorder.kind === "draw") {
    if (recorder.penKeys) penMode(false); // who presses on the canvas draws
    Object.assign(recorder, { down: true, before: recorder.grown, grown: null, path: [[place]], times: [0], began: event.timeStamp });
  } else if (recorder.kind === "arrange") {
    recorder.held = under(place);
    if (recorder.held === null) { hint("Press on a piece and drag it."); return; }
    recorder.grip = [recorder.at[recorder.held][0] - place[0], recorder.at[recorder.held][1] - place[1]];
    recorder.down = true;
  } else {
    recorder.down = true;
    recorder.pointer = place;
    steering();
  }
  board().setPointerCapture(event.pointerId);
  redraw();
}

function pointerMove(event) {
  if (!recorder.down || recorder.penKeys) return;
  if (recorder.kind === "draw") {
    const all = event.getCoalescedEvents ? event.getCoalescedEvents() : [];
    for (const one of all.length ? all : [event]) {
      recorder.path.push([inside(placeOf(one))]);
      recorder.times.push(Math.max(recorder.times.at(-1), (one.timeStamp - recorder.began) / 1000));
    }
  } else if (recorder.kind === "arrange") {
    const place = placeOf(event);
    recorder.at[recorder.held] = inside([place[0] + recorder.grip[0], place[1] + recorder.grip[1]]);
    handles();
  } else {
    recorder.pointer = placeOf(event);
  }
  requestAnimationFrame(redraw);
}

function pointerUp() {
  if (!recorder.down || recorder.penKeys) return;
  if (recorder.kind === "draw") { endStroke(); return; }
  recorder.down = false;
  recorder.held = recorder.pointer = null;
}

function pointerCancel() { // such as a second finger that zooms
  if (recorder.kind === "draw" && !recorder.penKeys) Object.assign(recorder, { path: [], grown: recorder.before });
  recorder.down = false;
  recorder.held = recorder.pointer = null;
  if (recorder.scene) redraw();
}

// --- keys

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1], a: [-1, 0], d: [1, 0], w: [0, 1], s: [0, -1] };
const arrowOf = (event) => event.key.length === 1 ? event.key.toLowerCase() : event.key;

function keyDown(event) {
  if (!recorder.scene || event.ctrlKey || event.metaKey || event.altKey) return;
  const key = arrowOf(event), steers = recorder.kind === "steer", draws = recorder.kind === "draw" && recorder.penKeys;
  if (ARROWS[key] && (steers || (draws && key.startsWith("Arrow")))) {
    event.preventDefault();
    recorder.fast = event.shiftKey;
    const anew = !recorder.keys.has(key);
    recorder.keys.add(key);
    steers ? steering(anew) : penMoving(anew);
  } else if (draws && key === " ") {
    event.preventDefault();
    if (event.repeat) return;
    if (recorder.down) { endStroke(); return; }
    Object.assign(recorder, { down: true, before: recorder.grown, grown: null, path: [[[...recorder.pen]]], times: [0] });
    hint("The pen is down: arrow keys draw, space lifts it and keeps the stroke, Escape throws it away.");
    redraw();
  } else if (draws && key === "Escape" && recorder.down) {
    Object.assign(recorder, { down: false, path: [], times: [] });
    redraw();
  } else if (steers && key === "Enter") {
    event.preventDefault();
    finish();
  }
}

function penMode(on) {
  if (!recorder.scene) return;
  recorder.penKeys = on;
  Object.assign(recorder, { down: false, path: [], times: [] });
  recorder.keys.clear();
  find("pen-keys").setAttribute("aria-pressed", on);
  if (on) {
    const [left, lower, width, height] = recorder.scene.film.window;
    recorder.pen = [left + width / 2, lower + height / 2];
    hint("Arrow keys move the pen, Shift makes it faster, space lowers and lifts it.");
    board().focus();
  } else hint(state.recorder.hint);
  redraw();
}

function heading() {
  let [x, y] = [0, 0];
  for (const key of recorder.keys) { x += ARROWS[key][0]; y += ARROWS[key][1]; }
  const long = Math.hypot(x, y) || 1;
  return [x / long, y / long];
}

function penStep(passed) {
  const [x, y] = heading(), by = passed * recorder.scene.film.window[2] * (recorder.fast ? 0.9 : 0.4);
  recorder.pen = inside([recorder.pen[0] + x * by, recorder.pen[1] + y * by]);
  if (recorder.down) {
    recorder.path.push([[...recorder.pen]]);
    recorder.times.push(recorder.times.at(-1) + passed);
  }
  redraw();
}

// Moves the pen as long as an arrow key is held; its time stands still while none is. A key that is pressed anew moves it by a
// step at once, however soon it is let go.
function penMoving(anew) {
  if (anew) penStep(STEP);
  if (recorder.moving) return;
  const move = (now) => {
    const passed = Math.max(0, Math.min(now - recorder.last, 50)) / 1000;
    recorder.last = now;
    if (!recorder.keys.size || !recorder.penKeys) { recorder.moving = false; return; }
    penStep(passed);
    requestAnimationFrame(move);
  };
  recorder.moving = true;
  recorder.last = performance.now();
  requestAnimationFrame(move);
}

// Moves what is steered towards the pointer or as keys say, no faster than it can. Time runs only while somebody steers.
// A key that is pressed anew moves it by a step at once, however soon it is let go.
function steering(anew = false) {
  if (recorder.busy && recorder.kind === "steer") return;
  if (!recorder.path.length) { recorder.path = [[[...recorder.at[0]]]]; recorder.times = [0]; }
  if (anew && onwards()) return;
  if (recorder.moving) { told(); redraw(); return; }
  const move = (now) => {
    let passed = Math.min((now - recorder.last) / 1000, 0.2);
    if (!recorder.path.length || (!recorder.pointer && !recorder.keys.size)) { recorder.moving = false; told(); return; }
    while (passed >= STEP) {
      passed -= STEP;
      if (onwards()) { recorder.moving = false; return; }
    }
    recorder.last = now - 1000 * passed;
    told();
    redraw();
    requestAnimationFrame(move);
  };
  recorder.moving = true;
  recorder.last = performance.now();
  told();
  redraw();
  requestAnimationFrame(move);
}

// A step of what is steered; returns whether its time is over.
function onwards() {
  const { seconds: most, speed, film } = recorder.scene;
  oneStep(speed || film.window[2] / 3, Boolean(speed));
  if (!most || recorder.passed < most - 1e-6) return false;
  recorder.keys.clear();
  redraw();
  finish();
  return true;
}

function oneStep(speed, limited) {
  let [x, y] = recorder.at[0];
  const most = 0.999 * speed * STEP; // rounding makes it no faster than it can
  if (recorder.pointer) {
    const [right, up] = [recorder.pointer[0] - x, recorder.pointer[1] - y], far = Math.hypot(right, up);
    const by = limited ? Math.min(1, most / (far || 1)) : 1;
    [x, y] = [x + right * by, y + up * by];
  } else {
    const [right, up] = heading();
    [x, y] = [x + right * most, y + up * most];
  }
  recorder.at[0] = inside([x, y]);
  recorder.passed += STEP;
  recorder.path.push([[...recorder.at[0]]]);
  recorder.times.push(recorder.passed);
}

// Something to tab to at each piece that is arranged: arrow keys move it, Enter keeps the arrangement.
function handles() {
  const box = find("handles"), scene = recorder.scene, pieces = recorder.kind === "arrange" ? scene.pieces : [];
  const [left, lower, width, height] = scene.film.window;
  while (box.children.length > pieces.length) box.lastChild.remove();
  pieces.forEach((piece, number) => {
    let one = box.children[number];
    if (!one) {
      one = made("button", { type: "button" });
      one.addEventListener("keydown", (event) => handleKey(event, number));
      box.append(one);
    }
    const [x, y] = recorder.at[number];
    one.style.left = `${(x - left) / width * 100}%`;
    one.style.bottom = `${(y - lower) / height * 100}%`;
    one.setAttribute("aria-label", `${piece.name}, ${Math.round((x - left) / width * 100)} % from the left, ${Math.round((y - lower) / height * 100)} % from below`);
  });
}

function handleKey(event, number) {
  if (event.key === "Enter") { event.preventDefault(); finish(); return; }
  const arrow = event.key.startsWith("Arrow") && ARROWS[event.key];
  if (!arrow || recorder.busy) return;
  event.preventDefault();
  const by = recorder.scene.film.window[2] * (event.shiftKey ? 0.05 : 0.0125), [x, y] = recorder.at[number];
  recorder.at[number] = inside([x + arrow[0] * by, y + arrow[1] * by]);
  handles();
  redraw();
}

// --- the beginning

const KEYS = {
  draw: "",
  arrange: "Or Tab to a piece, move it with the arrow keys (Shift: faster), and press Enter.",
  steer: "Drag, or steer with the arrow keys or W A S D. Time runs only while you steer. Enter finishes.",
};

async function setRecorder(found) {
  find("canvas").hidden = !found;
  find("steps").classList.toggle("bare", !found);
  find("ways").open = !found;
  recorder.kind = found ? found.kind : "";
  noScene();
  if (!found) { hint("This model has no canvas: choose demonstrations from the library or open a file."); return; }
  hint(found.hint);
  find("keys").textContent = KEYS[found.kind];
  find("stage").setAttribute("aria-label", found.hint);
  board().setAttribute("aria-label", { draw: "A canvas to draw on", arrange: "A scene to arrange", steer: "A scene to steer through" }[found.kind]);
  board().tabIndex = found.kind === "arrange" ? -1 : 0;
  find("keep").hidden = found.kind === "draw";
  find("keep").textContent = found.kind === "steer" ? "Finish" : "Keep this arrangement";
  find("pen-keys").hidden = found.kind !== "draw";
  find("scene").hidden = found.kind === "draw" && !found.tasks.length;
  find("task-label").hidden = !found.tasks.length;
  find("task").replaceChildren(...found.tasks.map((name) => made("option", { value: name, textContent: name })));
  await attempt(newScene);
  slots();
}

function canvasInSight() {
  if (find("sure").open || find("large").open || !recorder.scene) return false;
  const box = board().getBoundingClientRect();
  return box.height > 0 && box.bottom > 0 && box.top < innerHeight;
}

// After buttons that go on to another trip, keys steer at once.
function toCanvas() {
  if (recorder.kind === "steer") board().focus({ preventScroll: true });
}

function listenToHand() {
  const canvas = board();
  canvas.addEventListener("pointerdown", pointerDown);
  canvas.addEventListener("pointermove", pointerMove);
  canvas.addEventListener("pointerup", pointerUp);
  canvas.addEventListener("pointercancel", pointerCancel);
  // Keys work on the canvas, and as long as it is in sight, where nothing else has the focus.
  addEventListener("keydown", (event) => {
    const free = event.target === document.body || event.target === document.documentElement || event.target === find("stage");
    if (event.target === canvas || (free && canvasInSight())) keyDown(event);
  });
  addEventListener("keyup", (event) => recorder.keys.delete(arrowOf(event)));
  for (const one of [canvas, window]) one.addEventListener("blur", () => recorder.keys.clear());
  find("keep").addEventListener("click", () => { finish(); toCanvas(); });
  find("pen-keys").addEventListener("click", () => penMode(!recorder.penKeys));
  find("scene").addEventListener("click", () => { attempt(newScene); toCanvas(); });
  find("task").addEventListener("change", () => attempt(newScene));
  addEventListener("resize", redraw);
}
