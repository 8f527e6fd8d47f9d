"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const main = document.getElementById("main");
  const place = "study-" + data.study;
  const REST = 0.5; // seconds that a film rests before it starts again
  const INK_SHADOW = "#d6dade";

  // What this rater has answered so far, kept in this browser.

  let kept = true;
  let state = null;
  try {
    state = JSON.parse(localStorage.getItem(place));
  } catch (error) {
    kept = false;
  }
  if (!state || state.page !== data.page) state = fresh();

  function fresh() {
    const digits = crypto.getRandomValues(new Uint8Array(8));
    const rater = Array.from(digits, (value) => value.toString(16).padStart(2, "0")).join("");
    return { page: data.page, rater, agreed: null, age: null, at: 0, answers: {} };
  }

  function keep() {
    try {
      localStorage.setItem(place, JSON.stringify(state));
    } catch (error) {
      kept = false;
    }
  }

  // The order: films alone first, then comparisons, each drawn from the rater's own number.

  function randoms(text) {
    let seed = parseInt(text.slice(0, 8), 16) >>> 0;
    return () => { // mulberry32
      seed = (seed + 0x6d2b79f5) >>> 0;
      let t = seed;
      t = Math.imul(t ^ (t >>> 15), t | 1);
      t ^= t + Math.imul(t ^ (t >>> 7), t | 61);
      return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
    };
  }

  function shuffled(list, random) {
    const found = list.slice();
    for (let last = found.length - 1; last > 0; last--) {
      const other = Math.floor(random() * (last + 1));
      [found[last], found[other]] = [found[other], found[last]];
    }
    return found;
  }

  function nearest(questions) { // the least distance of two questions about the same film
    const seen = {};
    let least = Infinity;
    questions.forEach((question, index) => {
      const film = question.films[0];
      if (film in seen) least = Math.min(least, index - seen[film]);
      seen[film] = index;
    });
    return least;
  }

  function ordered() {
    const random = randoms(state.rater);
    const single = data.questions.filter((question) => question.films.length === 1);
    let best = shuffled(single, random);
    for (let trial = 0; trial < 50 && nearest(best) < Math.max(2, single.length / 4); trial++) {
      const other = shuffled(single, random);
      if (nearest(other) > nearest(best)) best = other;
    }
    const several = shuffled(data.questions.filter((question) => question.films.length > 1), random);
    return [...best, ...several.map((question) => ({ ...question, films: shuffled(question.films, random) }))];
  }

  let order = ordered();

  // Films.

  function decoded(film) {
    if (!film.values) film.values = new Int16Array(Uint8Array.from(atob(film.points), (letter) => letter.charCodeAt(0)).buffer);
    return film.values;
  }

  function seconds(id) {
    const film = data.films[id];
    return film.gif ? film.seconds : (film.frames - 1) / data.drawing.rate;
  }

  let playing = [];
  let began = 0;

  function filmElement(id, label) {
    const film = data.films[id];
    if (film.gif) {
      const picture = document.createElement("img");
      picture.src = "data:image/gif;base64," + film.gif;
      picture.alt = label;
      return picture;
    }
    const canvas = document.createElement("canvas");
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", label);
    playing.push([canvas, film]);
    return canvas;
  }

  function draw(canvas, film, time) {
    const how = data.drawing;
    const side = Math.max(1, Math.round(canvas.clientWidth * (window.devicePixelRatio || 1)));
    if (canvas.width !== side) canvas.width = canvas.height = side;
    const pen = canvas.getContext("2d");
    const values = decoded(film);
    const at = Math.min(time * how.rate, film.frames - 1);
    const before = Math.floor(at);
    const after = Math.min(before + 1, film.frames - 1);
    const share = at - before;
    const value = (point, axis) => {
      const index = point * 3 + axis;
      const size = how.points * 3;
      return ((1 - share) * values[before * size + index] + share * values[after * size + index]) / 1000;
    };
    const margin = 0.04 * side;
    const scale = (side - 2 * margin) / how.window[2];
    const x = (across) => margin + (across - how.window[0]) * scale;
    const y = (up) => side - margin - (up - how.window[1]) * scale;
    const [sine, cosine] = [Math.sin(how.above), Math.cos(how.above)];
    const body = Array.from({ length: how.points }, (_, point) => [0, 1, 2].map((axis) => value(point, axis)));

    pen.fillStyle = "#fff";
    pen.fillRect(0, 0, side, side);
    [1, 2 / 3, 1 / 3].forEach((part, ring) => {
      pen.beginPath();
      pen.ellipse(x(0), y(0), how.floor * part * scale, how.floor * part * sine * scale, 0, 0, 2 * Math.PI);
      pen.fillStyle = "#eef0f2";
      if (!ring) pen.fill();
      pen.strokeStyle = INK_SHADOW;
      pen.lineWidth = Math.max(1, side / 300);
      pen.stroke();
    });
    pen.lineCap = "round";
    pen.lineWidth = 0.045 * scale;
    const line = (a, b, colour) => {
      pen.strokeStyle = colour;
      pen.beginPath();
      pen.moveTo(x(a[0]), y(a[1]));
      pen.lineTo(x(b[0]), y(b[1]));
      pen.stroke();
    };
    const shadow = body.map(([across, up, near]) => [across, -(near * cosine - up * sine) * sine]);
    how.lines.forEach(([a, b]) => line(shadow[a], shadow[b], INK_SHADOW));
    how.lines
      .map(([a, b], index) => [body[a][2] + body[b][2], a, b, how.colours[index]])
      .sort((one, other) => one[0] - other[0]) // what is nearer hides what is behind it
      .forEach(([, a, b, colour]) => line(body[a], body[b], colour));
    how.heads.forEach(([point, radius, colour]) => {
      pen.fillStyle = colour;
      pen.beginPath();
      pen.arc(x(body[point][0]), y(body[point][1]), radius * scale, 0, 2 * Math.PI);
      pen.fill();
    });
  }

  function tick(now) {
    if (!began) began = now;
    for (const [canvas, film] of playing) {
      const length = (film.frames - 1) / data.drawing.rate;
      const time = ((now - began) / 1000) % (length + REST);
      draw(canvas, film, Math.min(time, length));
    }
    requestAnimationFrame(tick);
  }

  // Screens.

  function element(kind, properties = {}, ...children) {
    const made = Object.assign(document.createElement(kind), properties);
    made.append(...children);
    return made;
  }

  function clear() {
    playing = [];
    began = 0;
    ready = 0;
    main.replaceChildren();
    window.scrollTo(0, 0);
  }

  function progress() {
    const done = order.filter((question) => question.id in state.answers).length;
    const bar = document.getElementById("bar");
    bar.setAttribute("aria-valuemax", order.length);
    bar.setAttribute("aria-valuenow", done);
    bar.firstElementChild.style.width = (100 * done) / order.length + "%";
    const lost = kept ? "" : " · this browser keeps nothing: please finish in one go";
    document.getElementById("count").textContent = (state.agreed ? `${done} of ${order.length} answered` : "") + lost;
  }

  function heading(text) {
    const made = element("h1", { textContent: text, tabIndex: -1 });
    main.append(made);
    made.focus({ preventScroll: true });
  }

  function welcome() {
    clear();
    heading(data.title);
    const box = element("input", { type: "checkbox", id: "agree" });
    const age = element("input", { type: "number", id: "age", min: 18, max: 120, inputMode: "numeric" });
    const go = element("button", { className: "main", id: "start", textContent: "Start", disabled: true });
    box.addEventListener("change", () => { go.disabled = !box.checked; });
    go.addEventListener("click", () => {
      state.agreed = new Date().toISOString();
      state.age = Number(age.value) >= 18 && Number(age.value) <= 120 ? Math.round(Number(age.value)) : null;
      keep();
      show();
    });
    const text = element("div", { className: "text" });
    data.consent.split(/\n{2,}/).forEach((part) => text.append(element("p", { textContent: part })));
    text.append(
      element("label", {}, box, data.agree),
      element("label", {}, "Your age, if you like:", age),
      element("div", { className: "answers" }, go),
    );
    main.append(text);
  }

  let ready = 0; // when the film has been shown once
  let began_question = 0;

  function show() {
    progress();
    if (!state.agreed) return welcome();
    if (state.at >= order.length) return done();
    clear();
    const question = order[state.at];
    const several = question.films.length > 1;
    heading(question.text);
    const given = state.answers[question.id];
    const buttons = [];
    const choose = (value) => answer(question, value);
    const films = element("div", { className: several ? "films" : "films one" });
    question.films.forEach((id, index) => {
      const film = filmElement(id, several ? `film ${index + 1}` : "the film");
      if (several) {
        const button = element("button", { className: "film" }, film, element("span", { textContent: `Film ${index + 1}` }));
        button.dataset.answer = id;
        button.dataset.key = String(index + 1);
        buttons.push(button);
        films.append(button);
      } else {
        films.append(element("div", { className: "film" }, film));
      }
    });
    main.append(films);
    if (!several) {
      const row = element("div", { className: "answers" });
      for (const [value, label] of [["yes", "Yes"], ["no", "No"]]) {
        const button = element("button", { textContent: label });
        button.dataset.answer = value;
        button.dataset.key = value[0];
        buttons.push(button);
        row.append(button);
      }
      main.append(row);
    }
    const wait = given ? 0 : 1000 * Math.max(...question.films.map(seconds));
    buttons.forEach((button) => {
      button.disabled = wait > 0;
      if (given && given.answer === button.dataset.answer) button.classList.add("chosen");
      button.addEventListener("click", () => choose(button.dataset.answer));
    });
    began_question = performance.now();
    ready = began_question + wait;
    setTimeout(() => buttons.forEach((button) => { button.disabled = false; }), wait);
    const back = element("button", { className: "quiet", id: "back", textContent: "Back to the last question" });
    back.hidden = state.at === 0;
    back.addEventListener("click", goBack);
    const keys = several ? `Keys: 1 to ${question.films.length}` : "Keys: Y, N";
    main.append(element("p", { className: "hint keys", textContent: `${keys}; Backspace goes back.` }), back);
  }

  function answer(question, value) {
    if (performance.now() < ready) return;
    state.answers[question.id] = {
      id: question.id,
      answer: value,
      place: state.at,
      milliseconds: Math.round(performance.now() - began_question),
      time: new Date().toISOString(),
    };
    state.at += 1;
    // After a step back, go on where the first question without an answer is.
    while (state.at < order.length && order[state.at].id in state.answers) state.at += 1;
    keep();
    show();
  }

  function goBack() {
    if (state.at === 0) return;
    state.at -= 1;
    keep();
    show();
  }

  function answers() {
    return {
      kind: "study answers",
      format: 1,
      study: data.study,
      page: data.page,
      rater: state.rater,
      age: state.age,
      agreed: state.agreed,
      finished: state.finished,
      answers: order.map((question) => state.answers[question.id]),
    };
  }

  function done() {
    if (!state.finished) {
      state.finished = new Date().toISOString();
      keep();
    }
    clear();
    heading("Thank you. All questions are answered.");
    const content = JSON.stringify(answers(), null, 1) + "\n";
    const save = element("button", { className: "main", id: "save", textContent: "Save my answers" });
    save.addEventListener("click", () => {
      const link = element("a", {
        href: URL.createObjectURL(new Blob([content], { type: "application/json" })),
        download: `answers-${state.rater}.json`,
      });
      document.body.append(link);
      link.click();
      link.remove();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    });
    const shown = element("textarea", { readOnly: true, value: content, ariaLabel: "answers as text" });
    const back = element("button", { className: "quiet", id: "back", textContent: "Back to the last question" });
    back.addEventListener("click", () => { state.finished = null; goBack(); });
    const again = element("button", { className: "quiet", id: "again", textContent: "Another person answers" });
    again.addEventListener("click", () => {
      if (!window.confirm("The answers that are kept in this browser will be deleted. Are they saved?")) return;
      state = fresh();
      order = ordered();
      keep();
      show();
    });
    main.append(
      element("p", { textContent: "Please save the file and send it to whoever asked you." }),
      element("div", { className: "answers" }, save),
      element("details", { className: "text" }, element("summary", { textContent: "Saving does not work? Copy the text." }), shown),
      element("p", {}, back, again),
    );
  }

  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, textarea")) return;
    if (event.key === "Backspace") {
      const back = document.getElementById("back");
      if (back && !back.hidden) back.click();
      event.preventDefault();
      return;
    }
    const button = document.querySelector(`button[data-key="${CSS.escape(event.key.toLowerCase())}"]`);
    if (button && !button.disabled && !event.repeat) button.click();
  });

  requestAnimationFrame(tick);
  show();
})();
