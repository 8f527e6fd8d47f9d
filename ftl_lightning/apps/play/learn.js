// Steps 1 and 2: the demonstrations that are there, and learning a concept from them.
const learning = { stop: null, again: null, concept: null, from: "", samples: [], named: false, losses: [], changing: Promise.resolve(), more: "", back: false, unsaved: new Map() };
const many = (count, one) => `${count} ${one}${count === 1 ? "" : "s"}`;
const announce = (text) => { find("announced").textContent = text; };

// --- the slots

// Shows demonstrations. Where some were just added and there are enough, learning starts by itself.
function worked(work, added = false) {
  state.work = work;
  if (recorder.grown && recorder.grown.of !== shownNow()) { recorder.grown = null; redraw(); }
  if (JSON.stringify(work.concepts) !== JSON.stringify(state.concepts)) { state.concepts = work.concepts; conceptList(); }
  learning.back = false;
  if (learning.concept && !conceptOf(learning.concept.id)) noConcept();
  if (!learning.concept && !learning.stop) learning.concept = state.concepts.find((one) => one.from.length && JSON.stringify(one.from) === shownNow()) || null;
  if (!work.demonstrations.length) learning.task = "";
  slots();
  find("check").replaceChildren(...checks(work).map((text) => made("li", { textContent: text })));
  undoable();
  find("clear").disabled = find("save-demos").disabled = !work.demonstrations.length;
  same("work", work.same);
  if (!learning.named) find("name").value = suggested();
  if (recorder.scene) told();
  learnable();
  if (added) {
    announce(`${many(work.demonstrations.length, "demonstration")} of ${work.wanted}.`);
    learnOf(work);
  }
}

// Learning starts by itself where there are enough demonstrations and none looks wrong.
function learnOf(work) {
  if (work.demonstrations.length < work.wanted) return;
  doubt() ? announce(doubt()) : learnInSight();
}

// What is said before something is learned from demonstrations that a check flags; empty without any.
function doubt() {
  const some = state.work.demonstrations.flatMap((one, number) => one.flags.some((flag) => !alike(flag)) ? [number + 1] : []);
  if (!some.length) return "";
  if (some.length === 1) return `Demonstration ${some[0]} looks different from the others. Remove it, or press Learn.`;
  return `Demonstrations ${listed(some)} look different from the others. Remove them, or press Learn.`;
}

// A flag of several demonstrations that are alike, which hold up nothing.
const alike = (flag) => flag.startsWith("are ");

// What a check says: of each demonstration, of some that are alike, and of all.
function checks(work) {
  const each = [], together = new Map();
  work.demonstrations.forEach((one, number) => one.flags.forEach((flag) => {
    if (alike(flag)) together.set(flag, [...(together.get(flag) || []), number + 1]);
    else each.push(`\u26A0 Demonstration ${number + 1}: ${flag}`);
  }));
  return [...each, ...[...together].map(([flag, own]) => `\u26A0 Demonstrations ${listed(own)} ${flag}`), ...work.check];
}

const listed = (numbers) => numbers.length < 2 ? numbers.join() : `${numbers.slice(0, -1).join(", ")} and ${numbers.at(-1)}`;

function slots() {
  const { demonstrations, wanted } = state.work, list = find("slots"), view = slotView(demonstrations.map((one) => one.film));
  list.style.setProperty("--aspect", view && Array.isArray(view) ? view[2] / view[3] : 1);
  while (list.children.length > Math.max(wanted, demonstrations.length)) freed(list.lastChild);
  for (let number = 0; number < Math.max(wanted, demonstrations.length); number++) {
    const slot = list.children[number] || emptySlot(list, number), one = demonstrations[number];
    slot.classList.toggle("empty", !one);
    slot.number = one ? one.id : null;
    slot.rubbish.hidden = Boolean(answers);
    slot.flag.textContent = one && one.flags.length ? "\u26A0" : "";
    slot.flag.title = one ? one.flags.join(" ") : "";
    slot.film.figure.hidden = !one;
    if (one) setFilm(slot.film, one.film, view, `Demonstration ${number + 1}${one.flags.length ? `, ${one.flags.join(" ")}` : ""}`);
  }
}

