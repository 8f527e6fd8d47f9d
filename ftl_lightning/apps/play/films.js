// All films of the page share one clock: a bar at the bottom plays, stops and scrubs them; a click on one makes it large.
const PAUSE = 1.5; // seconds that films rest at their end
const FIRST = 20; // films out of sight that are drawn for the first time in a picture
const PER_SECOND = 30, WHILE_LEARNING = 6; // pictures: more would take time from learning, which runs on the same machine
const films = new Set();
const player = { clock: 0, length: 0, playing: true, resting: false, changed: true, last: 0, shown: 0, large: null };

const near = new IntersectionObserver((changes) => {
  for (const change of changes) if (change.target.film) change.target.film.near = change.isIntersecting;
}, { rootMargin: "120px" });

// A canvas for a film, which moves as long as it is near the part of the page in sight. Several films lie on each other.
function addCanvas() {
  const canvas = made("canvas", { width: 10, height: 10 });
  canvas.setAttribute("role", "img");
  const one = { canvas, films: [], view: null, near: null, key: "" };
  canvas.film = one;
  films.add(one);
  near.observe(canvas);
  return one;
}

function setCanvas(one, shown, view, label) {
  Object.assign(one, { films: shown, view: view || viewOf(shown), key: "" });
  one.canvas.setAttribute("aria-label", label);
  player.changed = true;
}

function dropCanvas(one) {
  near.unobserve(one.canvas);
  films.delete(one);
  player.changed = true;
}

// A figure with a film that can be made large, what is said of it beneath.
function addFilm() {
  const one = addCanvas();
  one.button = made("button", { type: "button", className: "film" }, one.canvas);
  one.mark = made("span", { className: "mark" });
  one.told = made("span", { className: "told" });
  one.figure = made("figure", {}, one.button, made("figcaption", {}, one.mark, " ", one.told));
  turnable(one.button, one);
  one.button.addEventListener("click", () => { if (!one.dragged) enlarge(one); });
  return one;
}

function setFilm(one, film, view, label) {
  const judged = film.right === true ? "right" : film.right === false ? "wrong" : "";
  const verdict = judged && (state.verdicts || ["right", "wrong"])[judged === "right" ? 0 : 1];
  one.label = judged ? `${label}: ${verdict}` : label;
  setCanvas(one, [film], view, one.label);
  one.button.setAttribute("aria-label", `${one.label}. Make it large`);
  one.button.classList.toggle("turnable", Boolean(film.space));
  one.figure.className = judged;
  one.mark.textContent = judged ? `${judged === "right" ? "\u2713" : "\u2717"} ${verdict}` : "";
  one.told.textContent = film.told || "";
}

// Fills an element with films. Those that are there are exchanged in place, so that nothing flickers.
function fill(box, shown, view, label) {
  const have = box.have || (box.have = []);
  while (have.length > shown.length) {
    const last = have.pop();
    last.figure.remove();
    dropCanvas(last);
  }
  shown.forEach((film, number) => {
    if (!have[number]) {
      have[number] = addFilm();
      box.append(have[number].figure);
    }
    setFilm(have[number], film, view, label(number));
  });
}

// Drags and arrow keys turn bodies.
function turnable(element, one) {
  let from = null;
  element.addEventListener("pointerdown", (event) => {
    one.dragged = false;
    from = one.films[0] && one.films[0].space ? [event.clientX, event.clientY] : null;
    if (from) element.setPointerCapture(event.pointerId);
  });
  element.addEventListener("pointermove", (event) => {
    if (!from) return;
    const across = event.clientX - from[0], up = event.clientY - from[1];
    if (!one.dragged && Math.hypot(across, up) < 5) return;
    one.dragged = true;
    from = [event.clientX, event.clientY];
    turn(0.01 * across, 0.01 * up);
    paint();
  });
  for (const end of ["pointerup", "pointercancel"]) element.addEventListener(end, () => { from = null; });
  element.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
    if (!by || !one.films[0] || !one.films[0].space) return;
    event.preventDefault();
    turn(...by);
    paint();
  });
}

// How long films are, once some have changed.
function measure() {
  player.changed = false;
  player.length = 0;
  for (const one of films) for (const film of one.films) player.length = Math.max(player.length, seconds(film));
  if (player.resting) player.clock = player.length;
  player.clock = Math.min(player.clock, player.length + PAUSE);
  find("player").hidden = player.length < 0.05;
}

function paint() {
  if (player.changed) measure();
  let first = FIRST;
  for (const one of films) {
    if (!one.films.length || !one.canvas.isConnected) continue;
    if (one.near === false && one !== player.large && (one.key || --first < 0)) continue;
    const until = Math.max(...one.films.map(seconds)), at = Math.min(player.clock, until);
    const key = `${at} ${one.canvas.clientWidth} ${looking.turned}`;
    if (key === one.key) continue;
    one.key = key;
    one.films.forEach((film, number) => drawFilm(one.canvas, film, at, one.view, { over: number > 0, alpha: one.films.length > 1 ? 0.45 : 1 }));
    if (one.figure) one.figure.classList.toggle("over", at >= until - 1e-6);
  }
  const share = Math.round(1000 * Math.min(player.clock / (player.length || 1), 1));
  for (const slider of [find("time"), find("large-time")]) if (Number(slider.value) !== share) slider.value = share;
}

function tick(now) {
  requestAnimationFrame(tick);
  const often = document.body.dataset.learning === "yes" ? WHILE_LEARNING : PER_SECOND;
  if (now - player.shown < 1000 / often - 2) return;
  player.shown = now;
  const passed = Math.min((now - player.last) / 1000, 0.2) * Number(find("speed").value);
  player.last = now;
  if (player.playing && player.length > 0.05) {
    player.clock += passed;
    if (player.clock > player.length + PAUSE) player.clock = 0;
  }
  paint();
}

function play(on) {
  player.playing = on;
  player.resting = false;
  if (on && player.clock >= player.length) player.clock = 0;
  for (const button of [find("play"), find("large-play")]) {
    button.textContent = on ? "\u275A\u275A" : "\u25B6";
    button.setAttribute("aria-label", on ? "Stop all films" : "Play all films");
  }
}

function scrub(event) {
  play(false);
  player.clock = player.length * event.target.value / 1000;
  paint();
}

function enlarge(one) {
  const dialog = find("large"), large = player.large || (player.large = addCanvas());
  if (!large.canvas.isConnected) {
    find("large-film").append(large.canvas);
    turnable(find("large-film"), large);
  }
  setCanvas(large, one.films, one.view, one.label);
  find("large-film").className = one.figure.className;
  find("large-title").textContent = one.label;
  find("large-told").textContent = one.told.textContent;
  find("large-keys").hidden = !one.films[0].space;
  dialog.showModal();
  paint();
}

function startPlayer() {
  find("play").addEventListener("click", () => play(!player.playing));
  find("large-play").addEventListener("click", () => play(!player.playing));
  find("time").addEventListener("input", scrub);
  find("large-time").addEventListener("input", scrub);
  find("large-close").addEventListener("click", () => find("large").close());
  find("large").addEventListener("click", (event) => { if (event.target === find("large")) find("large").close(); });
  find("large").addEventListener("close", () => setCanvas(player.large, [], [0, 0, 1, 1], ""));
  if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
    play(false);
    player.resting = true; // films stand at their end, where the whole behaviour is seen
  }
  player.last = performance.now();
  requestAnimationFrame(tick);
}
