// Bodies in space: seen from one place without perspective, turned together by dragging or with arrow keys.
const looking = { side: 28 * Math.PI / 180, above: 12 * Math.PI / 180, turned: 0 }; // about the vertical, above the floor, how often
const LIMB = 0.045; // width of a line in metres
const FLOOR = "#eef0f2", SHADE = "#d6dade";

function turn(across, up) {
  looking.side += across;
  looking.above = Math.max(-0.1, Math.min(1.5, looking.above + up));
  looking.turned += 1;
}

// To the right, upwards, and towards the viewer, in metres, of a place in space.
function seenFrom(x, y, z) {
  const near = x * Math.sin(looking.side) + y * Math.cos(looking.side);
  return [-x * Math.cos(looking.side) + y * Math.sin(looking.side), z * Math.cos(looking.above) - near * Math.sin(looking.above),
    near * Math.cos(looking.above) + z * Math.sin(looking.above)];
}

// How far a body goes: the radius of the floor that it needs and its height, in metres.
function reach(film) {
  const space = film.space;
  if (!space.reach) {
    const at = points(space);
    let [radius, height] = space.room;
    for (let index = 0; index < at.length; index += 3) {
      radius = Math.max(radius, Math.hypot(at[index], at[index + 1]) / 1000);
      height = Math.max(height, at[index + 2] / 1000);
    }
    space.reach = [radius, height];
  }
  return space.reach;
}

// The square that bodies within such a reach are seen in, from wherever they are looked at.
function roomAround(films) {
  const radius = Math.max(...films.map((film) => reach(film)[0])), height = Math.max(...films.map((film) => reach(film)[1]));
  return { radius, height, side: 1.06 * Math.max(2 * radius, Math.hypot(height, radius)) };
}

function drawBody(canvas, film, seconds, room, how = {}) {
  const [across, down] = fitted(canvas, 1);
  const pen = canvas.getContext("2d"), scale = across / room.side, space = film.space;
  const at = points(space), size = 3 * space.count, frame = Math.min(seconds * film.rate, film.frames - 1);
  const before = Math.floor(frame), after = Math.min(before + 1, film.frames - 1), part = frame - before;
  const front = room.radius * Math.sin(looking.above), top = Math.max(room.height * Math.cos(looking.above), front);
  const middle = down / 2 + scale * (top - front) / 2; // of the floor, so that all is in the middle of the picture
  const pixel = ([right, up]) => [across / 2 + right * scale, middle - up * scale];
  const body = [], shade = [];
  for (let point = 0; point < space.count; point++) {
    const [x, y, z] = [0, 1, 2].map((axis) => {
      const one = at[before * size + 3 * point + axis];
      return (one + part * (at[after * size + 3 * point + axis] - one)) / 1000;
    });
    body.push(seenFrom(x, y, z));
    shade.push(seenFrom(x, y, 0));
  }
  if (!how.over) {
    pen.clearRect(0, 0, across, down);
    for (const ring of [1, 2 / 3, 1 / 3]) {
      const wide = room.radius * ring * scale;
      pen.beginPath();
      pen.ellipse(across / 2, middle, wide, wide * Math.abs(Math.sin(looking.above)), 0, 0, 2 * Math.PI);
      pen.fillStyle = FLOOR;
      if (ring === 1) pen.fill();
      pen.strokeStyle = SHADE;
      pen.lineWidth = 1;
      pen.stroke();
    }
  }
  pen.globalAlpha = how.alpha || 1;
  pen.lineCap = "round";
  pen.lineWidth = Math.max(LIMB * scale, 1.5);
  const line = (from, to, colour) => {
    pen.strokeStyle = colour;
    pen.beginPath();
    pen.moveTo(...pixel(from));
    pen.lineTo(...pixel(to));
    pen.stroke();
  };
  if (!how.over) for (const [a, b] of space.lines) line(shade[a], shade[b], SHADE);
  // What is nearer hides what is behind it.
  const parts = space.lines.map(([a, b], number) => [(body[a][2] + body[b][2]) / 2, () => line(body[a], body[b], space.colours[number])]);
  for (const [point, radius, colour] of space.heads) {
    parts.push([body[point][2], () => {
      pen.fillStyle = colour;
      pen.beginPath();
      pen.arc(...pixel(body[point]), radius * scale, 0, 2 * Math.PI);
      pen.fill();
    }]);
  }
  for (const [, paint] of parts.sort((one, other) => one[0] - other[0])) paint();
  pen.globalAlpha = 1;
}

// What is in sight in all of some films of either kind: their window if they have one in common, else what is no higher than wide.
function viewOf(films) {
  if (films.some((film) => film.space)) return roomAround(films);
  if (films.length > 1 && films.every((film) => film.window.every((edge, number) => edge === films[0].window[number]))) return films[0].window;
  const [left, lower, width, height] = around(films), wide = Math.max(width, height), high = Math.max(height, 0.5 * width);
  return [left + (width - wide) / 2, lower + (height - high) / 2, wide, high];
}

// The view that there was, if it does for other films too: samples that follow a slider keep their scale.
function steadyView(before, films) {
  const now = viewOf(films);
  if (!before || Array.isArray(before) !== Array.isArray(now)) return now;
  if (!Array.isArray(now)) return now.radius <= before.radius && now.height <= before.height && now.side > 0.6 * before.side ? before : now;
  const within = [0, 1].every((axis) => now[axis] >= before[axis] && now[axis] + now[axis + 2] <= before[axis] + before[axis + 2]);
  return within && now[2] > 0.6 * before[2] && now[3] > 0.6 * before[3] ? before : now;
}

// A part of a view around the last shape of a film, if the whole were drawn too small.
function closer(canvas, film, at, view) {
  const wide = canvas.clientWidth / (film.scale || 1);
  const places = film.scale && wide < view[2] && placed(film.shapes.at(-1), film, Math.min(at * film.rate, film.frames - 1));
  if (!places) return view;
  const [x, y] = [0, 1].map((axis) => places.reduce((sum, place) => sum + place[axis], 0) / places.length), high = wide * view[3] / view[2];
  return [x - wide / 2, y - high / 2, wide, high];
}

function drawFilm(canvas, film, at, view, how) {
  if (film.space) drawBody(canvas, film, at, view, how);
  else draw(canvas, film, at, how.over || how.alpha < 1 ? view : closer(canvas, film, at, view), how);
}