// The view of all slots. With a canvas it has the shape of this from the beginning, so that nothing moves at the first one.
function slotView(shown) {
  const canvas = recorder.scene && recorder.scene.film.window;
  if (!shown.length) return canvas;
  const view = viewOf(shown);
  if (!canvas || !Array.isArray(view)) return view;
  const [left, lower, width, height] = view, wide = Math.max(width, height * canvas[2] / canvas[3]), high = wide * canvas[3] / canvas[2];
  return [left + (width - wide) / 2, lower + (height - high) / 2, wide, high];
}

function emptySlot(list, number) {
  const slot = made("li");
  slot.film = addFilm();
  slot.flag = made("span", { className: "flag", ariaHidden: "true" });
  slot.rubbish = made("button", { type: "button", className: "remove", textContent: "\u00d7", ariaLabel: `Remove demonstration ${number + 1}` });
  slot.rubbish.addEventListener("click", () => {
    const id = slot.number;
    if (state.work.demonstrations.some((one) => one.id === id)) changing(async () => worked(await ask("/api/remove", { id })));
  });
  slot.append(made("span", { className: "number", textContent: number + 1 }), slot.flag, slot.film.figure, slot.rubbish);
  list.append(slot);
  return slot;
}

function freed(slot) {
  dropCanvas(slot.film);
  slot.remove();
}

// --- learning

const KINDS = { draw: "stroke", arrange: "arrangement", steer: "trip" };

const shownNow = () => JSON.stringify(state.work.demonstrations.map((one) => one.id));

// Whether what is there is what the last concept was learned from, whose name is then the one that is shown and changed.
const justLearned = () => Boolean(learning.concept && !learning.stop && JSON.stringify(conceptOf(learning.concept.id).from) === shownNow());

function suggested() {
  if (learning.concept && ongoing()) return learning.concept.name;
  return learning.task || state.work.name ? unused(learning.task || state.work.name) : unused(`my ${(state.recorder && KINDS[state.recorder.kind]) || "behaviour"} 1`);
}

// Whether some of what is there is what the last concept was learned from: learning again replaces this concept.
const ongoing = () => state.work.demonstrations.some((one) => conceptOf(learning.concept.id).from.includes(one.id));

// A name that no concept has: numbers count up.
function unused(name) {
  const taken = new Set(state.concepts.map((one) => one.name)), [, stem, number] = /^(.*?)(?: (\d{1,6}))?$/.exec(name);
  if (!taken.has(name)) return name;
  let next = Number(number || 1) + 1;
  while (taken.has(`${stem} ${next}`)) next++;
  return `${stem.slice(0, 90)} ${next}`;
}

function learnable() {
  const count = state.work.demonstrations.length, on = Boolean(learning.stop);
  find("learn").disabled = count < 2;
  find("learn").textContent = on ? "Start again" : "Learn";
  find("learn-why").textContent = count === 1 ? "Show at least two" : "";
  find("rename").hidden = !justLearned() || named() === learning.concept.name;
  if (on) return;
  const enough = count >= state.work.wanted, waiting = find("waiting");
  waiting.classList.toggle("warned", enough && !justLearned() && Boolean(doubt()));
  if (enough && !justLearned() && doubt()) waiting.textContent = doubt();
  else if (learning.concept && (justLearned() || !count || learning.back)) waiting.textContent = learnedTold();
  else if (enough) waiting.textContent = "Press Learn.";
  else waiting.textContent = `Learning starts by itself at demonstration ${state.work.wanted}${count >= 2 ? "; or press Learn now" : ""}.`;
}

const named = () => find("name").value.trim().replace(/\s+/g, " ");

function learnedTold() {
  const { name, seconds } = conceptOf(learning.concept.id);
  return `Learned \u201c${name}\u201d in ${seconds.toFixed(1)} seconds.${learning.more}`;
}

