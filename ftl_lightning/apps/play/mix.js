// Step 3: concepts in a mix, each with its weight, and samples of the mix that follow the sliders.
const WAIT = 50; // milliseconds between a change and the question for its samples
const SLOW = 400; // milliseconds after which it is told that samples are on their way
const MANY = 10; // concepts above which they can be searched
const FEW = 6; // concepts that a phone shows at first
const phone = matchMedia("(max-width: 760px)");
const mix = { parts: [], seed: 0, timer: 0, asking: null, again: false, view: null, cards: new Map(), all: false, waiting: [], fetching: null };
const conceptOf = (id) => state.concepts.find((one) => one.id === id);

// --- the list of concepts

const HEADINGS = { learned: "Yours", opened: "From files", training: "Known from training", shipped: "Learned before", saved: "Saved" };

function conceptList() {
  const sought = find("sought").value.trim().toLowerCase();
  find("sought-label").hidden = state.concepts.length <= MANY && !sought;
  const found = state.concepts.filter((one) => one.name.toLowerCase().includes(sought)), present = new Set(state.concepts.map(cardKey));
  const order = Object.keys(HEADINGS), sorted = found.toSorted((one, other) => order.indexOf(one.kind) - order.indexOf(other.kind));
  const few = phone.matches && !mix.all && !sought && found.length > FEW;
  const shown = few ? sorted.filter((one, number) => number < FEW || mix.parts.some((part) => part.id === one.id)) : sorted;
  for (const key of [...mix.cards.keys()]) if (!present.has(key)) noCard(key);
  const groups = Object.keys(HEADINGS).map((kind) => [kind, shown.filter((one) => one.kind === kind)]).filter(([, own]) => own.length);
  find("concepts").replaceChildren(...groups.flatMap(([kind, own]) => [made("h3", { textContent: HEADINGS[kind] }), made("ul", {}, ...own.map(card))]));
  find("all").hidden = !few;
  find("all").textContent = `Show all ${found.length}`;
  if (!shown.length) find("concepts").append(made("p", { className: "note", textContent: "No concept has this name." }));
}

// Takes the card of a concept away, whose film is another one now.
function noCard(key) {
  const card = mix.cards.get(key);
  if (!card) return;
  dropCanvas(card.film);
  inSight.unobserve(card);
  mix.cards.delete(key);
}

// Models give the same ids to their concepts.
const cardKey = (concept) => `${concept.hash} ${concept.id}`;

function card(concept) {
  const one = mix.cards.get(cardKey(concept)) || newCard(concept);
  const on = mix.parts.some((part) => part.id === concept.id), pairs = state.offline && state.offline.pairs;
  one.pick.setAttribute("aria-pressed", on);
  one.pick.disabled = Boolean(pairs && !pairs.some((pair) => pair.includes(concept.id)));
  one.querySelector(".name").textContent = concept.name;
  one.querySelector(".about").textContent = about(concept);
  one.pick.title = concept.form ? `Form: ${concept.form}` : "";
  if (one.save) one.save.ariaLabel = `Save ${concept.name} as a file`;
  if (one.forget) one.forget.ariaLabel = `Forget ${concept.name}`;
  return one;
}

function about(concept) {
  const parts = [];
  if (concept.count) parts.push(many(concept.count, "demo"));
  if (concept.accuracy !== null && concept.accuracy !== undefined) parts.push(`${concept.accuracy.toFixed(2)} ${state.verdicts[0]}`);
  return parts.join(" \u00b7 ");
}

function newCard(concept) {
  const one = made("li", { className: "concept" });
  one.film = addCanvas();
  one.film.canvas.setAttribute("aria-hidden", "true"); // the name beside it says it
  one.pick = made("button", { type: "button", className: "pick" }, one.film.canvas,
    made("span", { className: "name" }), made("span", { className: "about" }));
  one.pick.addEventListener("click", () => pick(concept.id));
  one.append(one.pick);
  if (["learned", "opened"].includes(concept.kind) && !answers) {
    one.save = made("button", { type: "button", className: "plain", textContent: "Save" });
    one.save.addEventListener("click", () => saveConcept(concept.id));
    one.forget = made("button", { type: "button", className: "plain", textContent: "Forget" });
    one.forget.addEventListener("click", () => forget(concept));
    one.append(made("div", { className: "row" }, one.save, one.forget));
  }
  mix.cards.set(cardKey(concept), one);
  one.concept = concept;
  inSight.observe(one);
  return one;
}

const forget = (concept) => attempt(async () => {
  const found = await ask("/api/forget", { id: concept.id });
  learning.unsaved.delete(concept.hash + concept.id);
  await renew(found);
});

// Films of concepts are asked for one at a time, when they come in sight, after the first samples are there.
const inSight = new IntersectionObserver((changes) => {
  for (const change of changes) if (change.isIntersecting) { inSight.unobserve(change.target); mix.waiting.push(change.target); }
  thumbnails();
});

