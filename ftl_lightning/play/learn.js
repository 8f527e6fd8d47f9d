// Steps 1 and 2: the demonstrations that are there, and learning a concept from them.
const learning = { stop: null, concept: null, named: false, losses: [] };
const many = (count, one) => `${count} ${one}${count === 1 ? "" : "s"}`;
const announce = (text) => { find("announced").textContent = text; };

// --- the slots

// Shows demonstrations. Where some were just added and there are enough, learning starts by itself.
function worked(work, added = false) {
  state.work = work;
  if (!work.demonstrations.length) learning.task = "";
  slots();
  find("check").replaceChildren(...checks(work).map((text) => made("li", { textContent: text })));
  find("undo").disabled = !work.undo;
  find("clear").disabled = find("save-demos").disabled = !work.demonstrations.length;
  same("work", work.same);
  if (!learning.named) find("name").value = suggested();
  if (recorder.scene) told();
  learnable();
  if (added) {
    announce(`${many(work.demonstrations.length, "demonstration")} of ${work.wanted}.`);
    if (work.demonstrations.length >= work.wanted) learnInSight();
  }
}

const checks = (work) => [...work.demonstrations.flatMap((one, number) => one.flags.map((flag) => `\u26A0 Demonstration ${number + 1}: ${flag}`)), ...work.check];

function slots() {
  const { demonstrations, wanted } = state.work, list = find("slots"), view = demonstrations.length ? viewOf(demonstrations.map((one) => one.film)) : null;
  while (list.children.length > Math.max(wanted, demonstrations.length)) freed(list.lastChild);
  for (let number = 0; number < Math.max(wanted, demonstrations.length); number++) {
    const slot = list.children[number] || emptySlot(list, number), one = demonstrations[number];
    slot.classList.toggle("empty", !one);
    slot.number = one ? one.id : null;
    slot.rubbish.hidden = !one || Boolean(answers);
    slot.flag.textContent = one && one.flags.length ? "\u26A0" : "";
    slot.flag.title = one ? one.flags.join(" ") : "";
    slot.film.figure.hidden = !one;
    if (one) setFilm(slot.film, one.film, view, `Demonstration ${number + 1}${one.flags.length ? `, ${one.flags.join(" ")}` : ""}`);
  }
}

function emptySlot(list, number) {
  const slot = made("li");
  slot.film = addFilm();
  slot.flag = made("span", { className: "flag", ariaHidden: "true" });
  slot.rubbish = made("button", { type: "button", className: "remove", textContent: "\u00d7", ariaLabel: `Remove demonstration ${number + 1}` });
  slot.rubbish.addEventListener("click", () => attempt(async () => worked(await ask("/api/remove", { id: slot.number }))));
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

function suggested() {
  const learned = state.concepts.filter((one) => one.kind === "learned").length;
  return learning.task || `my ${(state.recorder && KINDS[state.recorder.kind]) || "behaviour"} ${learned + 1}`;
}

function learnable() {
  const count = state.work.demonstrations.length, on = Boolean(learning.stop);
  find("learn").disabled = count < 2;
  find("learn").textContent = on ? "Start again" : "Learn";
  if (!on && !learning.concept) {
    find("waiting").textContent = count < state.work.wanted
      ? `Learning starts by itself at demonstration ${state.work.wanted}${count >= 2 ? "; or press Learn now" : ""}.` : "Press Learn.";
  }
}

const smooth = () => matchMedia("(prefers-reduced-motion: reduce)").matches ? "auto" : "smooth";

// Learning that starts by itself is brought in sight, as on a phone it is below.
function learnInSight() {
  learn();
  if (find("learning").getBoundingClientRect().top > 0.75 * innerHeight) find("learning").scrollIntoView({ behavior: smooth() });
}

async function learn() {
  if (learning.stop) learning.stop.abort();
  const stop = learning.stop = new AbortController(), name = find("name").value.trim() || suggested();
  Object.assign(learning, { concept: null, losses: [] });
  document.body.dataset.learning = "yes";
  find("quality").textContent = "";
  find("learned").hidden = true;
  find("progress").hidden = false;
  find("waiting").textContent = "Learning \u2026";
  announce(`Learning ${name}.`);
  learnable();
  await attempt(async () => {
    for await (const line of askLines("/api/learn", { name, quick: !find("careful").checked }, stop.signal)) {
      if (stop.signal.aborted) return;
      if (line.error) throw new Error(line.error);
      if (line.loss !== undefined) lossTold(line);
      if (line.samples) samplesTold(line.samples, name);
      if (line.done) learned(line);
    }
  });
  if (learning.stop !== stop) return; // something newer is learned
  learning.stop = null;
  document.body.dataset.learning = "no";
  find("progress").hidden = !learning.concept;
  if (!learning.concept) find("waiting").textContent = "";
  learnable();
}

function samplesTold(samples, name) {
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
  learning.concept = line.concept;
  learning.named = false;
  state.concepts = line.concepts;
  const took = `Learned \u201c${line.concept.name}\u201d in ${line.seconds.toFixed(1)} seconds.`;
  find("waiting").textContent = took;
  find("quality").textContent = line.quality.line;
  find("learned").hidden = false;
  same("work", line.same);
  samplesTold(line.samples, line.concept.name);
  if (learning.losses.length) {
    const [last] = learning.losses.at(-1);
    lossCurve(last); // learning stops where little changes
    find("step").textContent = `${last} steps, loss ${learning.losses.at(-1)[1].toFixed(3)}`;
  }
  announce(`${took} ${line.quality.line} It is in the mix below.`);
  mixLearned(line.concept);
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
  find("draw").textContent = `Draw ${["none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten"][state.work.wanted] || state.work.wanted}`;
}

async function upload(file) {
  if (!file) return;
  await attempt(async () => {
    const before = JSON.stringify(state.work.demonstrations.map((one) => one.id));
    const found = await ask(`/api/upload?name=${encodeURIComponent(file.name)}`, file);
    const added = JSON.stringify(found.work.demonstrations.map((one) => one.id)) !== before;
    await renew(found);
    announce(`${file.name} is opened.`);
    if (added && found.work.demonstrations.length >= found.work.wanted) learnInSight();
  });
}

const undo = () => attempt(async () => worked(await ask("/api/undo", {})));

function listenToWork() {
  find("undo").addEventListener("click", undo);
  find("clear").addEventListener("click", () => attempt(async () => worked(await ask("/api/clear", {}))));
  find("learn").addEventListener("click", learn);
  find("name").addEventListener("input", () => { learning.named = find("name").value.trim() !== ""; });
  find("save").addEventListener("click", () => attempt(() => download(`/api/concept?id=${encodeURIComponent(learning.concept.id)}`, `${learning.concept.name}.safetensors`)));
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
    if (event.key.toLowerCase() !== "z" || !(event.ctrlKey || event.metaKey) || event.shiftKey || ["text", "search"].includes(event.target.type)) return;
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