// Gives the concept that was just learned the name that stands in the field.
function rename() {
  const name = named();
  if (!justLearned() || !name || name === learning.concept.name) return;
  if (state.concepts.some((one) => one.name === name)) { tellError(`A concept has the name \u201c${name}\u201d already: choose another one.`); return; }
  attempt(async () => {
    const found = await ask("/api/rename", { id: learning.concept.id, name });
    learning.named = false;
    learning.concept = { ...learning.concept, name };
    if (learning.unsaved.has(learning.concept.hash + learning.concept.id)) learning.unsaved.set(learning.concept.hash + learning.concept.id, name);
    await renew(found);
    samplesTold(learning.samples, name, "");
    announce(`The concept is called ${name}.`);
  });
}

function saveConcept(id) {
  const { name, hash } = conceptOf(id);
  return attempt(async () => {
    await download(`/api/concept?id=${encodeURIComponent(id)}`, `${name}.safetensors`);
    learning.unsaved.delete(hash + id);
  });
}

// Goes on without what the last concept showed: another model is worked with, or the concept is there no more.
function noConcept() {
  if (learning.again) learning.again.abort();
  Object.assign(learning, { concept: null, from: "", samples: [], more: "" });
  fill(find("samples"), [], null, () => "");
  find("quality").textContent = "";
  find("progress").hidden = find("learned").hidden = find("meaning").hidden = true;
}

const smooth = () => matchMedia("(prefers-reduced-motion: reduce)").matches ? "auto" : "smooth";

// Learning that starts by itself is brought in sight, as on a phone it is below.
function learnInSight() {
  learn();
  if (find("learning").getBoundingClientRect().top > 0.75 * innerHeight) find("learning").scrollIntoView({ behavior: smooth() });
}

async function learn() {
  for (const one of [learning.stop, learning.again]) if (one) one.abort();
  const wanted = named() || suggested(), stop = learning.stop = new AbortController();
  const former = state.concepts.find((one) => one.kind === "learned" && one.name === wanted), name = former ? wanted : unused(wanted);
  Object.assign(learning, { concept: null, losses: [], from: shownNow(), more: "" });
  find("name").value = name;
  document.body.dataset.learning = "yes";
  find("quality").textContent = "";
  find("learned").hidden = find("meaning").hidden = true;
  find("progress").hidden = false;
  find("waiting").classList.remove("warned");
  find("waiting").textContent = "Learning \u2026";
  announce(`Learning ${name}.`);
  learnable();
  await attempt(async () => {
    for await (const line of askLines("/api/learn", { name, replaces: former ? former.id : "" }, stop.signal)) {
      if (stop.signal.aborted) return;
      if (line.error) throw new Error(line.error);
      if (line.loss !== undefined) lossTold(line);
      if (line.samples) samplesTold(line.samples, name, learning.from);
      if (line.done) learned(line);
    }
  });
  if (learning.stop === stop) noLearning(); // nothing newer is learned
}

function noLearning() {
  if (learning.stop) learning.stop.abort();
  learning.stop = null;
  document.body.dataset.learning = "no";
  find("progress").hidden = !learning.concept;
  learnable();
  undoable();
}

// Samples of what was learned from demonstrations (`from`), which grow on the canvas as long as these are there.
function samplesTold(samples, name, from) {
  if (from === shownNow()) grow(samples);
  // The scale of the demonstrations, so that both can be compared.
  const view = viewOf([...state.work.demonstrations.map((one) => one.film), ...samples]);
  fill(find("samples"), samples, view, (number) => `Sample ${number + 1} of ${name}`);
  newSamples();
}

function newSamples() {
  paint();
  document.body.dataset.samples = Number(document.body.dataset.samples || 0) + 1;
}

function lossTold(line) {
  learning.losses.push([line.step, line.loss]);
  lossCurve(line.steps || line.step);
  find("loss").setAttribute("aria-label", `Loss over ${line.step} of ${line.steps} steps, now ${line.loss.toFixed(3)}`);
  find("step").textContent = `step ${line.step} of ${line.steps}, loss ${line.loss.toFixed(3)}`;
}