async function thumbnails() {
  if (mix.fetching || opening || !document.body.dataset.samples) return;
  const stop = mix.fetching = new AbortController(), there = (one) => mix.cards.get(cardKey(one.concept)) === one;
  while (mix.waiting.length && !stop.signal.aborted) {
    const one = mix.waiting.shift();
    if (!there(one)) continue;
    if (!one.isConnected) { inSight.observe(one); continue; } // not shown for now
    try {
      const { film } = await ask(`/api/thumbnail?id=${encodeURIComponent(one.concept.id)}`, undefined, stop.signal);
      if (stop.signal.aborted) break;
      if (!there(one)) continue;
      setCanvas(one.film, [film], null, one.concept.name);
      one.classList.add("filmed");
    } catch { /* a concept can be used without a picture */ }
  }
  if (mix.fetching === stop) mix.fetching = null;
}

// Gives up all questions of a model: another one is opened, or the program ends.
function noQuestions() {
  if (mix.fetching) mix.fetching.abort();
  if (mix.asking) mix.asking.abort();
  clearTimeout(mix.timer);
  Object.assign(mix, { timer: 0, again: false, fetching: null, waiting: [] });
}

// Nothing of a model that is left stays to be seen.
function noSamples() {
  fill(find("mixed"), [], null, () => "");
  for (const id of ["told", "took", "mix-name"]) find(id).textContent = "";
  find("enlarging").hidden = true;
  same("mix", { python: "", command: "" });
}

// --- what is in the mix

function pick(id) {
  const at = mix.parts.findIndex((part) => part.id === id);
  if (state.offline) pickPair(id);
  else if (at >= 0) mix.parts.splice(at, 1);
  else mix.parts.push(part(id));
  for (const one of mix.parts) one.automatic = false;
  mixed();
}

const part = (id, automatic = false) => ({ id, weight: 1, groups: new Set(state.groups), automatic });

// On a page that was made before there are samples of some pairs alone.
function pickPair(id) {
  const others = mix.parts.map((one) => one.id).filter((other) => other !== id).reverse();
  const pairs = state.offline.pairs.filter((pair) => pair.includes(id));
  const found = others.map((other) => pairs.find((pair) => pair.includes(other))).find(Boolean) || pairs[0];
  if (found) mix.parts = found.map((one) => mix.parts.find((old) => old.id === one) || part(one));
}

// The page is never empty: a concept of training is in the mix at the beginning.
function firstMix() {
  const first = state.concepts.find((one) => one.kind === "training") || state.concepts[0];
  mix.parts = first ? [part(first.id, true)] : [];
  if (state.offline) mix.parts = (state.offline.pairs[0] || []).map((id) => part(id));
}

// What was just learned is in the mix alone, or half and half with what was learned before, or added to what a person chose.
function mixLearned(concept) {
  if (mix.parts.some((one) => one.id === concept.id)) { mixed(); return; } // learned again
  const learned = (one) => conceptOf(one.id).kind === "learned", there = mix.parts.filter((one) => conceptOf(one.id) && one.id !== concept.id);
  const chosen = there.filter((one) => !one.automatic), before = chosen.length ? chosen : there.filter(learned).slice(-1);
  mix.parts = [...before, part(concept.id, true)];
  if (before.length === 1 && learned(before[0])) for (const one of mix.parts) one.weight = 0.5;
  mixed();
}

// Shows the mix anew and asks for its samples.
function mixed() {
  mix.parts = mix.parts.filter((one) => conceptOf(one.id));
  conceptList();
  find("mix").replaceChildren(...mix.parts.map(partControls));
  find("mix-empty").hidden = mix.parts.length > 0;
  resample();
}

function partControls(one) {
  const concept = conceptOf(one.id), box = made("li"), weights = state.offline && state.offline.weights;
  const value = made("output", { textContent: one.weight.toFixed(2) });
  const slider = made("input", { type: "range", min: 0, max: 2, step: 0.05, value: one.weight, ariaLabel: `Weight of ${concept.name}` });
  slider.dataset.id = one.id;
  if (weights) {
    const gaps = weights.slice(1).map((weight, number) => weight - weights[number]);
    Object.assign(slider, { min: weights[0], max: weights.at(-1), step: Math.min(...gaps), value: one.weight });
  }
  slider.addEventListener("input", () => {
    one.weight = Number(slider.value);
    if (weights) one.weight = weights.reduce((best, weight) => Math.abs(weight - one.weight) < Math.abs(best - one.weight) ? weight : best);
    one.automatic = false;
    value.textContent = one.weight.toFixed(2);
    resample();
  });
  const label = made("label", {}, made("span", { className: "name", textContent: concept.name }), slider, value);
  const remove = made("button", { type: "button", className: "remove", textContent: "\u00d7", ariaLabel: `Take ${concept.name} out of the mix` });
  remove.addEventListener("click", () => { pick(one.id); find("mix-title").focus(); });
  box.append(made("div", { className: "part" }, label, ...(state.offline ? [] : [remove])));
  if (state.groups.length && !state.offline) box.append(groupBoxes(one, concept));
  return box;
}

