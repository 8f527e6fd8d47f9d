// Draws the data embedded in the page, with film.js; nothing is loaded.
const PAUSE = 1.5;
const two = (value) => value.toFixed(2);
const unique = (values) => [...new Set(values)];
let data, domain = "", setting = "", task = "", hidden = new Set();
let films = [], clock = 0, length = 1, playing = true, last = 0, alone = null;

// --- films

// Success of an episode; null if undecided.
function decided(film) {
  const name = film.decisive in film.outcomes ? film.decisive : Object.keys(film.outcomes).find((key) => typeof film.outcomes[key] === "boolean");
  return name === undefined || typeof film.outcomes[name] !== "boolean" ? null : film.outcomes[name];
}

function ended(film) {
  return Object.entries(film.outcomes).map(([name, value]) => `${name}: ${value === true ? "yes" : value === false ? "no" : value}`).join(", ");
}

function show(entry, at) {
  const { film, canvas, figure, caption, view } = entry;
  draw(canvas, film, at, view);
  const over = at >= seconds(film) - 1e-6, right = decided(film);
  figure.className = over && right !== null ? (right ? "right" : "wrong") : "";
  caption.textContent = over ? ended(film) : "";
}

function wall() {
  const here = data.films.filter((film) => film.domain === domain && film.setting === setting);
  const tasks = unique(here.map((film) => film.task));
  if (!tasks.includes(task)) task = tasks[0] || "";
  find("task").replaceChildren(...tasks.map((name) => made("option", { textContent: name, selected: name === task })));
  const lines = here.filter((film) => film.task === task && !hidden.has(film.method));
  const columns = [0, 1, 2, 3].map((start) => lines.flatMap((line) => line.films.filter((film) => film.start === start)));
  films = [];
  find("wall").replaceChildren(...lines.map((line) => {
    const about = made("div", {}, made("h3", { textContent: line.method }), ...line.told.map((text) => made("p", { textContent: text })));
    const cells = line.films.map((film) => {
      const canvas = made("canvas"), caption = made("figcaption"), figure = made("figure", {}, canvas, caption);
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", `${line.method}, ${line.task}, start ${film.start + 1}`);
      films.push({ film, canvas, figure, caption, view: around(columns[film.start]) });
      return figure;
    });
    return made("div", { className: "method" }, about, ...cells);
  }));
  if (!lines.length) find("wall").append(made("p", { className: "note", textContent: "No films of this choice." }));
  length = Math.max(0.1, ...films.map((entry) => seconds(entry.film)));
  clock = Math.min(clock, length);
  paint();
}

function paint() {
  for (const entry of films) {
    const box = entry.canvas.getBoundingClientRect();
    if (box.bottom > -200 && box.top < innerHeight + 200) show(entry, clock);
  }
  find("time").value = Math.round(1000 * Math.min(clock / length, 1));
}

function tick(now) {
  const passed = Math.min((now - last) / 1000, 0.1) * Number(find("speed").value);
  last = now;
  if (playing && films.length && length > 0.1) {
    clock += passed;
    if (clock > length + PAUSE) clock = 0;
    paint();
  }
  if (alone) {
    alone.clock += passed;
    if (alone.clock > seconds(alone.film) + PAUSE) alone.clock = 0;
    draw(alone.canvas, alone.film, alone.clock, alone.film.window);
  }
  requestAnimationFrame(tick);
}

function play(on) {
  playing = on;
  find("play").textContent = on ? "\u275A\u275A" : "\u25B6";
}

function step(by) {
  play(false);
  const rate = Math.max(1, ...films.map((entry) => entry.film.rate));
  clock = Math.max(0, Math.min(length, clock + by / rate));
  paint();
}

// --- charts

function scaled(low, high, from, to) { return (value) => from + (value - low) / (high - low) * (to - from); }

function named(mark, text) {
  mark.append(drawn("title", {}, text));
  return mark;
}