// The loss over so many steps, and its moving mean.
function lossCurve(steps) {
  const wide = 300, tall = 70, most = Math.max(...learning.losses.map((one) => one[1])) || 1;
  const line = (losses) => losses.map(([step, loss]) => `${(step / steps * wide).toFixed(1)},${(tall - 4 - loss / most * (tall - 8)).toFixed(1)}`).join(" ");
  const beside = Math.floor(learning.losses.length / 20);
  const smoothed = learning.losses.map(([step], at, all) => {
    const some = all.slice(Math.max(0, at - beside), at + beside + 1);
    return [step, some.reduce((sum, one) => sum + one[1], 0) / some.length];
  });
  find("loss-each").setAttribute("points", line(learning.losses));
  find("loss-mean").setAttribute("points", line(smoothed));
}

function learned(line) {
  Object.assign(learning, { named: false, more: line.more ? " It is being learned more thoroughly \u2026" : "" });
  keptAnew(line);
  if (learning.losses.length) {
    const [last] = learning.losses.at(-1);
    lossCurve(last); // learning stops where little changes
    find("step").textContent = `${last} steps, loss ${learning.losses.at(-1)[1].toFixed(3)}`;
  }
  find("waiting").textContent = learnedTold();
  announce(`${learnedTold()} ${line.quality.line} It is in the mix below.`);
  mixLearned(line.concept);
  if (line.more) learnAgain(line.concept.id);
}

// Shows a learned concept, its samples and their quality.
function kept(line) {
  learning.concept = line.concept;
  learning.samples = line.samples;
  learning.unsaved.set(line.concept.hash + line.concept.id, line.concept.name);
  state.concepts = line.concepts;
  find("quality").textContent = line.quality.line;
  find("learned").hidden = find("meaning").hidden = false;
  same("work", line.same);
  samplesTold(line.samples, line.concept.name, JSON.stringify(line.concept.from));
}

// The same in the place of an earlier concept, whose film is another one.
function keptAnew(line) {
  kept(line);
  noCard(cardKey(line.concept));
  undoable();
}

// Learns a concept in the form that its demonstrations select, which takes longer; what is better replaces it.
async function learnAgain(id) {
  const stop = learning.again = new AbortController();
  document.body.dataset.again = "yes";
  await attempt(async () => {
    for await (const line of askLines("/api/learn", { again: id }, stop.signal)) {
      if (stop.signal.aborted) return;
      if (line.error) throw new Error(line.error);
      if (line.done) learnedAgain(line);
    }
  });
  if (learning.again !== stop) return;
  learning.again = null;
  document.body.dataset.again = "no";
}

function learnedAgain(line) {
  const took = `${line.seconds.toFixed(0)} seconds`;
  learning.more = line.concept ? ` Learned more thoroughly in ${took}.` : ` Learning more thoroughly for ${took} was not better.`;
  if (justLearned()) find("check").append(...line.check.map((text) => made("li", { textContent: `\u26A0 ${text}` })));
  if (line.concept) {
    keptAnew(line);
    mixed();
    find("progress").hidden = true; // of the first learning
  }
  learnable();
  announce(`${learnedTold()}${line.concept ? ` ${line.quality.line}` : ""}`);
}

// --- the same as a program

function same(where, text) {
  if (!text) return;
  const [python, command] = where === "mix" ? ["python", "command"] : ["work-python", "work-command"];
  find(python).textContent = text.python;
  find(command).textContent = text.command;
}

async function copy(button) {
  const text = find(button.dataset.copies).textContent, before = button.textContent;
  try {
    await navigator.clipboard.writeText(text);
    button.textContent = "Copied";
    announce("Copied.");
  } catch {
    getSelection().selectAllChildren(find(button.dataset.copies));
    button.textContent = "Selected: press Ctrl+C";
  }
  setTimeout(() => { button.textContent = before; }, 2000);
}

// --- other ways to get demonstrations

function setWays() {
  const { library, uploads } = state, known = state.concepts.filter((one) => one.kind === "training").map((one) => one.name);
  const first = library.tasks.find((task) => !known.includes(task)); // something new
  find("library").replaceChildren(...library.tasks.map((task) => made("option", { value: task, textContent: task, selected: task === first })));
  find("library").disabled = find("draw").disabled = find("drawing").hidden = !library.tasks.length;
  find("library-why").textContent = library.why;
  find("upload").accept = uploads.join(",");
  find("upload-kinds").textContent = uploads.join(", ");
  find("draw").textContent = `Take ${["none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten"][state.work.wanted] || state.work.wanted}`;
}

