"use strict";
// Films of shapes that move, drawn on a canvas, and how pages make elements. Nothing is loaded.
const SVG = "http://www.w3.org/2000/svg";
const ABSENT = -32768;
const find = (id) => document.getElementById(id);
const made = (name, of = {}, ...inside) => {
  const one = document.createElement(name);
  Object.assign(one, of);
  one.append(...inside);
  return one;
};
const drawn = (name, of = {}, text) => {
  const one = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(of)) one.setAttribute(key, value);
  if (text !== undefined) one.textContent = text;
  return one;
};

async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text.trim()), (one) => one.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).json();
}

// 16-bit numbers of something that has them packed as `points`, unpacked once.
function points(packed) {
  if (!packed.at) {
    const bytes = Uint8Array.from(atob(packed.points), (one) => one.charCodeAt(0));
    packed.at = new Int16Array(bytes.buffer);
  }
  return packed.at;
}

// Where a shape's points are at a time between frames, in the film's unit; null where it is not there.
function placed(shape, film, frame) {
  const at = points(shape), size = 2 * shape.count, frames = at.length / size;
  const before = Math.min(Math.floor(frame), frames - 1), after = Math.min(before + 1, frames - 1);
  const part = frames > 1 ? Math.min(frame - before, 1) : 0, found = [];
  const [left, lower, width] = film.window;
  for (let index = 0; index < size; index += 2) {
    const one = [at[before * size + index], at[before * size + index + 1]];
    let other = [at[after * size + index], at[after * size + index + 1]];
    if (one[0] === ABSENT) return null;
    if (other[0] === ABSENT) other = one;
    found.push([left + (one[0] + part * (other[0] - one[0])) * width / 10000, lower + (one[1] + part * (other[1] - one[1])) * width / 10000]);
  }
  return found;
}

// Makes a canvas as fine as the screen, for a picture of this height over width; returns its width and height in pixels.
function fitted(canvas, tall) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const across = Math.round((canvas.clientWidth || 240) * ratio), down = Math.round(across * tall);
  if (canvas.width !== across || canvas.height !== down) [canvas.width, canvas.height] = [across, down];
  return [across, down];
}

// Draws a film at a time. View: left, lower edge, width, height, in the film's unit. How: `over` what is there, `alpha`, and
// `moved`, how far shapes are moved, by their number.
function draw(canvas, film, seconds, view, how = {}) {
  const [left, lower, width, height] = view;
  const [across, down] = fitted(canvas, height / width);
  const pen = canvas.getContext("2d"), scale = across / width, fine = across / (canvas.clientWidth || across);
  const frame = Math.min(seconds * film.rate, film.frames - 1);
  if (!how.over) pen.clearRect(0, 0, across, down);
  pen.globalAlpha = how.alpha || 1;
  pen.lineCap = pen.lineJoin = "round";
  film.shapes.forEach((shape, number) => {
    const [right, up] = (how.moved && how.moved[number]) || [0, 0];
    const x = (place) => (place[0] + right - left) * scale, y = (place) => down - (place[1] + up - lower) * scale;
    let places = placed(shape, film, frame);
    if (!places) return;
    if (shape.kind === "way") {
      const way = [];
      for (let step = 0; step <= Math.floor(frame); step++) way.push(...(placed(shape, film, step) || []));
      places = [...way, ...places];
    }
    pen.fillStyle = pen.strokeStyle = shape.colour;
    pen.lineWidth = Math.max((shape.size || 0) * scale, (shape.kind === "way" ? 2.5 : 1.5) * fine); // seen in a large view too
    if (shape.kind === "dots") {
      for (const place of places) {
        pen.beginPath();
        pen.arc(x(place), y(place), Math.max(shape.size * scale, 1), 0, 2 * Math.PI);
        if (shape.hollow) { pen.lineWidth = Math.max(2, 0.3 * shape.size * scale); pen.stroke(); } else pen.fill();
      }
      return;
    }
    pen.beginPath();
    places.forEach((place, number) => number ? pen.lineTo(x(place), y(place)) : pen.moveTo(x(place), y(place)));
    if (shape.kind === "area") { pen.closePath(); shape.hollow ? pen.stroke() : pen.fill(); } else pen.stroke();
  });
  pen.globalAlpha = 1;
}

const seconds = (film) => Math.max(film.frames - 1, 0) / film.rate;

// What is in sight in all of some films.
function around(some) {
  const left = Math.min(...some.map((film) => film.window[0])), lower = Math.min(...some.map((film) => film.window[1]));
  const right = Math.max(...some.map((film) => film.window[0] + film.window[2]));
  const upper = Math.max(...some.map((film) => film.window[1] + film.window[3]));
  return [left, lower, right - left, upper - lower];
}