function overview() {
  const shown = data.overview;
  const width = 1140, label = 330, row = 30, top = 24, height = top + row * shown.length + 10;
  const x = scaled(0, 1, label, width - 20);
  const svg = drawn("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": "means of all methods" });
  for (const tick of [0, 0.25, 0.5, 0.75, 1]) {
    svg.append(drawn("line", { class: "grid", x1: x(tick), x2: x(tick), y1: top - 6, y2: height - 8 }));
    svg.append(drawn("text", { x: x(tick), y: 12, "text-anchor": "middle", class: "soft" }, tick));
  }
  shown.forEach((line, number) => {
    const y = top + row * number + row / 2;
    const filmed = data.films.some((film) => film.domain === line.domain && film.setting === line.setting);
    const name = drawn("text", { x: 4, y: y + 4, class: filmed ? "link" : "", "font-weight": line.domain === domain ? 600 : 400 }, `${line.name}: ${line.setting}`);
    if (filmed) {
      name.setAttribute("tabindex", 0);
      name.setAttribute("role", "link");
      const go = () => { [domain, setting, clock] = [line.domain, line.setting, 0]; find("domain").value = domain; redraw(); find("films").scrollIntoView(); };
      name.addEventListener("click", go);
      name.addEventListener("keydown", (event) => { if (event.key === "Enter") go(); });
    }
    svg.append(name);
    svg.append(drawn("text", { x: 4, y: y + 15, class: "soft", style: "font-size:9px" }, line.metric + (line.less ? " (less is better)" : "")));
    for (const [name, mean] of Object.entries(line.references)) {
      svg.append(named(drawn("rect", { x: x(mean) - 1.5, y: y - 10, width: 3, height: 20, fill: "#9aa4ae" }), `${name}: ${two(mean)} (reference)`));
    }
    line.methods.filter(({ method }) => !hidden.has(method)).forEach(({ method, mean, error, paper }, place, all) => {
      const at = y + (place - (all.length - 1) / 2) * Math.min(4, 20 / all.length), colour = data.colours[method];
      if (error) svg.append(drawn("line", { x1: x(Math.max(0, mean - error)), x2: x(Math.min(1, mean + error)), y1: at, y2: at, stroke: colour, "stroke-width": 2 }));
      const text = `${method}: ${two(mean)}${error ? ` \u00b1 ${two(error)}` : ""}, ${line.setting}, ${line.metric}`;
      svg.append(named(drawn("circle", { cx: x(mean), cy: at, r: 4.5, fill: colour, tabindex: 0 }), text));
      if (paper !== null) svg.append(named(drawn("path", { d: `M${x(paper)} ${at - 5}l5 5l-5 5l-5 -5z`, fill: "none", stroke: colour, "stroke-width": 1.8 }), `${method}, the paper's: ${two(paper)}`));
    });
  });
  find("chart").replaceChildren(svg);
}