async function upload(file) {
  if (!file) return;
  await attempt(async () => {
    const before = JSON.stringify(state.work.demonstrations.map((one) => one.id));
    const found = await ask(`/api/upload?name=${encodeURIComponent(file.name)}`, file);
    const added = JSON.stringify(found.work.demonstrations.map((one) => one.id)) !== before;
    await renew(found);
    announce(`${file.name} is opened.`);
    if (added) learnOf(found.work);
  });
}

// Undo brings back a concept that was just replaced; otherwise it undoes the last change of the demonstrations.
const replaced = () => justLearned() && conceptOf(learning.concept.id).former;

function undoable() {
  find("undo").disabled = !state.work.undo && !replaced();
  find("undo").title = `Ctrl+Z${replaced() ? `: brings back the former \u201c${learning.concept.name}\u201d` : ""}`;
}

// Changes of demonstrations, one after another. What is being learned from them is given up.
function changing(change) {
  if (learning.stop) noLearning();
  learning.changing = learning.changing.then(() => attempt(change));
  return learning.changing;
}

const undo = () => changing(async () => {
  if (!replaced()) { worked(await ask("/api/undo", {})); return; }
  if (learning.again) learning.again.abort();
  const line = await ask("/api/restore", { id: learning.concept.id });
  Object.assign(learning, { more: " The former one is back.", back: true, named: false });
  find("progress").hidden = true;
  keptAnew(line);
  mixed();
  find("name").value = suggested();
  learnable();
  announce(`The former ${line.concept.name} is back.`);
});

function listenToWork() {
  find("undo").addEventListener("click", undo);
  find("clear").addEventListener("click", () => changing(async () => worked(await ask("/api/clear", {}))));
  find("learn").addEventListener("click", learn);
  find("name").addEventListener("input", () => { learning.named = find("name").value.trim() !== ""; learnable(); });
  find("name").addEventListener("keydown", (event) => { if (event.key === "Enter") rename(); });
  find("rename").addEventListener("click", rename);
  find("save").addEventListener("click", () => saveConcept(learning.concept.id));
  find("save-its").addEventListener("click", () => attempt(() => download(`/api/demonstrations?id=${encodeURIComponent(learning.concept.id)}`, "demonstrations.npz")));
  find("to-mix").addEventListener("click", () => {
    find("mix-title").scrollIntoView({ behavior: smooth() });
    find("mix-title").focus({ preventScroll: true });
  });
  find("save-demos").addEventListener("click", () => attempt(() => download("/api/demonstrations", "demonstrations.npz")));
  find("draw").addEventListener("click", () => attempt(async () => {
    find("draw").disabled = true;
    try {
      const task = find("library").value, work = await ask("/api/draw", { task, count: state.work.wanted });
      learning.task = task;
      worked(work, true);
    } finally { find("draw").disabled = false; }
  }));
  find("upload").addEventListener("change", async () => { await upload(find("upload").files[0]); find("upload").value = ""; });
  for (const button of document.querySelectorAll("[data-copies]")) button.addEventListener("click", () => copy(button));
  addEventListener("keydown", (event) => {
    if (event.key.toLowerCase() !== "z" || !(event.ctrlKey || event.metaKey) || event.shiftKey || event.repeat || ["text", "search"].includes(event.target.type)) return;
    if (recorder.down || find("large").open || find("sure").open) return;
    if (!find("undo").disabled && !answers) { event.preventDefault(); undo(); }
  });
  for (const kind of ["dragover", "drop"]) {
    addEventListener(kind, (event) => {
      if (!event.dataTransfer || ![...event.dataTransfer.types].includes("Files") || answers || state.viewer) return;
      event.preventDefault();
      document.body.classList.toggle("dropping", kind === "dragover");
      if (kind === "drop") upload(event.dataTransfer.files[0]);
    });
  }
  addEventListener("dragleave", (event) => { if (!event.relatedTarget) document.body.classList.remove("dropping"); });
}