function groupBoxes(one, concept) {
  const boxes = state.groups.map((name) => {
    const box = made("input", { type: "checkbox", checked: one.groups.has(name) });
    box.addEventListener("change", () => {
      if (!box.checked && one.groups.size === 1) { box.checked = true; announce("One part has to stay; take the concept out of the mix instead."); return; }
      box.checked ? one.groups.add(name) : one.groups.delete(name);
      resample();
    });
    return made("label", { className: "check" }, box, name);
  });
  return made("fieldset", { className: "groups" }, made("legend", { textContent: `${concept.name} moves:` }), ...boxes);
}

// --- samples

function question() {
  const parts = mix.parts.map((one) => ({ id: one.id, weight: one.weight,
    groups: one.groups.size === state.groups.length ? [] : state.groups.filter((name) => one.groups.has(name)) }));
  if (state.offline) return { parts, count: 8, seed: 0, temperature: state.temperature, execute: false, task: "" };
  return { parts, count: Number(find("count").value), seed: mix.seed, temperature: Number(find("temperature").value),
    execute: state.executes && find("execute").checked, task: state.executes ? find("starts").value : "" };
}

// Samples follow the sliders while these move. Only one question is open at a time, as the program answers one after another;
// what changes meanwhile is asked for next, so that no question of an older choice ever waits.
function resample() {
  if (opening || closed) return;
  mix.again = true;
  if (!mix.timer && !mix.asking) mix.timer = setTimeout(sample, WAIT);
}

async function sample() {
  const stop = mix.asking = new AbortController();
  mix.again = false;
  mix.timer = 0;
  const slow = setTimeout(() => { if (!stop.signal.aborted) find("took").textContent = "sampling \u2026"; }, find("mixed").have && find("mixed").have.length ? SLOW : 0);
  find("mixed").setAttribute("aria-busy", "true");
  if (mix.parts.length) {
    const asked = question(), name = mixName();
    if (!find("mix-name").textContent) find("mix-name").textContent = name;
    await attempt(async () => {
      const found = await ask("/api/sample", asked, stop.signal);
      if (stop.signal.aborted) return;
      mix.view = steadyView(mix.view, found.samples);
      fill(find("mixed"), found.samples, mix.view, (number) => `Sample ${number + 1} of ${name}`);
      find("told").textContent = found.told;
      find("mix-name").textContent = name;
      find("took").textContent = answers ? "" : `${Math.max(0.1, found.seconds).toFixed(1)} s`;
      find("enlarging").hidden = !found.samples.length;
      same("mix", found.same);
      newSamples();
      thumbnails();
    }, "mix");
  } else noSamples();
  clearTimeout(slow);
  if (mix.asking !== stop) return; // another model's is asked for
  if (find("took").textContent.startsWith("sampling")) find("took").textContent = "";
  mix.asking = null;
  settled();
  if (mix.again) resample();
  find("mixed").setAttribute("aria-busy", "false");
}

const mixName = () => mix.parts.map((one) => (one.weight === 1 ? "" : `${Number(one.weight.toFixed(2))} \u00d7 `) + conceptOf(one.id).name).join(" + ");

function setMix() {
  noQuestions();
  Object.assign(mix, { seed: 0, view: null, parts: [], all: false });
  find("seed").textContent = "set 1";
  find("sought").value = "";
  find("count").value = 8;
  find("execute").checked = false;
  find("temperature").value = state.temperature;
  find("temperature-value").textContent = Number(find("temperature").value).toFixed(2);
  find("executing").hidden = !state.executes;
  const tasks = state.recorder && state.recorder.tasks.length ? state.recorder.tasks : state.library.tasks;
  find("starts-label").hidden = !state.executes || !tasks.length;
  find("starts").replaceChildren(made("option", { value: "", textContent: "any" }), ...tasks.map((task) => made("option", { value: task, textContent: task })));
  find("sampling").hidden = Boolean(state.offline);
  firstMix();
}

function listenToMix() {
  find("temperature").addEventListener("input", () => { find("temperature-value").textContent = Number(find("temperature").value).toFixed(2); resample(); });
  for (const id of ["count", "execute", "starts"]) find(id).addEventListener("change", resample);
  find("noise").addEventListener("click", () => { mix.seed += 1; find("seed").textContent = `set ${mix.seed + 1}`; resample(); });
  find("sought").addEventListener("input", conceptList);
  find("all").addEventListener("click", () => { mix.all = true; conceptList(); });
  phone.addEventListener("change", () => { if (state && !state.viewer) conceptList(); });
}