function growth() {
  const shown = data.curves.filter((plot) => domain === "" || plot.domain === domain || plot.domain === "");
  find("growth").replaceChildren(...shown.map((plot) => {
    const width = 340, height = 210, left = 34, bottom = 34;
    const all = plot.lines.flatMap((line) => line.points.map((point) => point[0]));
    const seen = plot.log ? Math.log10 : (value) => value;
    const x = scaled(seen(Math.min(...all)), seen(Math.max(...all)), left + 8, width - 20), y = scaled(0, 1, height - bottom, 10);
    const svg = drawn("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${plot.title}: ${plot.axis}` });
    for (const tick of [0, 0.5, 1]) {
      svg.append(drawn("line", { class: "grid", x1: left, x2: width - 6, y1: y(tick), y2: y(tick) }));
      svg.append(drawn("text", { x: left - 5, y: y(tick) + 4, "text-anchor": "end", class: "soft" }, tick));
    }
    for (const tick of plot.ticks) svg.append(drawn("text", { x: x(seen(tick)), y: height - bottom + 14, "text-anchor": "middle", class: "soft" }, tick));
    svg.append(drawn("text", { x: (left + width) / 2, y: height - 6, "text-anchor": "middle", class: "soft" }, plot.axis));
    plot.lines.forEach((line, number) => {
      const colour = data.palette[number % data.palette.length];
      svg.append(drawn("polyline", { points: line.points.map((point) => `${x(seen(point[0]))},${y(point[1])}`).join(" "), fill: "none", stroke: colour, "stroke-width": 2 }));
      for (const [at, mean, error] of line.points) {
        if (error) svg.append(drawn("line", { x1: x(seen(at)), x2: x(seen(at)), y1: y(Math.max(0, mean - error)), y2: y(Math.min(1, mean + error)), stroke: colour, "stroke-width": 1.5 }));
        svg.append(named(drawn("circle", { cx: x(seen(at)), cy: y(mean), r: 3.5, fill: colour, tabindex: 0 }), `${line.name}, ${at}: ${two(mean)}`));
      }
    });
    const names = made("p", { className: "note" });
    plot.lines.forEach((line, number) => names.append(made("span", { textContent: `\u25cf ${line.name}  `, style: `color:${data.palette[number % data.palette.length]}` })));
    return made("div", {}, made("h3", { textContent: plot.title }), svg, names);
  }));
}

function maps() {
  const shown = data.maps.filter((map) => domain === "" || map.domain === domain);
  find("maps").replaceChildren(...shown.map((map) => {
    const size = 340, xs = map.points.map((point) => point.x), ys = map.points.map((point) => point.y);
    const x = scaled(Math.min(...xs), Math.max(...xs), 14, size - 14), y = scaled(Math.min(...ys), Math.max(...ys), size - 14, 14);
    const svg = drawn("svg", { viewBox: `0 0 ${size} ${size}`, role: "group", "aria-label": `concepts of ${map.name}` });
    svg.append(drawn("rect", { x: 1, y: 1, width: size - 2, height: size - 2, rx: 6, fill: "none", class: "grid" }));
    for (const point of map.points) {
      const film = data.films.find((entry) => entry.domain === map.domain && entry.task === point.film && entry.ours);
      const mark = point.learned
        ? drawn("path", { d: `M${x(point.x)} ${y(point.y) - 6}l6 10l-12 0z`, fill: "#d55e00", tabindex: 0 })
        : drawn("circle", { cx: x(point.x), cy: y(point.y), r: 4.5, fill: "#0072b2", "fill-opacity": film ? 1 : 0.45, tabindex: 0 });
      named(mark, point.name);
      mark.setAttribute("aria-label", point.name);
      const chosen = () => {
        const box = find("shown");
        box.className = "on";
        box.querySelector("p").textContent = point.name + (film ? `: ${film.method}` : ": no film");
        alone = film ? { film: film.films[0], canvas: box.querySelector("canvas"), clock: 0 } : null;
        box.querySelector("canvas").style.display = film ? "block" : "none";
      };
      for (const event of ["mouseenter", "focus", "click"]) mark.addEventListener(event, chosen);
      svg.append(mark);
    }
    return made("div", {}, made("h3", { textContent: map.name }), svg,
      made("p", { className: "note", textContent: "\u25cf training concept   \u25b2 learned component" }));
  }));
}

// --- filters

function settings() {
  const here = unique(data.films.filter((film) => film.domain === domain).map((film) => film.setting));
  const methods = (name) => unique(data.films.filter((film) => film.domain === domain && film.setting === name).map((film) => film.method)).length;
  if (!here.includes(setting)) setting = here.reduce((most, name) => methods(name) > methods(most) ? name : most, here[0] || "");
  find("setting").replaceChildren(...here.map((name) => made("option", { textContent: name, selected: name === setting })));
}

function boxes() {
  const names = unique([...data.overview.filter((line) => line.domain === domain).flatMap((line) => line.methods.map((entry) => entry.method)),
    ...data.films.filter((film) => film.domain === domain).map((film) => film.method)]);
  const legend = find("methods").querySelector("legend");
  find("methods").replaceChildren(legend, ...names.map((name) => {
    const box = made("input", { type: "checkbox", checked: !hidden.has(name), value: name });
    box.addEventListener("change", () => { box.checked ? hidden.delete(name) : hidden.add(name); redraw(false); });
    const colour = made("i");
    colour.style.background = data.colours[name] || "#9aa4ae";
    return made("label", {}, box, colour, name);
  }));
}

function redraw(all = true) {
  settings();
  if (all) boxes();
  overview();
  wall();
  if (all) { maps(); growth(); }
}

function listen() {
  find("domain").addEventListener("change", (event) => { [domain, setting, clock] = [event.target.value, "", 0]; redraw(); });
  find("setting").addEventListener("change", (event) => { setting = event.target.value; clock = 0; redraw(false); });
  find("task").addEventListener("change", (event) => { task = event.target.value; clock = 0; wall(); });
  find("play").addEventListener("click", () => play(!playing));
  find("back").addEventListener("click", () => step(-1));
  find("forth").addEventListener("click", () => step(1));
  find("time").addEventListener("input", (event) => { play(false); clock = length * event.target.value / 1000; paint(); });
  find("theme").addEventListener("click", () => {
    const root = document.documentElement, dark = root.dataset.theme === "dark";
    root.dataset.theme = dark ? "light" : "dark";
  });
  addEventListener("scroll", paint, { passive: true });
  addEventListener("resize", paint);
  addEventListener("keydown", (event) => {
    if (["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName) || event.ctrlKey || event.metaKey || event.altKey) return;
    const speed = find("speed");
    const keys = { " ": () => play(!playing), ArrowLeft: () => step(-1), ArrowRight: () => step(1),
      ArrowUp: () => { speed.selectedIndex = Math.min(speed.selectedIndex + 1, speed.length - 1); },
      ArrowDown: () => { speed.selectedIndex = Math.max(speed.selectedIndex - 1, 0); } };
    if (keys[event.key]) { event.preventDefault(); keys[event.key](); }
  });
}

unpacked(find("data").textContent).then((content) => {
  data = content;
  for (const task of data.films) for (const film of task.films) film.shapes = film.shapes.map((index) => data.shapes[film.file][index]);
  document.documentElement.dataset.theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
  const moving = data.films.find((entry) => entry.films.some((film) => film.frames > 1));
  domain = moving ? moving.domain : data.domains[0].name;
  find("domain").replaceChildren(...data.domains.map(({ name, title }) => made("option", { value: name, textContent: title, selected: name === domain })));
  find("about").textContent = data.about;
  listen();
  redraw();
  last = performance.now();
  requestAnimationFrame(tick);
  document.body.dataset.ready = Math.round(performance.now()); // milliseconds until films are drawn
});
